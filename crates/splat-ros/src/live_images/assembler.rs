//! Live images and what comes beside them -> frames: waits for the calibration, then for what goes with each image.
//!
//! What is decoded is decoded on the source's thread, by the same code as recordings.

use crate::live_images::companions::{Beside, Companions};
use splat_io::depth_registration::Registration;
use splat_io::frame_source::{MetricInput, SourceCounts};
use splat_io::intake::{Extras, Intake};
use splat_io::mcap::{depth_of, image_of};
use splat_io::params::SourceParams;
use splat_io::second_camera::SecondCamera;
use splat_io::survey::{header_frame, header_stamp};
use splat_types::frame::Frame;
use splat_types::time::{Stamp, Stopwatch};

/// Without any transform for so long after the first image, there is no odometry to wait for.
const SETTLE_SECS: f64 = 0.5;

/// An image as it came.
#[derive(Debug)]
pub(crate) struct ReceivedImage {
    /// `None` where not even the header can be read.
    pub(crate) stamp: Option<Stamp>,
    pub(crate) payload: Vec<u8>,
    pub(crate) age: Stopwatch,
}

impl ReceivedImage {
    pub(crate) fn new(payload: Vec<u8>) -> Self {
        Self {
            stamp: header_stamp(&payload, 0),
            payload,
            age: Stopwatch::start(),
        }
    }
}

/// How long images wait, in seconds.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    /// The first ones, for a calibration.
    pub(crate) camera_info_secs: f64,
    /// Each, for what goes with it.
    pub(crate) companions_secs: f64,
}

/// Makes frames of the images of one topic.
#[derive(Debug)]
pub(crate) struct Assembler {
    pub(crate) beside: Beside,
    pub(crate) camera_frame: String,
    params: SourceParams,
    topic: String,
    /// Made with the first frame, when the lens is known or given up.
    intake: Option<Intake>,
    second: Option<SecondCamera>,
    /// Of depth images, known with the first of them.
    registration: Option<Registration>,
    /// Before there is an intake.
    n_unreadable: u64,
    uses_transforms: bool,
}

impl Assembler {
    /// Of images on `topic`; live ones set the pace.
    pub(crate) fn new(topic: &str, params: &SourceParams, beside: Beside) -> Self {
        Self {
            beside,
            camera_frame: String::new(),
            params: SourceParams {
                rate: 0.0,
                ..params.clone()
            },
            topic: topic.to_owned(),
            intake: None,
            second: None,
            registration: None,
            n_unreadable: 0,
            uses_transforms: false,
        }
    }

    pub(crate) fn is_full(&self) -> bool {
        self.intake.as_ref().is_some_and(Intake::is_full)
    }

    /// `dropped`: images that came faster than they were taken.
    pub(crate) fn counts(&self, dropped: u64) -> SourceCounts {
        let mut counts = self.intake.as_ref().map(Intake::counts).unwrap_or_default();
        counts.received += dropped + self.n_unreadable;
        counts.undecodable += self.n_unreadable;
        counts.dropped += dropped;
        counts
    }

    pub(crate) fn metric_input(&self) -> MetricInput {
        if self.beside.has_depth_topic {
            MetricInput::Depth
        } else if self.beside.second.is_some() {
            MetricInput::Stereo
        } else {
            MetricInput::None
        }
    }

    /// Time begins anew: the next image may have any stamp.
    #[cfg(feature = "ros2")]
    pub(crate) fn begin_anew(&mut self) {
        self.beside.forget_times();
        if let Some(intake) = &mut self.intake {
            intake.begin_anew();
        }
    }

    /// What is missing beside the images, a line each.
    pub(crate) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.beside.lens(&self.topic).is_none() {
            let topic = &self.beside.info_topic;
            warnings.push(format!(
                "no CameraInfo on {topic:?}: name its topic with source.camera_info_topic"
            ));
        }
        if self.intake.is_some()
            && let Some((base, None)) = self.beside.mount(&self.camera_frame)
        {
            warnings.push(format!(
                "tf does not lead from {base:?} to the camera {:?}; publish it on /tf_static",
                self.camera_frame
            ));
        }
        if self.intake.is_some() {
            warnings.extend(self.beside.imu_fault(&self.camera_frame));
        }
        warnings
    }

    /// What goes with an image, once the calibration is there and all that may still come, or it has waited long enough.
    pub(crate) fn is_ready(
        &mut self,
        image: &ReceivedImage,
        patience: &Patience,
    ) -> Option<Companions> {
        let waited = image.age.secs();
        let Some(stamp) = image.stamp else {
            return Some(Companions::default());
        };
        if self.intake.is_none() {
            self.camera_frame = header_frame(&image.payload).unwrap_or_default();
            let second = self.beside.second_camera(&self.topic, &self.camera_frame);
            let has_second = self.beside.second.is_none() || second.is_some();
            let has_depth_info = self.beside.has_depth_info() || waited > SETTLE_SECS;
            let has_lens = self.beside.lens(&self.topic).is_some() && has_second && has_depth_info;
            let is_settled = waited > SETTLE_SECS && !self.beside.has_moving_transforms();
            let has_odometry = self.beside.reaches_odometry(&self.camera_frame)
                || self.beside.has_odometry_topic
                || is_settled;
            let is_late = waited > patience.camera_info_secs;
            if !(has_lens && has_odometry || is_late) {
                return None;
            }
            self.begin();
        }
        let (companions, is_whole) =
            self.beside
                .companions(&self.camera_frame, stamp, self.uses_transforms);
        let is_late = waited > patience.companions_secs;
        (is_whole || is_late).then_some(companions)
    }

    /// What is known when the first frame goes out counts from then on. Odometry that shows up later is left out: it may
    /// be what this node makes of its own poses.
    fn begin(&mut self) {
        let topic = &self.beside.info_topic;
        let lens = match self.beside.lens(&self.topic) {
            None => {
                tracing::warn!("no CameraInfo on {topic:?}: the camera counts as uncalibrated");
                None
            }
            Some(Err(found)) => {
                tracing::warn!("camera counts as uncalibrated, {topic:?} says: {found}");
                None
            }
            Some(Ok(lens)) => Some(lens),
        };
        self.uses_transforms =
            !self.beside.has_odometry_topic && self.beside.reaches_odometry(&self.camera_frame);
        if let Some((base, None)) = self.beside.mount(&self.camera_frame) {
            tracing::warn!(
                "no fixed transforms from {base:?} to the camera {:?}: it counts as mounted where odometry turns",
                self.camera_frame
            );
        }
        tracing::info!(
            calibrated = lens.is_some(),
            odometry = self.uses_transforms || self.beside.has_odometry_topic,
            "first image, in frame {:?}",
            self.camera_frame
        );
        let second = self.beside.second_camera(&self.topic, &self.camera_frame);
        if let Some(topics) = self.beside.second.as_ref().filter(|_| second.is_none()) {
            tracing::warn!(
                "no stereo: neither CameraInfo beside {:?} nor /tf_static says how the cameras are mounted",
                topics.images
            );
        }
        let second = second.filter(|_| lens.is_some());
        let is_compressed = self.beside.second.as_ref().is_some_and(|s| s.is_compressed);
        self.second = second
            .map(|(lens, mounted)| SecondCamera::new(&self.params, lens, mounted, is_compressed));
        self.intake = Some(Intake::new(&self.params, lens));
    }

    /// The frame of an image; `None`, and a count, where it cannot be used.
    pub(crate) fn frame_of(
        &mut self,
        image: &ReceivedImage,
        is_compressed: bool,
        companions: Companions,
    ) -> Option<Frame> {
        let Some(intake) = &mut self.intake else {
            self.n_unreadable += 1;
            return None;
        };
        let Some(stamp) = image.stamp else {
            intake.unreadable("its message has no CDR header");
            return None;
        };
        let arrival = intake.arrive(stamp)?;
        let sensor_depth = companions.depth.and_then(|payload| {
            let registration = self.registration.get_or_insert_with(|| {
                let depth_frame = header_frame(&payload).unwrap_or_default();
                self.beside.registration(&self.camera_frame, &depth_frame)
            });
            let depth = depth_of(&payload, self.beside.is_depth_compressed);
            let depth = depth.and_then(|depth| registration.apply(depth));
            let complain = |reason: &String| {
                intake.warn_once("depth", &format!("depth images are left out: {reason}"));
            };
            depth.inspect_err(complain).ok()
        });
        if self.beside.has_depth_topic && sensor_depth.is_none() {
            intake.without_depth();
        }
        let second = self.second.as_ref().zip(companions.second);
        let second = second.map(|(camera, payload)| camera.image(stamp, payload));
        if self.second.is_some() && second.is_none() {
            intake.without_second();
        }
        match image_of(&image.payload, is_compressed) {
            Ok(pixels) => {
                let imu = self.beside.take_imu(&self.camera_frame, stamp);
                if self.beside.has_imu_topic() && imu.is_none() {
                    intake.without_imu();
                }
                let extras = Extras {
                    truth: companions.truth,
                    odometry: companions.odometry,
                    imu,
                    sensor_depth,
                    second,
                    ..Extras::default()
                };
                intake.frame(arrival, pixels, extras)
            }
            Err(reason) => {
                intake.undecodable(arrival.seq, &reason);
                None
            }
        }
    }
}
