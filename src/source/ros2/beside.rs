//! What comes beside the pictures: calibration, transforms, odometry, true poses, depth. Newest wins, old is forgotten.
//!
//! Filled on the node's thread, asked on the source's.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use r2r::QosProfile;

use crate::camera::Lens;
use crate::clock::Stamp;
use crate::config::SourceParams;
use crate::pose::Rigid;
use crate::ros::odometry::Odometry;
use crate::ros::{self, CameraInfo, Image, Message, PoseStamped, TfMessage};
use crate::source::calibration::lens_of_camera_info;
use crate::source::ros2::link::{Link, LinkError};
use crate::source::survey::header_stamp;
use crate::source::topics::is_rectified;
use crate::source::truth::{Track, Transforms};

/// Transforms, odometry and poses are kept for so long.
const KEPT_NANOS: i64 = 30_000_000_000;
/// And looked through after so many messages.
const TIDY_EVERY: u32 = 256;
/// Depth pictures that wait for their picture, which may wait for calibration; and memory for them.
const MAX_DEPTHS: usize = 32;
const MAX_DEPTH_BYTES: usize = 64 << 20;
/// A true pose counts for a picture so near in time.
const TRUTH_WITHIN_NANOS: i64 = 50_000_000;

/// What was heard so far.
#[derive(Debug, Default)]
struct Heard {
    info: Option<CameraInfo>,
    transforms: Transforms,
    /// The frame that moves, and its poses.
    odometry: Option<(String, Track)>,
    poses: Track,
    depths: VecDeque<(Stamp, Vec<u8>)>,
    n_messages: u32,
    has_moving_transforms: bool,
}

/// The subscriptions beside the pictures.
#[derive(Debug)]
pub(super) struct Beside {
    heard: Arc<Mutex<Heard>>,
    odom_frame: String,
    pub(super) has_odometry_topic: bool,
    has_truth_topic: bool,
    has_depth_topic: bool,
}

/// What goes with one picture.
#[derive(Debug, Default)]
pub(super) struct Companions {
    pub(super) odometry: Option<Rigid>,
    pub(super) truth: Option<Rigid>,
    pub(super) depth: Option<Vec<u8>>,
}

impl Beside {
    pub(super) fn subscribe(
        link: &Link,
        info_topic: &str,
        params: &SourceParams,
    ) -> Result<Self, LinkError> {
        let beside = Self {
            heard: Arc::default(),
            odom_frame: link.live.choice("publish.odom_frame"),
            has_odometry_topic: !params.odometry_topic.is_empty(),
            has_truth_topic: !params.pose_topic.is_empty(),
            has_depth_topic: !params.depth_topic.is_empty(),
        };
        let sensor = QosProfile::sensor_data;
        // Reliable publishers suit a best-effort listener, too; latched ones are asked for what they said before.
        beside.hear::<CameraInfo>(link, info_topic, sensor(), |heard, info| {
            heard.info = Some(info);
        })?;
        let latched = QosProfile::default().keep_last(100).transient_local();
        beside.hear::<TfMessage>(link, "/tf_static", latched, |heard, message| {
            heard.transforms.insert(&message, true);
        })?;
        let moving = QosProfile::default().keep_last(100).best_effort();
        beside.hear::<TfMessage>(link, "/tf", moving.clone(), |heard, message| {
            heard.has_moving_transforms = true;
            heard.transforms.insert(&message, false);
            let newest = message.transforms.last().map(|t| t.header.stamp);
            heard.tidy(newest.map(Stamp::from));
        })?;
        if beside.has_odometry_topic {
            beside.hear::<Odometry>(
                link,
                &params.odometry_topic,
                moving.clone(),
                |heard, message| {
                    let stamp = message.header.stamp.into();
                    if let Some(pose) = message.pose.pose.to_rigid() {
                        let base = message.child_frame_id;
                        let (_, track) = heard.odometry.get_or_insert((base, Track::default()));
                        track.insert(stamp, pose);
                    }
                    heard.tidy(Some(stamp));
                },
            )?;
        }
        if beside.has_truth_topic {
            beside.hear::<PoseStamped>(link, &params.pose_topic, moving, |heard, message| {
                let stamp = message.header.stamp.into();
                if let Some(pose) = message.pose.to_rigid() {
                    heard.poses.insert(stamp, pose);
                }
                heard.tidy(Some(stamp));
            })?;
        }
        if beside.has_depth_topic {
            let heard = Arc::clone(&beside.heard);
            link.subscribe(
                &params.depth_topic,
                Image::TYPE_NAME,
                sensor(),
                move |payload| {
                    if let Some(stamp) = header_stamp(&payload, 0) {
                        let depths = &mut lock(&heard).depths;
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
    fn hear<T: Message + serde::de::DeserializeOwned>(
        &self,
        link: &Link,
        topic: &str,
        qos: QosProfile,
        mut note: impl FnMut(&mut Heard, T) + Send + 'static,
    ) -> Result<(), LinkError> {
        let heard = Arc::clone(&self.heard);
        link.subscribe(topic, T::TYPE_NAME, qos, move |payload| {
            match ros::decode::<T>(&payload) {
                Ok(message) => note(&mut lock(&heard), message),
                Err(e) => tracing::debug!("a message is left out: {e}"),
            }
            true
        })
    }

    /// The lens by the newest calibration; `None` before the first.
    pub(super) fn lens(&self, image_topic: &str) -> Option<Result<Lens, String>> {
        let info = lock(&self.heard).info.clone()?;
        let is_rectified = is_rectified(image_topic, &info);
        Some(lens_of_camera_info(&info, is_rectified))
    }

    /// Whether transforms lead from the camera to odometry's frame.
    pub(super) fn reaches_odometry(&self, camera_frame: &str) -> bool {
        let heard = lock(&self.heard);
        heard.transforms.reaches(camera_frame, &self.odom_frame)
    }

    pub(super) fn has_moving_transforms(&self) -> bool {
        lock(&self.heard).has_moving_transforms
    }

    /// How the camera is mounted on the frame that odometry moves; `None` while no transform says.
    pub(super) fn mount(&self, camera_frame: &str) -> Option<(String, Option<Rigid>)> {
        let heard = lock(&self.heard);
        let (base, _) = heard.odometry.as_ref()?;
        Some((base.clone(), heard.transforms.fixed(base, camera_frame)))
    }

    /// A frame that is fixed to another.
    pub(super) fn fixed(&self, parent: &str, child: &str) -> Option<Rigid> {
        lock(&self.heard).transforms.fixed(parent, child)
    }

    /// What belongs to a picture, and whether all of it is there that may still come.
    pub(super) fn companions(
        &self,
        camera_frame: &str,
        stamp: Stamp,
        uses_transforms: bool,
    ) -> (Companions, bool) {
        let heard = lock(&self.heard);
        let odometry = if let Some((base, track)) = &heard.odometry {
            let mount = heard.transforms.fixed(base, camera_frame);
            track
                .between(stamp)
                .map(|odom_from_base| odom_from_base * mount.unwrap_or(Rigid::IDENTITY))
        } else if uses_transforms {
            {
                let transforms = &heard.transforms;
                transforms.moving(&self.odom_frame, camera_frame, stamp)
            }
        } else {
            None
        };
        let truth = heard.poses.nearest(stamp, TRUTH_WITHIN_NANOS);
        let depth = heard.depths.iter().find(|(at, _)| *at == stamp);
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
    pub(super) fn forget_times(&self) {
        let mut heard = lock(&self.heard);
        heard.transforms.forget_before(Stamp::from_nanos(i64::MAX));
        heard.odometry = None;
        heard.poses = Track::default();
        heard.depths.clear();
    }
}

impl Heard {
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

fn lock(heard: &Mutex<Heard>) -> MutexGuard<'_, Heard> {
    heard.lock().unwrap_or_else(PoisonError::into_inner)
}
