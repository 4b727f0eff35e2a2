//! An inertial measurement unit on the camera of a take: exact rates and forces of its way, with the noise of a MEMS sensor.

use glam::{DMat3, DQuat, DVec3};
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::take::{Take, gaussian};
use splat_types::inertial::{ImuModel, ImuSample, ImuSpan};
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, rotation_vector};

/// Added to the seed of a take.
const STREAM: u64 = 0x1_3e5a;
pub(crate) const RATE_HZ: f64 = 200.0;
pub const GRAVITY: f64 = 9.81;

/// Of the option `imu=1`: rad/s and m/s^2 per root of a hertz, what the biases walk by in a second (per root of one), and what they
/// begin with.
const GYRO_NOISE: f64 = 1e-3;
const ACCELEROMETER_NOISE: f64 = 1e-2;
const GYRO_WALK: f64 = 1e-5;
const ACCELEROMETER_WALK: f64 = 1e-4;
pub const GYRO_BIAS: DVec3 = DVec3::new(0.012, -0.008, 0.005);
pub const ACCELEROMETER_BIAS: DVec3 = DVec3::new(0.06, -0.04, 0.08);

/// Half of what derivatives of the way are taken over, in seconds: rounding and the third derivative are both below 1e-7 of it.
const HALF_STEP: f64 = 5e-4;

/// How the IMU is mounted: x forward, y left, z up, beside the lens.
pub fn cam_from_imu() -> Rigid {
    let looks_forward = DMat3::from_cols(DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y);
    let tilted = DQuat::from_rotation_z(0.03);
    Rigid::new(
        DQuat::from_mat3(&looks_forward) * tilted,
        DVec3::new(0.04, 0.025, -0.06),
    )
}

/// Samples of a take, one after the other, in the axes of the IMU.
#[derive(Debug)]
pub(crate) struct ImuTake<'a> {
    take: &'a Take,
    /// 1 is a MEMS sensor, 0 an exact one.
    noise: f64,
    random: Pcg32,
    gyro_bias: DVec3,
    accelerometer_bias: DVec3,
    next_ix: i64,
}

impl<'a> ImuTake<'a> {
    /// `None` where the take has no IMU. It begins before the first frame.
    pub(crate) fn new(take: &'a Take) -> Option<Self> {
        let noise = take.settings().imu?;
        Some(Self {
            take,
            noise,
            random: Pcg32::seed_from_u64(take.settings().seed ^ STREAM),
            gyro_bias: noise * GYRO_BIAS,
            accelerometer_bias: noise * ACCELEROMETER_BIAS,
            next_ix: -2,
        })
    }

    /// The samples up to the first that is not before `stamp`, without those that were given out.
    pub(crate) fn until(&mut self, stamp: Stamp) -> Vec<ImuSample> {
        let mut samples = Vec::new();
        let period = 1.0 / RATE_HZ;
        while samples.last().is_none_or(|s: &ImuSample| s.stamp < stamp) {
            // Beside the images' times, as clocks that know nothing of each other have it.
            let secs = (self.next_ix as f64 + 0.37) * period;
            let at = |ix: i64| self.stamp((ix as f64 + 0.37) * period);
            if samples.is_empty() && self.next_ix > -2 && at(self.next_ix - 1) >= stamp {
                break;
            }
            samples.push(self.measured(secs));
            self.next_ix += 1;
        }
        samples
    }

    fn stamp(&self, secs: f64) -> Stamp {
        let start = self.take.stamp(0).nanos;
        Stamp::from_nanos(start + (1e9 * secs).round() as i64)
    }

    fn measured(&mut self, secs: f64) -> ImuSample {
        let mut exact = exact(self.take, secs);
        let root = RATE_HZ.sqrt();
        let mut random = |std: f64| {
            let mut one = || f64::from(gaussian(&mut self.random));
            DVec3::new(one(), one(), one()) * (std * self.noise)
        };
        exact.angular_velocity += self.gyro_bias + random(GYRO_NOISE * root);
        exact.acceleration += self.accelerometer_bias + random(ACCELEROMETER_NOISE * root);
        self.gyro_bias += random(GYRO_WALK / root);
        self.accelerometer_bias += random(ACCELEROMETER_WALK / root);
        exact.stamp = self.stamp(secs);
        exact
    }
}

/// What an exact IMU measures so many seconds after the first frame.
fn exact(take: &Take, secs: f64) -> ImuSample {
    let mounted = cam_from_imu();
    let pose = |off: f64| take.pose_at(secs + off) * mounted;
    let (before, now, after) = (pose(-HALF_STEP), pose(0.0), pose(HALF_STEP));
    let turn = before.rotation.inverse() * after.rotation;
    let acceleration =
        (before.translation + after.translation - 2.0 * now.translation) / (HALF_STEP * HALF_STEP);
    let force = acceleration + GRAVITY * DVec3::Z;
    ImuSample {
        stamp: Stamp::default(),
        angular_velocity: rotation_vector(turn) / (2.0 * HALF_STEP),
        acceleration: now.rotation.inverse() * force,
    }
}

/// What goes with each frame of a take, in the camera's axes, as a source of frames has it.
pub fn spans(take: &Take) -> Vec<ImuSpan> {
    let Some(mut imu) = ImuTake::new(take) else {
        return Vec::new();
    };
    let mounted = cam_from_imu();
    let mut waiting: Vec<ImuSample> = Vec::new();
    let frames = 0..take.settings().n_frames;
    let span = |ix: u32| {
        waiting.extend(imu.until(take.stamp(ix)).into_iter().map(|s| ImuSample {
            angular_velocity: mounted.rotation * s.angular_velocity,
            acceleration: mounted.rotation * s.acceleration,
            ..s
        }));
        let samples = waiting.as_slice().into();
        let n_before = waiting.partition_point(|s| s.stamp < take.stamp(ix));
        waiting.drain(..n_before.saturating_sub(1));
        ImuSpan {
            samples,
            model: ImuModel {
                imu_in_cam: mounted.translation,
                ..ImuModel::default()
            },
        }
    };
    frames.map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::{SceneKind, SynthSettings};

    fn take(imu: f64) -> Take {
        let settings = SynthSettings {
            n_frames: 30,
            imu: Some(imu),
            shake: 4.0,
            ..SynthSettings::of(SceneKind::House)
        };
        Take::new(settings).unwrap()
    }

    #[test]
    fn rates_and_forces_integrate_to_the_way_of_the_camera() {
        let take = take(0.0);
        let samples = ImuTake::new(&take).unwrap().until(take.stamp(20));
        let mounted = cam_from_imu();
        let secs = |s: &ImuSample| s.stamp.secs_since(take.stamp(0));
        let pose = |s: &ImuSample| take.pose_at(secs(s)) * mounted;
        let speed = |s: &ImuSample| {
            let at = |off: f64| (take.pose_at(secs(s) + off) * mounted).translation;
            (at(1e-4) - at(-1e-4)) / 2e-4
        };
        let first = &samples[0];
        let (mut now, mut velocity) = (pose(first), speed(first));
        for two in samples.windows(2) {
            let dt = secs(&two[1]) - secs(&two[0]);
            let middle = two[0].angular_velocity.lerp(two[1].angular_velocity, 0.5);
            let turned = now.rotation * DQuat::from_scaled_axis(middle * dt);
            let force = |s: &ImuSample, r: DQuat| r * s.acceleration - GRAVITY * DVec3::Z;
            let (a, b) = (force(&two[0], now.rotation), force(&two[1], turned));
            now.translation += velocity * dt + (2.0 * a + b) / 6.0 * dt * dt;
            now.rotation = turned;
            velocity += 0.5 * (a + b) * dt;
        }
        let last = pose(samples.last().unwrap());
        let (off, turn) = (
            now.translation.distance(last.translation),
            now.angle_to(&last),
        );
        assert!(off < 1e-3 && turn < 1e-4, "{off} m, {turn} rad after 2 s");
    }

    #[test]
    fn spans_of_frames_overlap_by_the_samples_about_the_frame() {
        let take = take(1.0);
        let spans = spans(&take);
        assert_eq!(spans.len(), 30);
        for (ix, span) in spans.iter().enumerate() {
            let stamp = take.stamp(ix as u32);
            let n = span.samples.len();
            assert!(span.samples[n - 1].stamp >= stamp && span.samples[n - 2].stamp < stamp);
            if ix > 0 {
                let before = take.stamp(ix as u32 - 1);
                assert!(span.samples[0].stamp < before && span.samples[1].stamp >= before);
            }
        }
    }

    #[test]
    fn noise_has_the_stated_densities() {
        let take = take(1.0);
        let frames_of = spans;
        let (noisy, exact) = (spans(&take), {
            let settings = SynthSettings {
                imu: Some(0.0),
                ..take.settings().clone()
            };
            frames_of(&Take::new(settings).unwrap())
        });
        let mounted = cam_from_imu().rotation;
        let pairs = noisy.iter().zip(&exact).flat_map(|(a, b)| {
            let two = a.samples.iter().zip(b.samples.iter());
            two.map(|(a, b)| {
                (
                    a.angular_velocity - b.angular_velocity,
                    a.acceleration - b.acceleration,
                )
            })
        });
        let (mut gyro, mut force, mut n) = (0.0, 0.0, 0.0);
        for (rate_off, force_off) in pairs {
            gyro += (rate_off - mounted * GYRO_BIAS).length_squared() / 3.0;
            force += (force_off - mounted * ACCELEROMETER_BIAS).length_squared() / 3.0;
            n += 1.0;
        }
        let density = |sum: f64| (sum / n / RATE_HZ).sqrt();
        assert!(
            (density(gyro) / GYRO_NOISE - 1.0).abs() < 0.08,
            "{}",
            density(gyro)
        );
        assert!(
            (density(force) / ACCELEROMETER_NOISE - 1.0).abs() < 0.08,
            "{}",
            density(force)
        );
    }
}
