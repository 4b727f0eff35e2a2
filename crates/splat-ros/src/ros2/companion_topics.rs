//! What comes beside the images: calibration, transforms, odometry, true poses, depth. Newest wins, old is forgotten.
//!
//! Filled on the node's thread, asked on the source's.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use r2r::QosProfile;

use crate::ros2::error::LinkError;
use crate::ros2::node::Link;
use splat_io::calibration::lens_of_camera_info;
use splat_io::ground_truth::{Track, Transforms};
use splat_io::params::SourceParams;
use splat_io::survey::header_stamp;
use splat_io::topics::is_rectified;
use splat_msgs::ros::odometry::Odometry;
use splat_msgs::ros::{self, CameraInfo, Image, Message, PoseStamped, TfMessage};
use splat_types::camera::CameraModel;
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
struct CompanionState {
    info: Option<CameraInfo>,
    transforms: Transforms,
    /// The frame that moves, and its poses.
    odometry: Option<(String, Track)>,
    poses: Track,
    depths: VecDeque<(Stamp, Vec<u8>)>,
    n_messages: u32,
    has_moving_transforms: bool,
}

/// The subscriptions beside the images.
#[derive(Debug)]
pub(crate) struct Beside {
    received: Arc<Mutex<CompanionState>>,
    odom_frame: String,
    pub(crate) has_odometry_topic: bool,
    has_truth_topic: bool,
    has_depth_topic: bool,
}

/// What goes with one image.
#[derive(Debug, Default)]
pub(crate) struct Companions {
    pub(crate) odometry: Option<Rigid>,
    pub(crate) truth: Option<Rigid>,
    pub(crate) depth: Option<Vec<u8>>,
}

impl Beside {
    pub(crate) fn subscribe(
        link: &Link,
        info_topic: &str,
        params: &SourceParams,
    ) -> Result<Self, LinkError> {
        let beside = Self {
            received: Arc::default(),
            odom_frame: link.setup.odom_frame.clone(),
            has_odometry_topic: !params.odometry_topic.is_empty(),
            has_truth_topic: !params.pose_topic.is_empty(),
            has_depth_topic: !params.depth_topic.is_empty(),
        };
        let sensor = QosProfile::sensor_data;
        // Reliable publishers suit a best-effort listener, too; latched ones are asked for what they said before.
        beside.receive::<CameraInfo>(link, info_topic, sensor(), |received, info| {
            received.info = Some(info);
        })?;
        let latched = QosProfile::default().keep_last(100).transient_local();
        beside.receive::<TfMessage>(link, "/tf_static", latched, |received, message| {
            received.transforms.insert(&message, true);
        })?;
        let moving = QosProfile::default().keep_last(100).best_effort();
        beside.receive::<TfMessage>(link, "/tf", moving.clone(), |received, message| {
            received.has_moving_transforms = true;
            received.transforms.insert(&message, false);
            let newest = message.transforms.last().map(|t| t.header.stamp);
            received.tidy(newest.map(Stamp::from));
        })?;
        if beside.has_odometry_topic {
            beside.receive::<Odometry>(
                link,
                &params.odometry_topic,
                moving.clone(),
                |received, message| {
                    let stamp = message.header.stamp.into();
                    if let Some(pose) = message.pose.pose.to_rigid() {
                        let base = message.child_frame_id;
                        let (_, track) = received.odometry.get_or_insert((base, Track::default()));
                        track.insert(stamp, pose);
                    }
                    received.tidy(Some(stamp));
                },
            )?;
        }
        if beside.has_truth_topic {
            beside.receive::<PoseStamped>(
                link,
                &params.pose_topic,
                moving,
                |received, message| {
                    let stamp = message.header.stamp.into();
                    if let Some(pose) = message.pose.to_rigid() {
                        received.poses.insert(stamp, pose);
                    }
                    received.tidy(Some(stamp));
                },
            )?;
        }
        if beside.has_depth_topic {
            let received = Arc::clone(&beside.received);
            link.subscribe(
                &params.depth_topic,
                Image::TYPE_NAME,
                sensor(),
                move |payload| {
                    if let Some(stamp) = header_stamp(&payload, 0) {
                        let depths = &mut lock(&received).depths;
                        depths.push_back((stamp, payload));
                        let n_bytes: usize = depths.iter().map(|(_, payload)| payload.len()).sum();
                        if depths.len() > MAX_DEPTHS || n_bytes > MAX_DEPTH_BYTES {
                            depths.pop_front();
                        }
                    }
                    true
                },
            )?;
        }
        Ok(beside)
    }

    /// Messages that do not decode are left out: what they lack shows where it is missed.
    fn receive<T: Message + serde::de::DeserializeOwned>(
        &self,
        link: &Link,
        topic: &str,
        qos: QosProfile,
        mut note: impl FnMut(&mut CompanionState, T) + Send + 'static,
    ) -> Result<(), LinkError> {
        let received = Arc::clone(&self.received);
        link.subscribe(topic, T::TYPE_NAME, qos, move |payload| {
            match ros::decode::<T>(&payload) {
                Ok(message) => note(&mut lock(&received), message),
                Err(e) => tracing::debug!("a message is left out: {e}"),
            }
            true
        })
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
        let depth = received.depths.iter().find(|(at, _)| *at == stamp);
        let depth = depth.map(|(_, payload)| payload.clone());
        let is_whole = (odometry.is_some() || !(self.has_odometry_topic || uses_transforms))
            && (truth.is_some() || !self.has_truth_topic)
            && (depth.is_some() || !self.has_depth_topic);
        let companions = Companions {
            odometry,
            truth,
            depth,
        };
        (companions, is_whole)
    }

    /// Time begins anew: what moved before is of no use, how things are mounted is.
    pub(crate) fn forget_times(&self) {
        let mut received = lock(&self.received);
        received
            .transforms
            .forget_before(Stamp::from_nanos(i64::MAX));
        received.odometry = None;
        received.poses = Track::default();
        received.depths.clear();
    }
}

impl CompanionState {
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

fn lock(received: &Mutex<CompanionState>) -> MutexGuard<'_, CompanionState> {
    received.lock().unwrap_or_else(PoisonError::into_inner)
}
