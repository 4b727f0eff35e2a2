//! MCAP recordings of ROS 2 topics -> frames.
//!
//! Surveys the recording once for its topics, calibration and ground truth, then replays the images.

use std::collections::VecDeque;
use std::path::Path;

use crate::bag::{Bag, files_of, not_mcap};
use crate::camera_info;
use crate::depth_registration::{Calibrated, Registration, registration};
use crate::error::SourceError;
use crate::frame_source::{MetricInput, Source, SourceCounts};
use crate::ground_truth::{GroundTruth, Odometry, half_interval};
use crate::imu::ImuBuffer;
use crate::intake::{Arrival, Extras, Intake};
use crate::params::SourceParams;
use crate::ros_image::decode_into;
use crate::second_camera::SecondCamera;
use crate::survey::{Survey, header_stamp};
use crate::topics::{
    ImuTopic, depth_topic_of, image_topic_of, imu_topic_of, info_beside, info_topic_of, lens_of,
    odometry_of, second_topic_of, truth_of,
};
use splat_image::jpeg::decoder::Jpeg;
use splat_msgs::ros::{self, CompressedImage, Image};
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, SecondImage};
use splat_types::image::RgbImage;
use splat_types::inertial::ImuSpan;
use splat_types::time::Stamp;

/// Images, and depth maps, that wait for each other: their messages may lie so far apart in the recording.
const MAX_AHEAD: usize = 32;
/// Memory for either.
const MAX_AHEAD_BYTES: usize = 64 << 20;

/// A message that waits; the stamp is `None` where not even that can be read.
#[derive(Debug)]
struct Waiting {
    stamp: Option<Stamp>,
    payload: Vec<u8>,
}

/// The topics that are read.
#[derive(Debug)]
struct ImageTopics {
    image: String,
    is_compressed: bool,
    depth: Option<DepthTopic>,
    second: Option<PairedTopic>,
    imu: Option<ImuTopic>,
}

#[derive(Debug)]
struct PairedTopic {
    name: String,
    within_nanos: u64,
    camera: SecondCamera,
}

#[derive(Debug)]
struct DepthTopic {
    name: String,
    is_compressed: bool,
    /// Depth belongs to the image whose stamp is nearest, if it is as near as that.
    within_nanos: u64,
    registration: Registration,
}

impl DepthTopic {
    /// `None`, and a warning, where nothing says how depth lies to colour.
    fn of(name: String, survey: &Survey, image_topic: &str, params: &SourceParams) -> Option<Self> {
        let frame_of = |topic: &str| survey.topics.get(topic).map_or("", |t| t.frame_id.as_str());
        let of = |topic: &str, info_topic: &str| Calibrated {
            frame_id: frame_of(topic),
            info: survey.infos.get(info_topic),
        };
        let colour_info = info_topic_of(&params.camera_info_topic, image_topic);
        let colour = of(image_topic, &colour_info);
        let depth = of(&name, &info_beside(&name));
        let registration = registration(&colour, &depth, &survey.transforms);
        match &registration {
            Registration::Aligned => (),
            Registration::By(_) => {
                tracing::info!("depth images are registered to the colour camera by tf");
            }
            Registration::Unknown(reason) => {
                tracing::warn!("{reason}; depth images are left out");
                return None;
            }
        }
        Some(Self {
            is_compressed: survey
                .topics
                .get(&name)
                .is_some_and(|topic| topic.is_compressed()),
            within_nanos: (1e9 * params.depth_tolerance) as u64,
            registration,
            name,
        })
    }
}

/// Messages that were read and not used yet, by what they hold.
#[derive(Debug, Default)]
struct Queues {
    images: VecDeque<Waiting>,
    depths: VecDeque<Waiting>,
    /// Of the second camera.
    seconds: VecDeque<Waiting>,
    imu: ImuBuffer,
}

#[derive(Debug)]
pub struct McapSource {
    bag: Bag,
    topics: ImageTopics,
    truth: GroundTruth,
    odometry: Odometry,
    truth_within_nanos: i64,
    n_images: u64,
    max_frames: u64,
    queues: Queues,
    is_read: bool,
    jpeg: Jpeg,
    intake: Intake,
}

impl McapSource {
    /// `path` is a `.mcap` file, or a rosbag2 folder whose files are read in the order of its metadata.yaml.
    pub fn open(path: &Path, params: &SourceParams) -> Result<Self, SourceError> {
        let files = files_of(path)?;
        if let Some(reason) = files.first().and_then(|first| not_mcap(first)) {
            let way_out = "record with ros2 bag record -s mcap, or convert with mcap convert";
            return Err(SourceError::Open {
                what: "recording",
                reason,
                way_out,
                path: path.to_owned(),
            });
        }
        let mut survey = Survey::of(files.clone());
        let image_topic = image_topic_of(&survey, params, path)?;
        let topic = &survey.topics[&image_topic];
        if survey.has_left_out {
            tracing::warn!(
                "more poses than are kept: frames late in the recording have no ground truth"
            );
        }
        let depth_topic = depth_topic_of(&survey, params)
            .and_then(|name| DepthTopic::of(name, &survey, &image_topic, params));
        let second = second_topic_of(&survey, &image_topic, params).map(|topic| PairedTopic {
            name: topic.name,
            within_nanos: (1e9 * params.stereo_tolerance) as u64,
            camera: SecondCamera::new(
                params,
                topic.lens,
                topic.second_from_first,
                topic.is_compressed,
            ),
        });
        let imu =
            imu_topic_of(&survey, &image_topic, params).map_err(|reason| SourceError::Open {
                what: "IMU of the recording",
                reason,
                way_out: "mend source.imu_extrinsic, or leave it empty",
                path: path.to_owned(),
            })?;
        if let Some(imu) = &imu {
            tracing::info!(topic = imu.name, "IMU");
        }
        let lens = match camera_info::of_url(&params.camera_info_url)? {
            Some((_, lens)) => Some(lens),
            None => lens_of(&survey, &image_topic, params),
        };
        let (is_compressed, n_images) = (topic.is_compressed(), topic.n_messages);
        let truth_within_nanos = half_interval(&topic.stamps);
        tracing::info!(
            topic = image_topic,
            frames = n_images,
            calibrated = lens.is_some(),
            "recording opened"
        );
        Ok(Self {
            bag: Bag::new(files),
            truth_within_nanos,
            n_images,
            odometry: odometry_of(&mut survey, &image_topic, params),
            truth: truth_of(survey, &image_topic, params),
            topics: ImageTopics {
                image: image_topic,
                is_compressed,
                depth: depth_topic,
                second,
                imu,
            },
            max_frames: params.max_frames,
            queues: Queues::default(),
            is_read: false,
            jpeg: Jpeg::default(),
            intake: Intake::new(params, lens),
        })
    }

    /// Takes one message in.
    fn read_on(&mut self) {
        let message = match self.bag.next_message() {
            Ok(Some(message)) => message,
            Ok(None) => {
                self.is_read = true;
                return;
            }
            Err(fault) => {
                self.is_read = true;
                self.intake.fault(fault);
                return;
            }
        };
        let topic = &message.channel.topic;
        if self.topics.imu.as_ref().is_some_and(|i| i.name == *topic) {
            if let Err(reason) = self.queues.imu.push(message.payload) {
                let text = format!("samples of the IMU are left out: {reason}");
                self.intake.warn_once("imu", &text);
            }
            return;
        }
        let is_depth = self.topics.depth.as_ref().is_some_and(|d| d.name == *topic);
        let is_second = self
            .topics
            .second
            .as_ref()
            .is_some_and(|s| s.name == *topic);
        let waiting = match topic {
            name if *name == self.topics.image => &mut self.queues.images,
            _ if is_depth => &mut self.queues.depths,
            _ if is_second => &mut self.queues.seconds,
            _ => return,
        };
        let stamp = header_stamp(message.payload, message.log_nanos);
        waiting.push_back(Waiting {
            stamp,
            payload: message.payload.to_vec(),
        });
        for beside in [&mut self.queues.depths, &mut self.queues.seconds] {
            while beside.len() > MAX_AHEAD
                || (beside.len() > 1 && bytes_of(beside) > MAX_AHEAD_BYTES)
            {
                beside.pop_front();
            }
        }
    }

    /// The oldest image, once what goes with it is here or will not come.
    fn take_ready(&mut self) -> Option<Waiting> {
        let queues = &mut self.queues;
        let stamp = queues.images.front()?.stamp;
        let newest = |beside: &VecDeque<Waiting>| beside.iter().filter_map(|w| w.stamp).max();
        let has_depth = self.topics.depth.is_none() || newest(&queues.depths) >= stamp;
        let has_second = self.topics.second.is_none() || newest(&queues.seconds) >= stamp;
        let has_imu = self.topics.imu.is_none() || queues.imu.newest() >= stamp;
        let is_ready = self.is_read
            || stamp.is_none()
            || (has_depth && has_second && has_imu)
            || queues.images.len() > MAX_AHEAD
            || bytes_of(&queues.images) > MAX_AHEAD_BYTES;
        if is_ready {
            queues.images.pop_front()
        } else {
            None
        }
    }

    fn frame_of(&mut self, waiting: &Waiting) -> Option<Frame> {
        let Some(stamp) = waiting.stamp else {
            self.intake.unreadable("its message has no CDR header");
            return None;
        };
        let arrival = self.intake.arrive(stamp)?;
        let mut image = self.intake.spare();
        let jpeg = &mut self.jpeg;
        match decode_into(
            &waiting.payload,
            self.topics.is_compressed,
            jpeg,
            &mut image,
        ) {
            Ok(()) => self.frame_with(arrival, image),
            Err(reason) => {
                self.intake.undecodable(arrival.seq, &reason);
                None
            }
        }
    }

    fn frame_with(&mut self, arrival: Arrival, image: RgbImage) -> Option<Frame> {
        let truth = self.truth.at(arrival.stamp, self.truth_within_nanos);
        let sensor_depth = self.depth_at(arrival.stamp);
        let second = self.second_at(arrival.stamp);
        let imu = self.imu_until(arrival.stamp);
        self.intake.frame(
            arrival,
            image,
            Extras {
                truth,
                odometry: self.odometry.at(arrival.stamp),
                imu,
                sensor_depth,
                second,
                ..Extras::default()
            },
        )
    }
}

impl McapSource {
    /// The depth map that is nearest in time, if it is near enough. Images without one are counted.
    fn depth_at(&mut self, stamp: Stamp) -> Option<DepthMap> {
        let topic = self.topics.depth.as_mut()?;
        let nearest = nearest(&self.queues.depths, stamp, topic.within_nanos);
        let decoded = nearest.map(|depth| {
            let depth = depth_of(&depth.payload, topic.is_compressed)?;
            topic.registration.apply(depth)
        });
        match decoded {
            Some(Ok(depth)) => return Some(depth),
            Some(Err(reason)) => {
                let text = format!("depth images are left out: {reason}");
                self.intake.warn_once("depth", &text);
            }
            None => (),
        }
        self.intake.without_depth();
        None
    }

    /// What the IMU measured since the image before. Images without it are counted.
    fn imu_until(&mut self, stamp: Stamp) -> Option<ImuSpan> {
        let topic = self.topics.imu.as_ref()?;
        let span = self.queues.imu.take_until(stamp, &topic.mounted);
        if span.is_none() {
            self.intake.without_imu();
        }
        span
    }

    /// What the second camera saw at the same time. Images without it are counted.
    fn second_at(&mut self, stamp: Stamp) -> Option<SecondImage> {
        let topic = self.topics.second.as_ref()?;
        let nearest = nearest(&self.queues.seconds, stamp, topic.within_nanos);
        let second = nearest.map(|second| topic.camera.image(stamp, second.payload.clone()));
        if second.is_none() {
            self.intake.without_second();
        }
        second
    }
}

/// The message whose stamp is nearest, if it is near enough.
fn nearest(waiting: &VecDeque<Waiting>, stamp: Stamp, within_nanos: u64) -> Option<&Waiting> {
    let off = |other: &Waiting| Some(other.stamp?.nanos.abs_diff(stamp.nanos));
    let near = waiting.iter().filter_map(|w| Some((off(w)?, w)));
    let nearest = near.min_by_key(|(nanos, _)| *nanos)?;
    (nearest.0 <= within_nanos).then_some(nearest.1)
}

impl Source for McapSource {
    fn next(&mut self) -> Option<Frame> {
        while !self.intake.is_full() {
            if let Some(waiting) = self.take_ready() {
                if let Some(frame) = self.frame_of(&waiting) {
                    return Some(frame);
                }
            } else if self.is_read {
                return None;
            } else {
                self.read_on();
            }
        }
        None
    }

    fn counts(&self) -> SourceCounts {
        self.intake.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        let counts = self.intake.counts();
        let left = self.n_images.saturating_sub(counts.received);
        let frames_out = counts.received - counts.undecodable - counts.out_of_order;
        let room = if self.max_frames == 0 {
            u64::MAX
        } else {
            self.max_frames.saturating_sub(frames_out)
        };
        Some(left.min(room))
    }

    fn truth_extent(&self) -> Option<f64> {
        self.truth.extent()
    }

    fn metric_input(&self) -> MetricInput {
        match (&self.topics.depth, &self.topics.second) {
            (Some(_), _) => MetricInput::Depth,
            (None, Some(_)) => MetricInput::Stereo,
            (None, None) => MetricInput::None,
        }
    }
}

fn bytes_of(queue: &VecDeque<Waiting>) -> usize {
    queue.iter().map(|waiting| waiting.payload.len()).sum()
}

/// For sources whose images come as messages, too.
#[cfg(feature = "live-messages")]
pub fn image_of(payload: &[u8], is_compressed: bool) -> Result<RgbImage, String> {
    let mut out = splat_image::limits::empty();
    decode_into(payload, is_compressed, &mut Jpeg::default(), &mut out)?;
    Ok(out)
}

/// Of an Image, or of a CompressedImage of `compressedDepth`.
pub fn depth_of(payload: &[u8], is_compressed: bool) -> Result<DepthMap, String> {
    if is_compressed {
        let message: CompressedImage = ros::decode(payload).map_err(|e| e.to_string())?;
        return crate::compressed_depth::compressed_depth(&message).map_err(|e| e.to_string());
    }
    let message: Image = ros::decode(payload).map_err(|e| e.to_string())?;
    crate::ros_image::depth(&message).map_err(|e| e.to_string())
}
