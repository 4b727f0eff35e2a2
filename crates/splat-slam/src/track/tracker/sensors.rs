//! Where the newest frame is by odometry of its images, and by what the source has beside the camera: wheels and an IMU.

use glam::DVec3;

use super::{Tracker, place_variance};
use crate::track::localize::transported;
use crate::track::odometry_link::{LinkedMotion, LinkedPose};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

impl Tracker {
    /// Whether odometry of the source disagrees with the camera and is left out.
    pub fn is_odometry_out(&self) -> bool {
        self.odometry.is_source_out()
    }

    /// What is wrong with the IMU, if anything is.
    pub fn imu_fault(&self) -> Option<&'static str> {
        self.odometry.inertial.fault()
    }

    /// Up in the axes of the newest frame's camera, where an IMU shows it.
    pub fn up_in_cam(&self) -> Option<DVec3> {
        self.odometry.inertial.up_in_cam()
    }

    /// A frame where odometry says, among the keyframes as they stand now: from the last frame that was found by landmarks or from
    /// the newest keyframe, whichever leaves the place more certain.
    pub(super) fn linked(&self, seq: u64) -> Option<(LinkedPose, Rigid)> {
        self.surest(self.odometry.locate(seq), |found| {
            self.odometry.motion(found, seq)
        })
    }

    /// The same by the odometry or the IMU that the source has.
    pub(super) fn linked_by_sensors(
        &mut self,
        (seq, stamp): (u64, Stamp),
    ) -> Option<(LinkedPose, Rigid)> {
        let by_wheels = self.surest(self.odometry.locate_by_wheels(seq), |found| {
            self.odometry.motion_by_wheels(found, seq)
        });
        let (depth, keyframes) = (self.scene_depth(), &self.keyframes);
        let inertial = &mut self.odometry.inertial;
        let mut by_imu = inertial.locate(stamp, depth, |anchor| keyframes.pose_by(anchor));
        if let Some((linked, _)) = &mut by_imu {
            linked.covariance += self.localizer().covariance_of_key(linked);
        }
        let both = [by_wheels, by_imu].into_iter().flatten();
        both.min_by(|a, b| {
            place_variance(&a.0.covariance).total_cmp(&place_variance(&b.0.covariance))
        })
    }

    /// A frame by where it is to a keyframe, or by the motion since the last frame that was found by landmarks.
    fn surest(
        &self,
        of_key: Option<LinkedPose>,
        since: impl Fn(u64) -> Option<LinkedMotion>,
    ) -> Option<(LinkedPose, Rigid)> {
        let by_key = || {
            let mut linked = of_key?;
            linked.covariance += self.localizer().covariance_of_key(&linked);
            let (world_from_key, _) = self.keyframes.get(&linked.keyframe_id)?;
            Some((linked, *world_from_key * linked.key_from_cam))
        };
        let by_frame = || {
            let found = self.search.found.as_ref()?;
            let motion = since(found.seq)?;
            let world_from_cam = self.pose_by(&found.anchor)? * motion.earlier_from_later;
            let (world_from_key, _) = self.keyframes.get(&found.anchor.keyframe_id)?;
            let of_found = transported(&found.covariance, &motion.earlier_from_later.inverse());
            let linked = LinkedPose {
                keyframe_id: found.anchor.keyframe_id,
                key_from_cam: world_from_key.inverse() * world_from_cam,
                covariance: of_found + motion.covariance,
                n_inliers: motion.n_inliers,
            };
            Some((linked, world_from_cam))
        };
        let both = [by_key(), by_frame()].into_iter().flatten();
        both.min_by(|a, b| {
            place_variance(&a.0.covariance).total_cmp(&place_variance(&b.0.covariance))
        })
    }
}
