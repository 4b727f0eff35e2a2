//! The last poses -> where the camera is next, if it goes on as it went, and how far off that may be.

use glam::{DQuat, DVec3};
use nalgebra::Matrix6;

use crate::visual_odometry::odometry::turned_by;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, rotation_vector};

/// Motions are carried on over so many times the interval that they were measured over, then the camera counts as
/// standing: what was a swing of a tenth of a second says nothing of the next second.
const MAX_AHEAD: f64 = 4.0;
/// While nothing is seen, the motion may stop, double or begin at any moment: its own size, and at least so much per
/// second (a hand or a small robot: a third of the depth of the scene, half a radian).
const MIN_SPEED_DEPTHS: f64 = 0.3;
const MIN_TURN_RATE_RAD: f64 = 0.5;

/// A camera on its way.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    pub(crate) stamp: Stamp,
    pub(crate) cam_from_world: Rigid,
    /// Of the camera in its own axes at `stamp`.
    pub(crate) covariance: Matrix6<f64>,
    /// From the camera before to this one, and the seconds between them.
    step: Option<(Rigid, f64)>,
}

impl Motion {
    /// Goes on from `before`, if there was something not long ago.
    pub(crate) fn on(
        before: Option<&Self>,
        stamp: Stamp,
        cam_from_world: Rigid,
        covariance: Matrix6<f64>,
    ) -> Self {
        let step = before.and_then(|before| {
            let secs = stamp.secs_since(before.stamp);
            let step = cam_from_world * before.cam_from_world.inverse();
            (secs > 0.0).then_some((step, secs))
        });
        Self {
            stamp,
            cam_from_world,
            covariance,
            step,
        }
    }

    /// The camera at a later time.
    pub(crate) fn ahead(&self, stamp: Stamp) -> Rigid {
        let Some((step, secs)) = &self.step else {
            return self.cam_from_world;
        };
        let share = (stamp.secs_since(self.stamp) / secs).clamp(0.0, MAX_AHEAD);
        let turn = rotation_vector(step.rotation) * share;
        let next = Rigid::exp(DVec3::ZERO, turn) * self.cam_from_world;
        Rigid::new(next.rotation, next.translation + step.translation * share).renormalized()
    }

    /// The same where something has measured the turn since, `earlier_from_later`.
    pub(crate) fn ahead_turned(&self, stamp: Stamp, turn: Option<DQuat>) -> Rigid {
        let ahead = self.ahead(stamp);
        let Some(turn) = turn else {
            return ahead;
        };
        turned_by(&ahead, &self.cam_from_world, turn)
    }

    /// How far off `ahead` may be: the last pose's own covariance, and a motion that is as unknown as it is large.
    pub(crate) fn covariance_ahead(&self, stamp: Stamp, scene_depth: f64) -> Matrix6<f64> {
        let secs = stamp.secs_since(self.stamp).max(0.0);
        let (speed, turn_rate) = self.step.as_ref().map_or((0.0, 0.0), |(step, secs)| {
            let turn = rotation_vector(step.rotation).length();
            (step.translation.length() / secs, turn / secs)
        });
        let far = speed.max(MIN_SPEED_DEPTHS * scene_depth) * secs;
        let turned = turn_rate.max(MIN_TURN_RATE_RAD) * secs;
        let mut covariance = self.covariance;
        for axis in 0..3 {
            covariance[(axis, axis)] += far * far;
            covariance[(axis + 3, axis + 3)] += turned * turned;
        }
        covariance
    }

    /// Whether a pose is beyond what this motion could have led to, by far.
    pub(crate) fn is_elsewhere(
        &self,
        stamp: Stamp,
        cam_from_world: &Rigid,
        scene_depth: f64,
    ) -> bool {
        const MAX_STD: f64 = 4.0;
        let off = *cam_from_world * self.ahead(stamp).inverse();
        let covariance = self.covariance_ahead(stamp, scene_depth);
        let std = |axis: usize| covariance[(axis, axis)].sqrt();
        off.translation.length() > MAX_STD * std(0)
            || off.angle_to(&Rigid::IDENTITY) > MAX_STD * std(3)
    }

    /// The map has moved under the camera, which stays where it is by the keyframe that it was tracked by.
    pub(crate) fn moved(&mut self, new_from_old_world: &Rigid, unit: f64) {
        let world_from_cam = *new_from_old_world * self.cam_from_world.inverse();
        self.cam_from_world = world_from_cam.inverse();
        if let Some((step, _)) = &mut self.step {
            step.translation *= unit;
        }
        for axis in 0..3 {
            for other in 0..6 {
                self.covariance[(axis, other)] *= unit;
                self.covariance[(other, axis)] *= unit;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(secs: f64) -> Stamp {
        Stamp::from_secs(secs)
    }

    #[test]
    fn an_even_motion_goes_on_and_an_old_one_comes_to_rest() {
        let step = Rigid::exp(DVec3::new(0.1, 0.0, -0.05), DVec3::new(0.0, 0.02, 0.01));
        let first = Rigid::exp(DVec3::new(0.4, 0.3, 0.2), DVec3::new(0.3, -0.2, 0.1));
        let zero = Matrix6::zeros();
        let before = Motion::on(None, at(1.0), first, zero);
        assert_eq!(before.ahead(at(1.5)), first);
        let motion = Motion::on(Some(&before), at(1.1), step * first, zero);
        let next = motion.ahead(at(1.2));
        let wanted = step * step * first;
        assert!((next.translation - wanted.translation).length() < 3e-3);
        assert!(next.angle_to(&wanted) < 1e-9);
        // The same camera, written with the opposite quaternion.
        let mut negative = step * first;
        negative.rotation = -negative.rotation;
        let motion = Motion::on(Some(&before), at(1.1), negative, zero);
        assert!(motion.ahead(at(1.15)).angle_to(&motion.ahead(at(1.2))) < 0.02);
        assert_eq!(motion.ahead(at(2.0)), motion.ahead(at(9.0)));
        assert_eq!(
            motion.ahead(at(0.5)).translation,
            motion.cam_from_world.translation
        );
    }

    #[test]
    fn uncertainty_grows_with_the_time_that_nothing_is_seen() {
        let motion = Motion::on(None, at(1.0), Rigid::IDENTITY, Matrix6::identity() * 1e-6);
        let std = |secs: f64| {
            let covariance = motion.covariance_ahead(at(secs), 2.0);
            (covariance[(0, 0)].sqrt(), covariance[(4, 4)].sqrt())
        };
        assert!((std(1.0).0 - 1e-3).abs() < 1e-9);
        let (soon, late) = (std(1.2), std(2.0));
        assert!(late.0 > 4.0 * soon.0 && late.1 > 4.0 * soon.1 && late.0 > 0.5);
    }
}
