//! A corrected `map_from_odom` that jumps -> one that moves so slowly that controllers do not notice.
//!
//! What matters is where the robot seems to be, not where the odometry began: far from there a small turn would be a
//! long way. So both limits hold at the robot.

use glam::{DQuat, DVec3};

use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// A pause in the stamps counts as no more than this, so that what follows it is no jump.
const MAX_PAUSE_SECS: f64 = 0.5;

/// Follows a target at a bounded speed.
#[derive(Debug, Clone)]
pub struct CorrectionLimiter {
    max_speed_m_s: f64,
    max_turn_rad_s: f64,
    /// `map_from_odom` as it was last shown, and when; `None` before the first target.
    shown: Option<(Rigid, Stamp)>,
}

/// What to show at a stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slewed {
    pub map_from_odom: Rigid,
    /// How far the robot still is from where the target has it, metres and radians.
    pub left_m: f64,
    pub left_rad: f64,
}

impl CorrectionLimiter {
    /// Limits of the robot's apparent motion by corrections alone; not positive: there is no limit.
    pub fn new(max_speed_m_s: f64, max_turn_rad_s: f64) -> Self {
        let limit = |value: f64| if value > 0.0 { value } else { f64::INFINITY };
        Self {
            max_speed_m_s: limit(max_speed_m_s),
            max_turn_rad_s: limit(max_turn_rad_s),
            shown: None,
        }
    }

    /// The first target is shown at once; what is no pose is not followed.
    pub fn follow(&mut self, target: &Rigid, robot_in_odom: DVec3, stamp: Stamp) -> Slewed {
        let Some((shown, before)) = self.shown else {
            if target.is_finite() {
                self.shown = Some((*target, stamp));
            }
            return Slewed {
                map_from_odom: *target,
                left_m: 0.0,
                left_rad: 0.0,
            };
        };
        if !target.is_finite() || !robot_in_odom.is_finite() {
            return Slewed {
                map_from_odom: shown,
                left_m: 0.0,
                left_rad: 0.0,
            };
        }
        let secs = (stamp.secs() - before.secs()).clamp(0.0, MAX_PAUSE_SECS);
        let turn = shown.angle_to(target);
        let turn_share = share(turn, self.max_turn_rad_s * secs);
        let rotation = turned(shown.rotation, target.rotation, turn_share);
        let (from, to) = (
            shown.transform_point(robot_in_odom),
            target.transform_point(robot_in_odom),
        );
        let shift = from.distance(to);
        let shift_share = share(shift, self.max_speed_m_s * secs);
        let robot_in_map = from.lerp(to, shift_share);
        let next = Rigid::new(rotation, robot_in_map - rotation * robot_in_odom);
        let next = if turn_share >= 1.0 && shift_share >= 1.0 {
            *target
        } else {
            next
        };
        // Stamps may come out of order: time does not run back.
        let latest = if stamp.nanos > before.nanos {
            stamp
        } else {
            before
        };
        self.shown = Some((next, latest));
        Slewed {
            map_from_odom: next,
            left_m: shift * (1.0 - shift_share),
            left_rad: turn * (1.0 - turn_share),
        }
    }

    /// Shows the next target at once: the map is another one.
    pub fn restart(&mut self) {
        self.shown = None;
    }
}

fn share(left: f64, may: f64) -> f64 {
    // No limit times no time is no number; then nothing is too far.
    if left > may { may / left } else { 1.0 }
}

fn turned(from: DQuat, to: DQuat, share: f64) -> DQuat {
    let same_side = if from.dot(to) < 0.0 { -to } else { to };
    from.slerp(same_side, share).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(secs: f64) -> Stamp {
        Stamp::from_secs(secs)
    }

    fn jump() -> Rigid {
        Rigid::new(
            DQuat::from_scaled_axis(DVec3::new(0.02, -0.01, 0.3)),
            DVec3::new(1.5, -0.7, 0.1),
        )
    }

    /// The robot drives on while the map jumps; `each` sees its pose in the map before and after each frame.
    fn drive(slew: &mut CorrectionLimiter, n: usize, mut each: impl FnMut(f64, &Slewed, DVec3)) {
        for i in 0..n {
            let secs = i as f64 / 30.0;
            let robot = DVec3::new(40.0 + 0.5 * secs, 25.0, 0.0);
            let target = if i < 5 { Rigid::IDENTITY } else { jump() };
            let slewed = slew.follow(&target, robot, at(secs));
            each(secs, &slewed, robot);
        }
    }

    #[test]
    fn the_robot_never_jumps_and_arrives() {
        let mut slew = CorrectionLimiter::new(0.3, 0.1);
        let mut last: Option<(Rigid, DVec3)> = None;
        let mut end = None;
        drive(&mut slew, 1800, |_, slewed, robot| {
            let shown = slewed.map_from_odom;
            if let Some((before, _)) = last {
                // The same place in odom: only the correction moves it.
                let moved = shown
                    .transform_point(robot)
                    .distance(before.transform_point(robot));
                assert!(moved <= 0.3 / 30.0 + 1e-9, "{moved} m in a frame");
                assert!(before.angle_to(&shown) <= 0.1 / 30.0 + 1e-9);
            }
            last = Some((shown, robot));
            end = Some(*slewed);
        });
        let end = end.unwrap();
        assert_eq!(end.map_from_odom, jump());
        assert_eq!((end.left_m, end.left_rad), (0.0, 0.0));
    }

    #[test]
    fn what_is_left_only_shrinks_and_takes_as_long_as_the_limits_say() {
        let mut slew = CorrectionLimiter::new(0.5, 0.2);
        let (mut lefts, mut arrived) = (Vec::new(), None);
        drive(&mut slew, 4000, |secs, slewed, _| {
            lefts.push(slewed.left_rad);
            if secs > 0.2 && slewed.left_m == 0.0 && slewed.left_rad == 0.0 {
                arrived.get_or_insert(secs);
            }
        });
        assert!(lefts[6..].windows(2).all(|two| two[1] <= two[0] + 1e-12));
        // 0.30 rad at 0.2 rad/s; some 12 m away from where odometry began, at 0.5 m/s.
        let shift = jump().transform_point(DVec3::new(40.0, 25.0, 0.0));
        let needed = shift.distance(DVec3::new(40.0, 25.0, 0.0)) / 0.5;
        let arrived = arrived.unwrap();
        assert!(
            (arrived - needed).abs() < 0.1 * needed + 1.0,
            "{arrived} {needed}"
        );
    }

    #[test]
    fn the_first_target_and_one_after_a_restart_are_shown_at_once() {
        let mut slew = CorrectionLimiter::new(0.1, 0.1);
        let first = slew.follow(&jump(), DVec3::ZERO, at(0.0));
        assert_eq!(first.map_from_odom, jump());
        let second = slew.follow(&Rigid::IDENTITY, DVec3::ZERO, at(0.1));
        assert_ne!(second.map_from_odom, Rigid::IDENTITY);
        slew.restart();
        let third = slew.follow(&Rigid::IDENTITY, DVec3::ZERO, at(0.2));
        assert_eq!(third.map_from_odom, Rigid::IDENTITY);
    }

    #[test]
    fn pauses_old_stamps_and_broken_poses_are_no_jumps() {
        let mut slew = CorrectionLimiter::new(0.2, 0.1);
        slew.follow(&Rigid::IDENTITY, DVec3::ZERO, at(10.0));
        let target = Rigid::new(DQuat::IDENTITY, DVec3::X * 9.0);
        let late = slew.follow(&target, DVec3::ZERO, at(1000.0));
        assert!(late.map_from_odom.translation.x <= 0.2 * MAX_PAUSE_SECS + 1e-12);
        let early = slew.follow(&target, DVec3::ZERO, at(5.0));
        assert_eq!(early.map_from_odom, late.map_from_odom);
        let broken = Rigid::new(DQuat::IDENTITY, DVec3::NAN);
        let held = slew.follow(&broken, DVec3::ZERO, at(1001.0));
        assert_eq!(held.map_from_odom, late.map_from_odom);
        let mut unbound = CorrectionLimiter::new(0.0, 0.0);
        unbound.follow(&Rigid::IDENTITY, DVec3::ZERO, at(0.0));
        let there = unbound.follow(&target, DVec3::ZERO, at(0.0));
        assert_eq!(there.map_from_odom, target);
    }
}
