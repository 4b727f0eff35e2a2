//! What comes beside live images: calibration, transforms, odometry, an IMU, true poses, depth, a second camera. Newest wins, old is forgotten.
//!
//! Filled on the threads of ROS 2 or zenoh, read on the source's.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use splat_io::calibration::{is_rectified, lens_of_camera_info};
use splat_io::depth_registration::{Calibrated, Registration, registration};
use splat_io::ground_truth::{Track, Transforms};
use splat_io::imu::{ImuBuffer, MountedImu, extrinsic_of};
use splat_io::params::SourceParams;
use splat_io::second_camera::{OfPair, mounted};
use splat_io::survey::header_stamp;
use splat_io::topics::{info_beside, info_topic_of};
use splat_msgs::ros::imu::Imu;
use splat_msgs::ros::odometry::Odometry;
use splat_msgs::ros::{self, CameraInfo, CompressedImage, Image, Message, PoseStamped, TfMessage};
use splat_types::camera::CameraModel;
use splat_types::inertial::ImuSpan;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Transforms, odometry and poses are kept for so long.
const KEPT_NANOS: i64 = 30_000_000_000;
/// And looked through after so many messages.
const TIDY_EVERY: u32 = 256;
/// Depth images that wait for their image, which may wait for calibration; and memory for them.
const MAX_DEPTHS: usize = 32;
const MAX_DEPTH_BYTES: usize = 64 << 20;
/// A true pose counts for an image so near in time.
const TRUTH_WITHIN_NANOS: i64 = 50_000_000;

/// What was received so far.
#[derive(Debug, Default)]
pub(crate) struct CompanionState {
    info: Option<CameraInfo>,
    transforms: Transforms,
    /// The frame that moves, and its poses.
    odometry: Option<(String, Track)>,
    poses: Track,
    depths: VecDeque<(Stamp, Vec<u8>)>,
    seconds: VecDeque<(Stamp, Vec<u8>)>,
    second_info: Option<CameraInfo>,
    depth_info: Option<CameraInfo>,
    imu: ImuBuffer,
    n_messages: u32,
    has_moving_transforms: bool,
}

/// The topics beside the images, and what was received on them.
#[derive(Debug)]
pub(crate) struct Beside {
    received: Arc<Mutex<CompanionState>>,
    pub(crate) info_topic: String,
    params: SourceParams,
    odom_frame: String,
    pub(crate) has_odometry_topic: bool,
    pub(crate) has_depth_topic: bool,
    pub(crate) is_depth_compressed: bool,
    pub(crate) second: Option<SecondTopics>,
}

/// The topics of the second camera of a stereo pair.
#[derive(Debug)]
pub(crate) struct SecondTopics {
    pub(crate) images: String,
    pub(crate) is_compressed: bool,
    info: String,
    within_nanos: u64,
}

/// What goes with one image.
#[derive(Debug, Default)]
pub(crate) struct Companions {
    pub(crate) odometry: Option<Rigid>,
    pub(crate) truth: Option<Rigid>,
    pub(crate) depth: Option<Vec<u8>>,
    pub(crate) second: Option<Vec<u8>>,
}

/// What a topic beside the images brings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    CameraInfo,
    SecondCameraInfo,
    DepthCameraInfo,
    StaticTransforms,
    Transforms,
    Odometry,
    Imu,
    TruePose,
    Depth,
    SecondImage,
}

/// A topic to subscribe, beside the images.
#[derive(Debug, Clone)]
pub(crate) struct CompanionTopic {
    pub(crate) name: String,
    pub(crate) type_name: &'static str,
    pub(crate) kind: Kind,
}

impl Beside {
    /// For images whose calibration comes on `info_topic`.
    pub(crate) fn new(params: &SourceParams, info_topic: &str, odom_frame: &str) -> Self {
        Self {
            received: Arc::default(),
            info_topic: info_topic.to_owned(),
            params: params.clone(),
            odom_frame: odom_frame.to_owned(),
            has_odometry_topic: !params.odometry_topic.is_empty(),
            has_depth_topic: !params.depth_topic.is_empty(),
            is_depth_compressed: is_compressed(&params.depth_topic),
            second: SecondTopics::of(params),
        }
    }

    /// What is to be subscribed; each message goes to `sink`.
    pub(crate) fn topics(&self) -> Vec<CompanionTopic> {
        let image = |is_compressed| {
            if is_compressed {
                CompressedImage::TYPE_NAME
            } else {
                Image::TYPE_NAME
            }
        };
        let params = &self.params;
        let mut topics = Vec::new();
        let mut add = |name: &str, type_name, kind| {
            if !name.is_empty() {
                topics.push(CompanionTopic {
                    name: name.to_owned(),
                    type_name,
                    kind,
                });
            }
        };
        add(&self.info_topic, CameraInfo::TYPE_NAME, Kind::CameraInfo);
        add("/tf_static", TfMessage::TYPE_NAME, Kind::StaticTransforms);
        add("/tf", TfMessage::TYPE_NAME, Kind::Transforms);
        add(&params.odometry_topic, Odometry::TYPE_NAME, Kind::Odometry);
        add(&params.imu_topic, Imu::TYPE_NAME, Kind::Imu);
        add(&params.pose_topic, PoseStamped::TYPE_NAME, Kind::TruePose);
        let depth_type = image(self.is_depth_compressed);
        add(&params.depth_topic, depth_type, Kind::Depth);
        if self.has_depth_topic {
            let info_topic = info_beside(&params.depth_topic);
            add(&info_topic, CameraInfo::TYPE_NAME, Kind::DepthCameraInfo);
        }
        if let Some(second) = &self.second {
            let second_type = image(second.is_compressed);
            add(&second.images, second_type, Kind::SecondImage);
            add(&second.info, CameraInfo::TYPE_NAME, Kind::SecondCameraInfo);
        }
        topics
    }

    /// Takes the messages of one topic. Those that do not decode are left out: what they lack shows where it is missed.
    pub(crate) fn sink(&self, kind: Kind) -> impl Fn(Vec<u8>) + Send + Sync + 'static {
        let received = Arc::clone(&self.received);
        move |payload| {
            if let Err(reason) = lock(&received).take(kind, payload) {
                tracing::debug!("a message is left out: {reason}");
            }
        }
    }

    /// Whether the calibration of the depth camera has come, where there is a depth topic.
    pub(crate) fn has_depth_info(&self) -> bool {
        !self.has_depth_topic || lock(&self.received).depth_info.is_some()
    }

    /// How depth images of a frame lie to the images.
    pub(crate) fn registration(&self, camera_frame: &str, depth_frame: &str) -> Registration {
        let received = lock(&self.received);
        let colour = Calibrated {
            frame_id: camera_frame,
            info: received.info.as_ref(),
        };
        let depth = Calibrated {
            frame_id: depth_frame,
            info: received.depth_info.as_ref(),
        };
        registration(&colour, &depth, &received.transforms)
    }

    /// Lens of the second camera and how it is mounted, once its calibration has come; `None` where the topics say neither.
    pub(crate) fn second_camera(
        &self,
        image_topic: &str,
        camera_frame: &str,
    ) -> Option<(CameraModel, Rigid)> {
        let topics = self.second.as_ref()?;
        let received = lock(&self.received);
        let (first, second) = (received.info.as_ref()?, received.second_info.as_ref()?);
        let lens = lens_of_camera_info(second, is_rectified(&topics.images, second)).ok()?;
        let first = OfPair {
            topic: image_topic,
            frame_id: camera_frame,
            info: first,
        };
        let of_second = OfPair {
            topic: &topics.images,
            frame_id: &second.header.frame_id,
            info: second,
        };
        Some((lens, mounted(&first, &of_second, &received.transforms)?))
    }

    /// The lens by the newest calibration; `None` before the first.
    pub(crate) fn lens(&self, image_topic: &str) -> Option<Result<CameraModel, String>> {
        let info = lock(&self.received).info.clone()?;
        let is_rectified = is_rectified(image_topic, &info);
        Some(lens_of_camera_info(&info, is_rectified))
    }

    /// Whether transforms lead from the camera to odometry's frame.
    pub(crate) fn reaches_odometry(&self, camera_frame: &str) -> bool {
        let received = lock(&self.received);
        received.transforms.reaches(camera_frame, &self.odom_frame)
    }

    pub(crate) fn has_moving_transforms(&self) -> bool {
        lock(&self.received).has_moving_transforms
    }

    /// How the camera is mounted on the frame that odometry moves; `None` while no transform says.
    pub(crate) fn mount(&self, camera_frame: &str) -> Option<(String, Option<Rigid>)> {
        let received = lock(&self.received);
        let (base, _) = received.odometry.as_ref()?;
        Some((base.clone(), received.transforms.fixed(base, camera_frame)))
    }

    /// A frame that is fixed to another.
    pub(crate) fn fixed(&self, parent: &str, child: &str) -> Option<Rigid> {
        lock(&self.received).transforms.fixed(parent, child)
    }

    /// What belongs to an image, and whether all of it is there that may still come.
    pub(crate) fn companions(
        &self,
        camera_frame: &str,
        stamp: Stamp,
        uses_transforms: bool,
    ) -> (Companions, bool) {
        let received = lock(&self.received);
        let odometry = if let Some((base, track)) = &received.odometry {
            let mount = received.transforms.fixed(base, camera_frame);
            track
                .between(stamp)
                .map(|odom_from_base| odom_from_base * mount.unwrap_or(Rigid::IDENTITY))
        } else if uses_transforms {
            {
                let transforms = &received.transforms;
                transforms.moving(&self.odom_frame, camera_frame, stamp)
            }
        } else {
            None
        };
        let truth = received.poses.nearest(stamp, TRUTH_WITHIN_NANOS);
        let depth_within = (1e9 * self.params.depth_tolerance) as u64;
        let depth = nearest(&received.depths, stamp, depth_within);
        let second = self.second.as_ref();
        let second = second.and_then(|s| nearest(&received.seconds, stamp, s.within_nanos));
        let is_whole = (odometry.is_some() || !(self.has_odometry_topic || uses_transforms))
            && (truth.is_some() || self.params.pose_topic.is_empty())
            && (depth.is_some() || !self.has_depth_topic)
            && (second.is_some() || self.second.is_none())
            && !received.imu.is_behind(stamp);
        let companions = Companions {
            odometry,
            truth,
            depth,
            second,
        };
        (companions, is_whole)
    }

    /// How the IMU is mounted, `cam_from_imu`, by tf or by its parameter; `None` while neither says, or no sample has come.
    fn imu_mount(&self, received: &CompanionState, camera_frame: &str) -> Option<Rigid> {
        let imu_frame = received.imu.frame_id();
        let is_named = !imu_frame.is_empty() && !camera_frame.is_empty();
        let by_tf = received.transforms.between(camera_frame, imu_frame);
        let by_params = || extrinsic_of(&self.params).ok().flatten();
        by_tf.filter(|_| is_named).or_else(by_params)
    }

    pub(crate) fn has_imu_topic(&self) -> bool {
        !self.params.imu_topic.is_empty()
    }

    /// What the IMU measured up to an image; what is before it is asked for once.
    pub(crate) fn take_imu(&self, camera_frame: &str, stamp: Stamp) -> Option<ImuSpan> {
        let mut received = lock(&self.received);
        let cam_from_imu = self.imu_mount(&received, camera_frame)?;
        let mounted = MountedImu::new(&cam_from_imu, &self.params);
        received.imu.take_until(stamp, &mounted)
    }

    /// Why an IMU is not used whose samples come, or why none come; `None` where nothing is wrong.
    pub(crate) fn imu_fault(&self, camera_frame: &str) -> Option<String> {
        let topic = &self.params.imu_topic;
        let received = lock(&self.received);
        if topic.is_empty() {
            None
        } else if received.imu.newest().is_none() {
            Some(format!("no samples on {topic:?} (source.imu_topic)"))
        } else if self.imu_mount(&received, camera_frame).is_none() {
            Some(format!(
                "tf does not lead from the camera {camera_frame:?} to the IMU {:?}: publish it on /tf_static, or set source.imu_extrinsic",
                received.imu.frame_id()
            ))
        } else {
            None
        }
    }

    /// Time begins anew: what moved before is of no use, how things are mounted is.
    #[cfg(feature = "ros2")]
    pub(crate) fn forget_times(&self) {
        let mut received = lock(&self.received);
        received
            .transforms
            .forget_before(Stamp::from_nanos(i64::MAX));
        received.odometry = None;
        received.poses = Track::default();
        received.depths.clear();
        received.seconds.clear();
        received.imu.clear();
    }
}

impl CompanionState {
    fn take(&mut self, kind: Kind, payload: Vec<u8>) -> Result<(), String> {
        match kind {
            Kind::CameraInfo => self.info = Some(decoded(&payload)?),
            Kind::DepthCameraInfo => self.depth_info = Some(decoded(&payload)?),
            Kind::SecondCameraInfo => self.second_info = Some(decoded(&payload)?),
            Kind::StaticTransforms => {
                self.transforms.insert(&decoded(&payload)?, true);
            }
            Kind::Transforms => {
                let message: TfMessage = decoded(&payload)?;
                self.has_moving_transforms = true;
                self.transforms.insert(&message, false);
                let newest = message.transforms.last().map(|t| t.header.stamp);
                self.tidy(newest.map(Stamp::from));
            }
            Kind::Odometry => {
                let message: Odometry = decoded(&payload)?;
                let stamp = message.header.stamp.into();
                if let Some(pose) = message.pose.pose.to_rigid() {
                    let base = message.child_frame_id;
                    let (_, track) = self.odometry.get_or_insert((base, Track::default()));
                    track.insert(stamp, pose);
                }
                self.tidy(Some(stamp));
            }
            Kind::Imu => self.imu.push(&payload)?,
            Kind::TruePose => {
                let message: PoseStamped = decoded(&payload)?;
                let stamp = message.header.stamp.into();
                if let Some(pose) = message.pose.to_rigid() {
                    self.poses.insert(stamp, pose);
                }
                self.tidy(Some(stamp));
            }
            Kind::Depth => hold(&mut self.depths, payload)?,
            Kind::SecondImage => hold(&mut self.seconds, payload)?,
        }
        Ok(())
    }

    fn tidy(&mut self, newest: Option<Stamp>) {
        self.n_messages += 1;
        let Some(newest) = newest.filter(|_| self.n_messages >= TIDY_EVERY) else {
            return;
        };
        self.n_messages = 0;
        let oldest = Stamp::from_nanos(newest.nanos.saturating_sub(KEPT_NANOS));
        self.transforms.forget_before(oldest);
        if let Some((_, track)) = &mut self.odometry {
            track.forget_before(oldest);
        }
        self.poses.forget_before(oldest);
    }
}

impl SecondTopics {
    /// As the parameters name them.
    fn of(params: &SourceParams) -> Option<Self> {
        let images = params.second_image_topic.clone();
        if images.is_empty() {
            return None;
        }
        let info = info_topic_of(&params.second_camera_info_topic, &images);
        Some(Self {
            is_compressed: is_compressed(&images),
            within_nanos: (1e9 * params.stereo_tolerance) as u64,
            images,
            info,
        })
    }
}

/// The image whose stamp is nearest, if it is near enough.
fn nearest(held: &VecDeque<(Stamp, Vec<u8>)>, stamp: Stamp, within_nanos: u64) -> Option<Vec<u8>> {
    let off = |(at, _): &&(Stamp, Vec<u8>)| at.nanos.abs_diff(stamp.nanos);
    let nearest = held.iter().min_by_key(off);
    let near = nearest.filter(|image| off(image) <= within_nanos);
    near.map(|(_, payload)| payload.clone())
}

fn decoded<T: Message + serde::de::DeserializeOwned>(payload: &[u8]) -> Result<T, String> {
    ros::decode(payload).map_err(|e| e.to_string())
}

/// Holds the newest images.
fn hold(images: &mut VecDeque<(Stamp, Vec<u8>)>, payload: Vec<u8>) -> Result<(), String> {
    let stamp = header_stamp(&payload, 0).ok_or("an image without a CDR header")?;
    images.push_back((stamp, payload));
    let n_bytes: usize = images.iter().map(|(_, payload)| payload.len()).sum();
    if images.len() > MAX_DEPTHS || n_bytes > MAX_DEPTH_BYTES {
        images.pop_front();
    }
    Ok(())
}

/// Whether the images of a topic are compressed, by the name that image_transport gives it.
fn is_compressed(topic: &str) -> bool {
    topic.ends_with("/compressedDepth") || topic.ends_with("/compressed")
}

fn lock(received: &Mutex<CompanionState>) -> MutexGuard<'_, CompanionState> {
    received.lock().unwrap_or_else(PoisonError::into_inner)
}
