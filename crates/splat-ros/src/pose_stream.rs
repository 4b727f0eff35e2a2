//! What the poses that go out remember from one frame to the next: odometry, the limited correction, the newest pose.

use crate::odometry::{Odometer, RobotPose};
use crate::params::PublishParams;
use crate::slew::CorrectionLimiter;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

/// What changes with every frame.
#[derive(Debug)]
pub(crate) struct PoseStream {
    pub(crate) odometer: Odometer,
    slew: CorrectionLimiter,
    pub(crate) newest: Option<Newest>,
}

impl PoseStream {
    /// `mount` is `base_from_cam` of the parameters.
    pub(crate) fn new(mount: Option<Rigid>, params: &PublishParams) -> Self {
        Self {
            odometer: Odometer::new(mount),
            slew: slew_of(params),
            newest: None,
        }
    }

    /// `map_from_odom` as navigation is to see it.
    pub(crate) fn slewed(&mut self, at: &RobotPose, stamp: Stamp) -> Rigid {
        let robot = at.odom_from_base.translation;
        let slewed = self.slew.follow(&at.map_from_odom(), robot, stamp);
        slewed.map_from_odom
    }
}

/// What the newest tracked frame said, for repeats of its transforms.
#[derive(Debug)]
pub(crate) struct Newest {
    pub(crate) at: RobotPose,
    pub(crate) since: Stopwatch,
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
