//! Poses of a camera in an unknown unit, and what an IMU measured on the way -> bias, unit, gravity and speed, and from there the pose
//! where the camera sees nothing.
//!
//! First the turns, which need no unit (`turns`), then places and forces (`place_filter`): the two steps of the linear alignment of Qin
//! et al. 2018, section V-B, with the accelerometer's bias, and with places that have noise of their own instead of being exact.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::SMatrix;

use crate::inertial::frames::{Calibration, PosedFrame, integrated};
use crate::inertial::noise::{GRAVITY, ImuNoise};
use crate::inertial::place_filter::{
    FORCE_BIAS, GRAVITY_AT, N, PLACE, SPEED, Solution, UNITS, solve, step_covariance, unit_scatter,
};
use crate::inertial::preintegration::{Bias, Preintegrated};
use crate::inertial::turns::{self, MeasuredTurn, TurnAlignment, TurnPair};
use splat_types::inertial::ImuLog;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, rotation_vector, skew};

/// Turns are compared over so long.
const TURN_SECS: f64 = 0.8;
/// Frames, seconds and turns that an alignment needs.
const MIN_FRAMES: usize = 8;
const MIN_SECS: f64 = 2.0;
/// Delays beyond this are no delays of a driver, but wrong stamps.
pub const MAX_DELAY_SECS: f64 = 0.05;
/// A mount that is off by more is another one than was stated, rad.
pub const MAX_MOUNT: f64 = 0.15;
/// What a unit is believed to at worst.
pub const MAX_RELATIVE_STD: f64 = 0.1;
/// Motions are integrated anew where the calibration is otherwise by more: rad/s, rad, s.
const NEAR_BIAS: f64 = 2e-3;
const NEAR_MOUNT: f64 = 1e-3;
const NEAR_DELAY_SECS: f64 = 5e-4;
/// Of cameras on hands and robots, m/s.
const MAX_SPEED: f64 = 1.0;
/// Frames that lie further apart in time are not tied to each other.
const MAX_STEP_SECS: f64 = 2.0;
/// The last turns that give the turn of the last frame, by the gyroscope in between.
const SMOOTHED_SECS: f64 = 0.5;

/// Why there is no alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unaligned {
    /// Frames, or their time.
    TooFew,
    /// Samples don't reach, or leave gaps.
    Gaps,
    /// Its stamps are off by so many seconds.
    Delay(f64),
    /// It is mounted otherwise than stated, by so many radians.
    Mount(f64),
}

/// What frames and samples show together.
#[derive(Debug, Clone)]
pub struct InertialAlignment {
    /// The last frame.
    pub stamp: Stamp,
    pub calibration: Calibration,
    /// Standard deviation of the gyroscope's bias, rad/s.
    pub gyro_bias_std: f64,
    /// Up, as a direction in the world of the poses, and its standard deviation about each level axis, rad.
    pub up: DVec3,
    pub tilt_std: f64,
    /// `None` where the way shows no unit: hardly any acceleration.
    pub metric: Option<MetricAlignment>,
    turn: DQuat,
    turn_std: f64,
}

/// What forces show of places.
#[derive(Debug, Clone)]
pub struct MetricAlignment {
    pub metres_per_unit: f64,
    /// Standard deviation of it as a share.
    pub relative_std: f64,
    /// Standard deviations by which all is off: 1 where the noise is as stated.
    pub misfit: f64,
    solution: Solution,
}

/// A pose by the samples since the last frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedPose {
    pub world_from_cam: Rigid,
    /// In the world's axes and units.
    pub place_covariance: DMat3,
    /// Standard deviation about each axis, rad.
    pub turn_std: f64,
}

/// Aligns frames in order of time with the samples between them; `before` is what is known of the sensor.
///
/// # Errors
///
/// Where they cannot be aligned, or are not of one body.
pub fn align(
    frames: &[PosedFrame],
    log: &ImuLog,
    before: &Calibration,
    noise: &ImuNoise,
) -> Result<InertialAlignment, Unaligned> {
    let secs = match frames {
        [first, .., last] => last.stamp.secs_since(first.stamp),
        _ => 0.0,
    };
    if frames.len() < MIN_FRAMES || secs < MIN_SECS {
        return Err(Unaligned::TooFew);
    }
    let Integrated {
        mut calibration,
        gyro_bias_std,
        motions,
        lever,
    } = integrate(frames, log, before, noise)?;
    let metric = solve(frames, &motions, lever, noise).map(MetricAlignment::of);
    if let Some(metric) = &metric {
        let bias = metric.solution.vector(FORCE_BIAS);
        calibration.bias.accelerometer = bias * metric.metres_per_unit;
    }
    let by_mean = mean_up(frames, &motions, noise);
    let level = metric.as_ref().map(MetricAlignment::up).into_iter();
    let level = level.chain(by_mean).min_by(|a, b| a.1.total_cmp(&b.1));
    let (up, tilt_std) = level.ok_or(Unaligned::Gaps)?;
    let last = frames.last().ok_or(Unaligned::TooFew)?;
    let (turn, turn_std) = smoothed_turn(frames, log, &calibration, noise);
    Ok(InertialAlignment {
        stamp: last.stamp,
        calibration,
        gyro_bias_std,
        up,
        tilt_std,
        metric,
        turn,
        turn_std,
    })
}

/// The same, for whom the unit counts: its standard deviation is no smaller than what it hangs on single parts of the way. Takes as long
/// again.
///
/// # Errors
///
/// As `align`.
pub fn align_for_unit(
    frames: &[PosedFrame],
    log: &ImuLog,
    before: &Calibration,
    noise: &ImuNoise,
) -> Result<InertialAlignment, Unaligned> {
    let mut found = align(frames, log, before, noise)?;
    if let Some(metric) = &mut found.metric {
        let of = integrate(frames, log, before, noise)?;
        let at = (of.lever, 1.0 / metric.metres_per_unit);
        let scatter = unit_scatter(frames, &of.motions, at, noise);
        metric.relative_std = metric.relative_std.max(scatter);
    }
    Ok(found)
}

/// Samples between frames with what turns show of the gyroscope.
struct Integrated {
    /// Without the accelerometer's bias.
    calibration: Calibration,
    gyro_bias_std: f64,
    /// What lies between each two frames; `None` is a gap.
    motions: Vec<Option<Preintegrated>>,
    /// Where the IMU sits, in the camera's axes.
    lever: DVec3,
}

fn integrate(
    frames: &[PosedFrame],
    log: &ImuLog,
    before: &Calibration,
    noise: &ImuNoise,
) -> Result<Integrated, Unaligned> {
    let mut calibration = before.with_measured_forces();
    let mut motions = motions(frames, log, &calibration, noise)?;
    let (mut turns, mut is_near) = align_turns(frames, &motions, &mut calibration, noise)?;
    if !is_near {
        // Once more with the samples that the first look made of them.
        motions = self::motions(frames, log, &calibration, noise)?;
        (turns, is_near) = align_turns(frames, &motions, &mut calibration, noise)?;
    }
    motions = if is_near {
        let by = Bias {
            gyro: turns.gyro_bias,
            accelerometer: DVec3::ZERO,
        };
        let correct = |motion: &Option<Preintegrated>| motion.as_ref().map(|m| m.corrected(&by));
        motions.iter().map(correct).collect()
    } else {
        self::motions(frames, log, &calibration, noise)?
    };
    Ok(Integrated {
        calibration,
        gyro_bias_std: turns.gyro_bias_std,
        lever: DQuat::from_scaled_axis(calibration.mount) * log.model().imu_in_cam,
        motions,
    })
}

/// Up by the mean force, and its standard deviation: over a while, what speeds a camera up and down cancels but for its speed.
fn mean_up(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    noise: &ImuNoise,
) -> Option<(DVec3, f64)> {
    let (mut sum, mut secs) = (DVec3::ZERO, 0.0);
    for (frame, motion) in frames.iter().zip(motions) {
        if let Some(motion) = motion {
            sum += frame.world_from_cam.rotation * motion.speed;
            secs += motion.secs;
        }
    }
    let by_speed = MAX_SPEED / (GRAVITY * secs);
    let by_bias = noise.accelerometer_bias / GRAVITY;
    Some((sum.try_normalize()?, by_speed.hypot(by_bias)))
}

/// Bias, mount and delay by the turns, into the calibration; and whether they are so near to those that the motions were integrated with
/// that a correction to first order does for those.
fn align_turns(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    calibration: &mut Calibration,
    noise: &ImuNoise,
) -> Result<(TurnAlignment, bool), Unaligned> {
    let found = turns::align(&turn_pairs(frames, motions), noise).ok_or(Unaligned::Gaps)?;
    calibration.bias.gyro += found.gyro_bias;
    let mount = DQuat::from_scaled_axis(found.mount) * DQuat::from_scaled_axis(calibration.mount);
    calibration.mount = mount.to_scaled_axis();
    calibration.delay_secs += found.delay_secs;
    if calibration.delay_secs.abs() > MAX_DELAY_SECS {
        return Err(Unaligned::Delay(calibration.delay_secs));
    }
    if calibration.mount.length() > MAX_MOUNT {
        return Err(Unaligned::Mount(calibration.mount.length()));
    }
    let is_near = found.gyro_bias.length() < NEAR_BIAS
        && found.mount.length() < NEAR_MOUNT
        && found.delay_secs.abs() < NEAR_DELAY_SECS;
    Ok((found, is_near))
}

/// Turns over `TURN_SECS` or more, one after the other.
fn turn_pairs(frames: &[PosedFrame], motions: &[Option<Preintegrated>]) -> Vec<TurnPair> {
    let mut pairs = Vec::new();
    let mut first = 0;
    let mut so_far: Option<MeasuredTurn> = None;
    for (ix, motion) in motions.iter().enumerate() {
        let Some(motion) = motion else {
            (first, so_far) = (ix + 1, None);
            continue;
        };
        let step = MeasuredTurn::of(motion);
        let measured = so_far.map_or(step, |so_far| so_far.then(&step));
        let [a, b] = [&frames[first], &frames[ix + 1]];
        if b.stamp.secs_since(a.stamp) < TURN_SECS {
            so_far = Some(measured);
            continue;
        }
        pairs.push(TurnPair {
            seen: a.world_from_cam.rotation.inverse() * b.world_from_cam.rotation,
            seen_std: a.std[1].hypot(b.std[1]),
            measured,
        });
        (first, so_far) = (ix + 1, None);
    }
    pairs
}

/// What lies between each two frames; `None` is a gap.
fn motions(
    frames: &[PosedFrame],
    log: &ImuLog,
    calibration: &Calibration,
    noise: &ImuNoise,
) -> Result<Vec<Option<Preintegrated>>, Unaligned> {
    let between = |two: &[PosedFrame]| {
        let times = (two[0].stamp, two[1].stamp);
        // Longer ones say less than their noise: biases are not exact either.
        if times.1.secs_since(times.0) > MAX_STEP_SECS {
            return None;
        }
        integrated(log, calibration, times, noise)
    };
    let motions: Vec<_> = frames.windows(2).map(between).collect();
    let n_whole = motions.iter().flatten().count();
    if n_whole + 1 < MIN_FRAMES {
        return Err(Unaligned::Gaps);
    }
    Ok(motions)
}

/// The turn of the last frame, by its own image and by those shortly before with the gyroscope in between.
fn smoothed_turn(
    frames: &[PosedFrame],
    log: &ImuLog,
    calibration: &Calibration,
    noise: &ImuNoise,
) -> (DQuat, f64) {
    let Some(last) = frames.last() else {
        return (DQuat::IDENTITY, 1.0);
    };
    let turn = last.world_from_cam.rotation;
    let (mut sum, mut weights) = (DVec3::ZERO, last.std[1].powi(-2));
    for frame in frames.iter().rev().skip(1) {
        if last.stamp.secs_since(frame.stamp) > SMOOTHED_SECS {
            break;
        }
        let times = (frame.stamp, last.stamp);
        let Some(motion) = integrated(log, calibration, times, noise) else {
            break;
        };
        let other = frame.world_from_cam.rotation * motion.turn;
        let by_gyro = motion.turn_variance();
        let weight = 1.0 / (frame.std[1].powi(2) + by_gyro);
        sum += weight * rotation_vector(turn.inverse() * other);
        weights += weight;
    }
    let turn = (turn * DQuat::from_scaled_axis(sum / weights)).normalize();
    (turn, weights.sqrt().recip())
}

impl MetricAlignment {
    fn of(solution: Solution) -> Self {
        let units = solution.values[UNITS];
        Self {
            metres_per_unit: 1.0 / units,
            relative_std: solution.covariance[(UNITS, UNITS)].sqrt() / units,
            misfit: solution.misfit,
            solution,
        }
    }

    /// Whether its unit is known well enough.
    pub fn has_unit(&self) -> bool {
        self.relative_std < MAX_RELATIVE_STD
    }

    /// Of the camera at the last frame, units per second.
    pub fn speed(&self) -> DVec3 {
        self.solution.vector(SPEED)
    }

    /// Up, and its standard deviation about the worse level axis.
    fn up(&self) -> (DVec3, f64) {
        let gravity = self.solution.vector(GRAVITY_AT);
        let block = self
            .solution
            .covariance
            .fixed_view::<3, 3>(GRAVITY_AT, GRAVITY_AT);
        let (a, b) = gravity.normalize().any_orthonormal_pair();
        let variance = |axis: DVec3| {
            let axis = nalgebra::Vector3::from(axis.to_array());
            (axis.transpose() * block * axis)[0]
        };
        let std = variance(a).max(variance(b)).sqrt() / gravity.length();
        (-gravity.normalize(), std)
    }
}

impl InertialAlignment {
    /// Where the camera is at a later time, by the samples since the last frame; `None` where they don't reach, or nothing is known of the
    /// speed at the last frame.
    pub fn predict(&self, log: &ImuLog, at: Stamp, noise: &ImuNoise) -> Option<PredictedPose> {
        let solution = &self.metric.as_ref()?.solution;
        let motion = self.motion(log, at, noise)?;
        let rotation = DMat3::from_quat(self.turn);
        let (secs, units) = (motion.secs, solution.values[UNITS]);
        let turn = (self.turn * motion.turn).normalize();
        let lever = DQuat::from_scaled_axis(self.calibration.mount) * log.model().imu_in_cam;
        let by_units = rotation * motion.place - turn * lever;
        let by_bias = rotation * motion.place_by_accelerometer;
        let mut slope = SMatrix::<f64, 3, N>::zeros();
        for i in 0..3 {
            slope[(i, PLACE + i)] = 1.0;
            slope[(i, SPEED + i)] = secs;
            slope[(i, GRAVITY_AT + i)] = 0.5 * secs * secs;
            slope[(i, UNITS)] = by_units[i];
            (0..3).for_each(|j| slope[(i, FORCE_BIAS + j)] = by_bias.col(j)[i]);
        }
        let place = slope * &solution.values;
        let known = slope * &solution.covariance * slope.transpose();
        let untilted = ImuNoise {
            tilt: 0.0,
            ..*noise
        };
        let step = step_covariance(&motion, &rotation, &untilted);
        // The turn of the last frame and the gyroscope's bias tilt the forces.
        let by_turn = units * rotation * skew(motion.place) * self.turn_std;
        let by_gyro = units * rotation * motion.place_by_gyro * self.gyro_bias_std;
        let mut place_covariance = by_turn * by_turn.transpose() + by_gyro * by_gyro.transpose();
        for column in 0..3 {
            for row in 0..3 {
                let own = known[(row, column)] + units * units * step[(row, column)];
                place_covariance.col_mut(column)[row] += own;
            }
        }
        Some(PredictedPose {
            world_from_cam: Rigid::new(turn, DVec3::new(place[0], place[1], place[2])),
            place_covariance,
            turn_std: self.turn_std_after(&motion),
        })
    }

    /// The turn of the camera at a later time, and its standard deviation about each axis, rad.
    pub fn predict_turn(&self, log: &ImuLog, at: Stamp, noise: &ImuNoise) -> Option<(DQuat, f64)> {
        let motion = self.motion(log, at, noise)?;
        let turn = (self.turn * motion.turn).normalize();
        Some((turn, self.turn_std_after(&motion)))
    }

    /// Since the last frame, with forces as they were measured.
    fn motion(&self, log: &ImuLog, at: Stamp, noise: &ImuNoise) -> Option<Preintegrated> {
        let calibration = self.calibration.with_measured_forces();
        integrated(log, &calibration, (self.stamp, at), noise)
    }

    fn turn_std_after(&self, motion: &Preintegrated) -> f64 {
        let by_bias = self.gyro_bias_std * motion.secs;
        (self.turn_std.powi(2) + by_bias.powi(2) + motion.turn_variance()).sqrt()
    }
}

#[cfg(test)]
mod tests;
