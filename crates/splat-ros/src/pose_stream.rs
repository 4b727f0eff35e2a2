//! Tracked frames -> pose, odometry and transforms of the robot; keyframes -> clouds for costmaps. Owned by one thread.

use std::sync::Arc;

use crate::error::PublishError;
use crate::navigation::{self, KEYFRAME_CLOUD, KeyframeDepth};
use crate::odometry::{FrameCells, Odometer, PoseEvent, RobotPose};
use crate::params::PublishParams;
use crate::pose_messages::LiveMessages;
use crate::publisher::Publisher;
use crate::reports::Reports;
use crate::slew::CorrectionLimiter;
use crate::transport::{Event, Sample};
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::{Rigid, parse_transform};

/// Seconds that transforms go on after the last frame.
const MAX_REPEAT_SECS: f64 = 1.0;

/// What changes with every frame.
#[derive(Debug)]
pub struct PoseStream {
    messages: LiveMessages,
    odometer: Odometer,
    slew: CorrectionLimiter,
    newest: Option<Newest>,
    /// Of the parameters, where the input names none.
    camera_frame: String,
    reports: Arc<Reports>,
    frames: Arc<FrameCells>,
}

/// What the newest tracked frame said, for repeats of its transforms.
#[derive(Debug, Clone, Copy)]
struct Newest {
    at: RobotPose,
    since: Stopwatch,
}

impl PoseStream {
    /// `mount` is `base_from_cam` of the parameters.
    pub(crate) fn new(
        mount: Option<Rigid>,
        params: &PublishParams,
        reports: Arc<Reports>,
        frames: Arc<FrameCells>,
    ) -> Self {
        Self {
            messages: LiveMessages::new(params),
            odometer: Odometer::new(mount),
            slew: slew_of(params),
            newest: None,
            camera_frame: params.camera_frame.clone(),
            reports,
            frames,
        }
    }

    /// Sends what a tracked frame says.
    pub fn live(&mut self, publisher: &Publisher, frame: &PoseEvent) -> Result<(), PublishError> {
        if let Some(mount) = self.reports.camera.get().base_from_cam {
            self.odometer.mount_by_input(mount);
        }
        let mut world = self.frames.tree();
        let at = self.odometer.advance(frame, &mut world);
        publisher.observe(&Event::Frame(&frame.tracked));
        self.frames.keep_anchor(&world);
        let Some(at) = at else {
            return Ok(());
        };
        let map_from_odom = self.slewed(&at, at.stamp);
        publisher.send(&self.messages.pose(&at)?)?;
        publisher.send(&self.messages.odometry(&at)?)?;
        let transforms = self
            .messages
            .transforms(&map_from_odom, &at, at.stamp, &world)?;
        self.newest = Some(Newest {
            at,
            since: Stopwatch::start(),
        });
        transforms.map_or(Ok(()), |post| publisher.send(&post))
    }

    /// Between frames: the newest transforms once more, so that nobody has to look back further than they like.
    pub fn repeat_transforms(&mut self, publisher: &Publisher) -> Result<(), PublishError> {
        let Some(Newest { at, since }) = self.newest else {
            return Ok(());
        };
        let secs = since.secs();
        if secs > MAX_REPEAT_SECS {
            return Ok(());
        }
        let nanos = at.stamp.nanos.saturating_add((secs * 1e9) as i64);
        let stamp = Stamp::from_nanos(nanos);
        let map_from_odom = self.slewed(&at, stamp);
        let world = self.frames.tree();
        let post = self
            .messages
            .transforms(&map_from_odom, &at, stamp, &world)?;
        post.map_or(Ok(()), |post| publisher.send(&post))
    }

    /// Sends a keyframe's depth as costmaps take it.
    pub fn keyframe(
        &self,
        publisher: &Publisher,
        seen: &KeyframeDepth,
    ) -> Result<(), PublishError> {
        let metres = self.frames.tree().metres_per_unit.unwrap_or(1.0);
        let camera = self.reports.camera.get();
        let frame = if camera.frame.is_empty() {
            &self.camera_frame
        } else {
            &camera.frame
        };
        publisher.observe(&Event::Keyframe {
            stamp: seen.stamp,
            image: &seen.image,
        });
        let cloud = navigation::keyframe_cloud(seen, metres, frame);
        publisher.send(&Sample::of(&KEYFRAME_CLOUD, seen.stamp, &cloud)?)
    }

    /// `map_from_odom` as navigation is to see it.
    fn slewed(&mut self, at: &RobotPose, stamp: Stamp) -> Rigid {
        let robot = at.odom_from_base.translation;
        let slewed = self.slew.follow(&at.map_from_odom(), robot, stamp);
        slewed.map_from_odom
    }
}

/// `base_from_cam` of the parameters; `None` where they leave it to the input.
pub(crate) fn mount_of(params: &PublishParams) -> Result<Option<Rigid>, PublishError> {
    if params.base_from_camera.is_empty() {
        return Ok(None);
    }
    let mount = parse_transform(&params.base_from_camera);
    mount.map(Some).ok_or_else(|| PublishError::Param {
        name: "mount",
        found: params.base_from_camera.clone(),
        expected: "seven numbers, x y z qx qy qz qw".to_owned(),
    })
}

/// No limit where corrections are to show at once.
fn slew_of(params: &PublishParams) -> CorrectionLimiter {
    if params.max_correction_speed > 0.0 {
        CorrectionLimiter::new(
            params.max_correction_speed,
            params.max_correction_rotation_deg.to_radians(),
        )
    } else {
        CorrectionLimiter::new(0.0, 0.0)
    }
}
