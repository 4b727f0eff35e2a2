//! Wheel odometry of a take: the steps of a robot's base, each a little wrong, one after the other.

use glam::{DMat3, DQuat, DVec3};
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::take::{Take, gaussian};
use splat_types::transform::Rigid;

/// Added to the seed of a take.
const STREAM: u64 = 0x0d0_3e7e;

/// How the camera is mounted on the base (REP-103: x forward, y left, z up): ahead of the axle and above, looking forward.
pub(crate) fn base_from_cam() -> Rigid {
    let looks_forward = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    Rigid::new(DQuat::from_mat3(&looks_forward), DVec3::new(0.25, 0.0, 0.6))
}

/// Wheels slip for so many seconds, from that share of the take on.
const SLIP_SECS: f64 = 2.0;
const SLIPS_FROM: f64 = 1.0 / 3.0;

/// `odom_from_base` at every frame; the length of each step and its turn are off by `noise` (a normal share), and the length by
/// that of wheels that slip. Starts at the identity.
pub(crate) fn track(take: &Take, noise: f64) -> Vec<Rigid> {
    let mut random = Pcg32::seed_from_u64(take.settings().seed ^ STREAM);
    let cam_from_base = base_from_cam().inverse();
    let world_from_base = |ix: u32| take.pose(ix) * cam_from_base;
    let mut odom_from_base = Rigid::IDENTITY;
    let mut track = vec![odom_from_base];
    for ix in 1..take.settings().n_frames {
        let step = world_from_base(ix - 1).inverse() * world_from_base(ix);
        let mut share = || 1.0 + noise * f64::from(gaussian(&mut random));
        let turn = step.rotation.to_scaled_axis() * share();
        let length = share() * (1.0 + slip(take, ix));
        let noisy = Rigid::new(DQuat::from_scaled_axis(turn), step.translation * length);
        odom_from_base = (odom_from_base * noisy).renormalized();
        track.push(odom_from_base);
    }
    track
}

/// By what share the step to a frame is too long.
fn slip(take: &Take, ix: u32) -> f64 {
    let at = |ix: u32| take.stamp(ix).secs_since(take.stamp(0));
    let from = SLIPS_FROM * at(take.settings().n_frames);
    if (from..from + SLIP_SECS).contains(&at(ix)) {
        take.settings().slip
    } else {
        0.0
    }
}
