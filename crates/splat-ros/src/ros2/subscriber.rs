//! A ROS 2 topic with images -> frames, with calibration, odometry and depth from the topics beside it.
//!
//! What `images` brings is decoded here, on the source's thread, by the same code as recordings.

use std::sync::Arc;
use std::time::Duration;

use crate::ros2::companion_topics::{Beside, Companions};
use crate::ros2::image_topic::{ReceivedImage, Subscription};
use crate::ros2::node::Link;
use crate::ros2::params::OnTimeJump;
use crate::ros2::topic_watch::{Watch, why_silent};
use splat_io::error::SourceError;
use splat_io::frame_source::{MetricInput, Polled, Source, SourceCounts};
use splat_io::intake::{Extras, Intake};
use splat_io::mcap::{depth_of, image_of};
use splat_io::params::SourceParams;
use splat_io::queue::Received;
use splat_io::second_camera::SecondCamera;
use splat_io::survey::header_frame;
use splat_io::topics::info_beside;
use splat_types::frame::Frame;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

/// Stamps that lie so far back are not a matter of order but of another time.
const JUMP_SECS: f64 = 1.0;
/// Without any transform for so long after the first image, there is no odometry to wait for.
const SETTLE_SECS: f64 = 0.5;
/// How often what an image waits for is looked at.
const TICK: Duration = Duration::from_millis(2);

/// Images of a topic and what comes beside them. Many fields: waiting for companions, jumps of time and silence each read
/// what the others write (the intake, the stamps, the frame of the camera), so that parts would borrow one another.
#[derive(Debug)]
pub struct Ros2Source {
    link: Arc<Link>,
    params: SourceParams,
    topic: String,
    subscription: Option<Subscription>,
    beside: Beside,
    /// Made with the first frame, when the lens is known or given up.
    intake: Option<Intake>,
    second: Option<SecondCamera>,
    /// Before there is an intake.
    n_unreadable: u64,
    camera_frame: String,
    uses_transforms: bool,
    waiting: Option<ReceivedImage>,
    last_stamp: Option<Stamp>,
    last_clock: Option<Stamp>,
    watch: Watch,
    is_ended: bool,
}

impl Ros2Source {
    /// `topic` as in `ros2:/camera/image_raw`. Images may begin to come at any time later.
    pub fn open(topic: &str, params: &SourceParams) -> Result<Self, SourceError> {
        let fail = |reason: String| SourceError::Subscribe {
            topic: topic.to_owned(),
            reason,
        };
        if topic.trim_matches('/').is_empty() {
            return Err(fail(
                "a topic is wanted, such as ros2:/camera/image_raw".to_owned(),
            ));
        }
        let link = Link::current().ok_or_else(|| {
            fail("the node is not up; ros2.enabled=off leaves no way to receive ROS 2".to_owned())
        })?;
        let info_topic = if params.camera_info_topic.is_empty() {
            info_beside(topic)
        } else {
            params.camera_info_topic.clone()
        };
        let beside = Beside::subscribe(&link, &info_topic, params);
        let mut source = Self {
            beside: beside.map_err(|e| fail(e.to_string()))?,
            link,
            params: SourceParams {
                camera_info_topic: info_topic,
                // Live images set the pace.
                rate: 0.0,
                ..params.clone()
            },
            topic: topic.to_owned(),
            subscription: None,
            intake: None,
            second: None,
            n_unreadable: 0,
            camera_frame: String::new(),
            uses_transforms: false,
            waiting: None,
            last_stamp: None,
            last_clock: None,
            watch: Watch::new(),
            is_ended: false,
        };
        source.subscription =
            Subscription::of(&source.link, topic).map_err(|e| fail(e.to_string()))?;
        Ok(source)
    }

    /// The oldest image that came, if one comes in time.
    fn next_image(&mut self, patience: Duration) -> Option<ReceivedImage> {
        if self.subscription.is_none() {
            match Subscription::of(&self.link, &self.topic) {
                Ok(subscription) => self.subscription = subscription,
                Err(e) => tracing::warn!("{e}"),
            }
        }
        let Some(subscription) = &self.subscription else {
            if self.watch.is_due() {
                self.look_for_silence();
            }
            std::thread::sleep(patience);
            return None;
        };
        match subscription.images.recv_timeout(patience) {
            Received::Item(image) => {
                self.watch.image_came();
                Some(image)
            }
            Received::Nothing => {
                if self.watch.is_due() {
                    self.look_for_silence();
                }
                None
            }
            Received::Ended => {
                self.is_ended = true;
                None
            }
        }
    }

    /// Whether the calibration is there and all that may still come with the image.
    fn is_ready(&mut self, image: &ReceivedImage) -> Option<Companions> {
        let waited = image.age.secs();
        let Some(stamp) = image.stamp else {
            return Some(Companions::default());
        };
        if self.intake.is_none() {
            self.camera_frame = header_frame(&image.payload).unwrap_or_default();
            let second = self.beside.second_camera(&self.topic, &self.camera_frame);
            let has_second = self.beside.second.is_none() || second.is_some();
            let has_lens = self.beside.lens(&self.topic).is_some() && has_second;
            let is_settled = waited > SETTLE_SECS && !self.beside.has_moving_transforms();
            let has_odometry = self.beside.reaches_odometry(&self.camera_frame)
                || self.beside.has_odometry_topic
                || is_settled;
            let is_late = waited > self.link.setup.live.get().camera_info_timeout;
            if !(has_lens && has_odometry || is_late) {
                return None;
            }
            self.begin();
        }
        let (companions, is_whole) =
            self.beside
                .companions(&self.camera_frame, stamp, self.uses_transforms);
        let is_late = waited > self.link.setup.live.get().odometry_timeout;
        (is_whole || is_late).then_some(companions)
    }

    /// What is known when the first frame goes out counts from then on. Odometry that shows up later is left out: it may
    /// be what this node makes of its own poses.
    fn begin(&mut self) {
        let topic = &self.params.camera_info_topic;
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
        self.second = second.map(|(lens, mounted)| SecondCamera::new(&self.params, lens, mounted));
        self.intake = Some(Intake::new(&self.params, lens));
    }

    fn frame_of(&mut self, image: &ReceivedImage, companions: Companions) -> Option<Frame> {
        let is_compressed = self.subscription.as_ref()?.is_compressed;
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
            let depth = depth_of(&payload, self.beside.is_depth_compressed);
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
                let extras = Extras {
                    truth: companions.truth,
                    odometry: companions.odometry,
                    sensor_depth,
                    second,
                    ..Extras::default()
                };
                let frame = intake.frame(arrival, pixels, extras);
                self.last_stamp = frame.as_ref().map_or(self.last_stamp, |f| Some(f.stamp));
                frame
            }
            Err(reason) => {
                intake.undecodable(arrival.seq, &reason);
                None
            }
        }
    }

    /// False when the input ends over it.
    fn survives_jump(&mut self, from: Stamp, to: Stamp) -> bool {
        let back = from.secs_since(to);
        let action = self.link.setup.live.get().on_time_jump;
        match action {
            OnTimeJump::Ignore => return true,
            OnTimeJump::Reset if self.link.time_jumped() => {
                tracing::warn!("time jumped back by {back:.3} s, to {to}: a new map begins");
                self.beside.forget_times();
                self.last_stamp = None;
                if let Some(intake) = &mut self.intake {
                    intake.begin_anew();
                }
                return true;
            }
            OnTimeJump::Reset => {
                tracing::warn!(
                    "ros2.on_time_jump=reset needs the services of the node, which are off"
                );
            }
            OnTimeJump::End => {}
        }
        tracing::warn!(
            "time jumped back by {back:.3} s, to {to}: the input ends (ros2.on_time_jump)"
        );
        self.is_ended = true;
        false
    }

    /// Whether `/clock` or the image's stamp jumped back, and the input ends over it.
    fn ends_by_jump(&mut self, image: Option<&ReceivedImage>) -> bool {
        let clock = self.link.sim_time();
        let last_clock = std::mem::replace(&mut self.last_clock, clock);
        let stamp = image.and_then(|p| p.stamp);
        for (last, new) in [(last_clock, clock), (self.last_stamp, stamp)] {
            if let (Some(last), Some(new)) = (last, new)
                && last.secs_since(new) > JUMP_SECS
                && !self.survives_jump(last, new)
            {
                return true;
            }
        }
        false
    }

    /// Says what is missing, and to the status every time.
    fn look_for_silence(&mut self) {
        let is_silent = self.watch.silent_secs() > self.link.setup.live.get().image_timeout;
        let silence = is_silent.then(|| {
            let (topic, is_compressed) = self
                .subscription
                .as_ref()
                .map_or((self.topic.as_str(), false), |s| {
                    (&s.topic, s.is_compressed)
                });
            why_silent(&self.link, topic, is_compressed)
        });
        let mut warnings = Vec::new();
        self.warn_of_companions(&mut warnings);
        self.watch.report(&self.link, silence, warnings);
    }

    fn warn_of_companions(&self, warnings: &mut Vec<String>) {
        if self.beside.lens(&self.topic).is_none() {
            let topic = &self.params.camera_info_topic;
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
    }
}

impl Source for Ros2Source {
    fn next(&mut self) -> Option<Frame> {
        loop {
            match self.poll(Duration::from_secs(1)) {
                Polled::Frame(frame) => return Some(*frame),
                Polled::Waiting => {}
                Polled::Ended => return None,
            }
        }
    }

    fn poll(&mut self, patience: Duration) -> Polled {
        let watch = Stopwatch::start();
        loop {
            if self.is_ended || self.intake.as_ref().is_some_and(Intake::is_full) {
                return Polled::Ended;
            }
            let Some(rest) = patience.checked_sub(watch.elapsed()) else {
                return Polled::Waiting;
            };
            let Some(image) = self.waiting.take().or_else(|| self.next_image(rest)) else {
                if self.ends_by_jump(None) {
                    return Polled::Ended;
                }
                continue;
            };
            if self.ends_by_jump(Some(&image)) {
                return Polled::Ended;
            }
            let Some(companions) = self.is_ready(&image) else {
                self.waiting = Some(image);
                std::thread::sleep(TICK);
                continue;
            };
            if let Some(frame) = self.frame_of(&image, companions) {
                if self.watch.is_due() {
                    self.look_for_silence();
                }
                return Polled::Frame(Box::new(frame));
            }
        }
    }

    fn mount(&self) -> Option<Rigid> {
        let base_frame = &self.link.setup.base_frame;
        self.beside.fixed(base_frame, &self.camera_frame)
    }

    fn camera_frame(&self) -> &str {
        &self.camera_frame
    }

    fn metric_input(&self) -> MetricInput {
        if self.beside.has_depth_topic {
            MetricInput::Depth
        } else if self.beside.second.is_some() {
            MetricInput::Stereo
        } else {
            MetricInput::None
        }
    }

    fn warnings(&self) -> Vec<String> {
        self.link.warnings()
    }

    fn counts(&self) -> SourceCounts {
        let mut counts = self.intake.as_ref().map(Intake::counts).unwrap_or_default();
        let dropped = self.subscription.as_ref().map_or(0, |s| s.images.dropped());
        counts.received += dropped + self.n_unreadable;
        counts.undecodable += self.n_unreadable;
        counts.dropped += dropped;
        counts
    }

    fn len_hint(&self) -> Option<u64> {
        None
    }

    fn truth_extent(&self) -> Option<f64> {
        None
    }
}
