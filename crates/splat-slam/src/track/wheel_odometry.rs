//! Odometry that comes with the frames, such as that of wheels, as the tracker goes on by where the camera sees nothing.

use crate::track::odometry_link::OdometryLink;
use crate::visual_odometry::odometry::OdometryPose;
use splat_types::frame::Frame;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Faster than that, in metres and radians per second, odometry has begun anew: a driver that was started again.
const MAX_SPEED: f64 = 40.0;
const MAX_TURN_SPEED: f64 = 10.0;
const MIN_SECS: f64 = 0.02;

/// Poses by odometry, and how they lie in the map.
#[derive(Debug, Default)]
pub(crate) struct WheelOdometry {
    pub(crate) link: OdometryLink,
    last: Option<(Stamp, Rigid)>,
    /// Grows when odometry begins anew.
    segment: u32,
}

impl WheelOdometry {
    /// A frame without odometry is skipped.
    pub(crate) fn push(&mut self, frame: &Frame) {
        let Some(odometry_from_cam) = frame.odometry else {
            return;
        };
        if let Some((stamp, before)) = &self.last {
            let step = before.inverse() * odometry_from_cam;
            let secs = frame.stamp.secs_since(*stamp).abs().max(MIN_SECS);
            let turn = step.angle_to(&Rigid::IDENTITY);
            if step.translation.length() > MAX_SPEED * secs || turn > MAX_TURN_SPEED * secs {
                self.segment += 1;
            }
        }
        self.last = Some((frame.stamp, odometry_from_cam));
        let pose = OdometryPose {
            segment: self.segment,
            odometry_from_cam,
            // What a way adds is what the map has seen odometry drift by (`OdometryLink`).
            covariance: Default::default(),
            n_inliers: 0,
        };
        self.link.push(frame.seq, Some(pose));
    }
}
