//! Whether odometry went on between two of its poses.

use splat_types::transform::Rigid;

/// Faster than that, in metres and radians per second, odometry has begun anew: a driver that was started again.
const MAX_SPEED: f64 = 40.0;
const MAX_TURN_SPEED: f64 = 10.0;
/// Stamps that are nearer to each other, in seconds, are as likely noise.
const MIN_SECS: f64 = 0.02;

/// Whether a motion in metres may have taken so many seconds.
pub fn is_continuous(step: &Rigid, secs: f64) -> bool {
    let secs = secs.abs().max(MIN_SECS);
    let turn = step.angle_to(&Rigid::IDENTITY);
    step.translation.length() <= MAX_SPEED * secs && turn <= MAX_TURN_SPEED * secs
}
