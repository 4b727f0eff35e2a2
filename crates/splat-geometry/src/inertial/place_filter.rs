//! Places of a camera and forces -> place and speed at the last frame, gravity, units per metre and the accelerometer's bias.
//!
//! With places in units of the poses, everything is linear in the speed, gravity, the units per metre and the bias times those. One
//! pass of a square-root information filter over all frames is the maximum-likelihood estimate. The length of gravity, which is known,
//! is a condition on the constants.

use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector, SMatrix};

use crate::inertial::frames::PosedFrame;
use crate::inertial::information::Information;
use crate::inertial::noise::{GRAVITY, ImuNoise};
use crate::inertial::preintegration::Preintegrated;
use crate::stats::median;

/// Where the unknowns stand: place of the IMU, its speed, gravity, units per metre, the accelerometer's bias in units.
pub(crate) const PLACE: usize = 0;
pub(crate) const SPEED: usize = 3;
pub(crate) const GRAVITY_AT: usize = 6;
pub(crate) const UNITS: usize = 9;
pub(crate) const FORCE_BIAS: usize = 10;
pub(crate) const N: usize = 13;
/// Those that move.
const N_MOVING: usize = 6;

/// Passes, since the noise of the forces in units depends on the unit.
const MAX_PASSES: usize = 6;
const SAME_UNIT: f64 = 0.02;
/// Gravity is known to such a share.
const GRAVITY_ERROR: f64 = 0.003;
/// Metres and m/s that say nothing, of what is not known.
const MAX_PLACE: f64 = 1e4;
const MAX_SPEED: f64 = 100.0;
/// Parts of the way that are left out in turn.
const N_BLOCKS: usize = 6;
/// What so few blocks understate: parts of blurred videos were off by 1.6 of the plain jackknife's standard deviations.
const FEW_BLOCKS: f64 = 1.5;
/// A unit that is known worse is not corrected; others are tried at least so far away; and a unit that is tried is as good as fixed.
const MAX_CORRECTED_STD: f64 = 0.1;
const MIN_STEP: f64 = 0.004;
const UNIT_WEIGHT: f64 = 1e5;

/// Values of all unknowns at the last frame, in units.
#[derive(Debug, Clone)]
pub(crate) struct Solution {
    pub(crate) values: DVector<f64>,
    pub(crate) covariance: DMatrix<f64>,
    /// Standard deviations by which all is off: 1 where the noise is as stated.
    pub(crate) misfit: f64,
}

impl Solution {
    pub(crate) fn vector(&self, at: usize) -> DVec3 {
        vector(&self.values, at)
    }
}

fn vector(values: &DVector<f64>, at: usize) -> DVec3 {
    DVec3::new(values[at], values[at + 1], values[at + 2])
}

/// `None` where the way shows no unit: hardly any acceleration. `lever`: where the IMU sits, in the camera's axes.
pub(crate) fn solve(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    lever: DVec3,
    noise: &ImuNoise,
) -> Option<Solution> {
    // Any unit does to begin with: where it is too small, forces only count for less.
    let mut units = first_units(frames);
    for _ in 0..MAX_PASSES {
        let found = pass(frames, motions, (lever, units), noise);
        let with = with_gravity(&found, units)?;
        let (values, covariance) = with.solve()?;
        let next = values[UNITS];
        if next.is_nan() || next <= 0.0 {
            return None;
        }
        let is_same = (next / units).ln().abs() < SAME_UNIT;
        units = next;
        if is_same {
            // Noise that is larger than stated widens everything.
            let variance = found.variance();
            let covariance = covariance * variance.max(1.0);
            let std = covariance[(UNITS, UNITS)].sqrt() / units;
            let best = (std < MAX_CORRECTED_STD)
                .then(|| without_attenuation(frames, motions, (lever, units, std), noise));
            return Some(Solution {
                values: best.flatten().unwrap_or(values),
                covariance,
                misfit: variance.sqrt(),
            });
        }
    }
    None
}

/// Standard deviation of the unit, as a share of it, by how much it hangs on single parts of the way: the jackknife (Efron 1982) over
/// blocks of time. Poses by images bend and stretch along the way, which no noise of single frames shows.
pub(crate) fn unit_scatter(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    (lever, units): (DVec3, f64),
    noise: &ImuNoise,
) -> f64 {
    let length = motions.len().div_ceil(N_BLOCKS);
    let without = |block: usize| {
        let is_left = |ix: usize| ix / length != block;
        let left = motions.iter().enumerate();
        let left: Vec<_> = left
            .map(|(ix, motion)| motion.clone().filter(|_| is_left(ix)))
            .collect();
        let known = pass(frames, &left, (lever, units), noise);
        let found = with_gravity(&known, units)?;
        Some((found.solve()?.0[UNITS] / units).max(1e-6).ln())
    };
    let logs: Vec<f64> = (0..N_BLOCKS).filter_map(without).collect();
    let n = logs.len() as f64;
    if logs.len() < N_BLOCKS {
        return f64::INFINITY;
    }
    let mean = logs.iter().sum::<f64>() / n;
    let squares = logs.iter().map(|log| (log - mean).powi(2)).sum::<f64>();
    FEW_BLOCKS * ((n - 1.0) / n * squares).sqrt()
}

/// The values with the unit that total least squares gives. Forces are what the unit is multiplied with, and their noise makes plain least
/// squares find it too small, as in any regression on what is measured with noise: minimal is the sum of the squares whose weights
/// follow the unit that is tried (Golub and Van Loan 1980; Deming's regression).
fn without_attenuation(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    (lever, units, std): (DVec3, f64, f64),
    noise: &ImuNoise,
) -> Option<DVector<f64>> {
    let with_unit = |units: f64| {
        let mut known = pass(frames, motions, (lever, units), noise);
        let mut unit = DMatrix::zeros(1, N + 1);
        (unit[(0, UNITS)], unit[(0, N)]) = (UNIT_WEIGHT / units, UNIT_WEIGHT);
        known.add(&unit);
        with_gravity(&known, units)
    };
    let step = std.max(MIN_STEP);
    let squares = |off: f64| Some(with_unit(units * off.exp())?.squares);
    let (below, middle, above) = (squares(-step)?, squares(0.0)?, squares(step)?);
    let bend = above + below - 2.0 * middle;
    let off = 0.5 * step * (below - above) / bend;
    let is_minimum = bend > 0.0 && off.abs() < 2.0 * step;
    let best = with_unit(units * if is_minimum { off.exp() } else { 1.0 })?;
    Some(best.solve()?.0)
}

/// Units per metre of a hand or a robot that moves by half a metre in a second.
fn first_units(frames: &[PosedFrame]) -> f64 {
    let speed = |two: &[PosedFrame]| {
        let way = two[0].world_from_cam.translation - two[1].world_from_cam.translation;
        way.length() / two[1].stamp.secs_since(two[0].stamp).max(1e-3)
    };
    let mut speeds: Vec<f64> = frames.windows(2).map(speed).collect();
    2.0 * median(&mut speeds).unwrap_or(1.0).max(1e-9)
}

/// One pass over all frames.
fn pass(
    frames: &[PosedFrame],
    motions: &[Option<Preintegrated>],
    (lever, units): (DVec3, f64),
    noise: &ImuNoise,
) -> Information {
    let mut known = Information::nothing(N);
    let mut bias = DMatrix::zeros(3, N + 1);
    (0..3).for_each(|i| bias[(i, FORCE_BIAS + i)] = 1.0 / (noise.accelerometer_bias * units));
    known.add(&bias);
    known.add(&seen_place(&frames[0], lever));
    for (two, motion) in frames.windows(2).zip(motions) {
        match motion {
            Some(motion) => {
                let rotation = two[0].world_from_cam.rotation_matrix();
                known.replace_first(N_MOVING, &moved(motion, &rotation, units, noise));
            }
            None => known.replace_first(N_MOVING, &moved_anyhow(units)),
        }
        known.add(&seen_place(&two[1], lever));
    }
    known
}

/// place - units R lever = the camera's place.
fn seen_place(frame: &PosedFrame, lever: DVec3) -> DMatrix<f64> {
    let weight = 1.0 / frame.std[0];
    let place = frame.world_from_cam.translation;
    let lever = frame.world_from_cam.rotation * lever;
    let mut rows = DMatrix::zeros(3, N + 1);
    for i in 0..3 {
        rows[(i, PLACE + i)] = weight;
        rows[(i, UNITS)] = -weight * lever[i];
        rows[(i, N)] = weight * place[i];
    }
    rows
}

/// How place and speed go on from one frame to the next, in standard deviations.
fn moved(motion: &Preintegrated, rotation: &DMat3, units: f64, noise: &ImuNoise) -> DMatrix<f64> {
    let (secs, n) = (motion.secs, N + N_MOVING);
    // Columns: moving before, moving after, constants, value.
    let (after, constants) = (N_MOVING, N_MOVING);
    let mut rows = DMatrix::zeros(6, n + 1);
    let (place, speed) = (*rotation * motion.place, *rotation * motion.speed);
    let by_bias = [
        *rotation * motion.place_by_accelerometer,
        *rotation * motion.speed_by_accelerometer,
    ];
    for i in 0..3 {
        rows[(i, after + PLACE + i)] = 1.0;
        rows[(i, PLACE + i)] = -1.0;
        rows[(i, SPEED + i)] = -secs;
        rows[(i, constants + GRAVITY_AT + i)] = -0.5 * secs * secs;
        rows[(i, constants + UNITS)] = -place[i];
        rows[(3 + i, after + SPEED + i)] = 1.0;
        rows[(3 + i, SPEED + i)] = -1.0;
        rows[(3 + i, constants + GRAVITY_AT + i)] = -secs;
        rows[(3 + i, constants + UNITS)] = -speed[i];
        for j in 0..3 {
            rows[(i, constants + FORCE_BIAS + j)] = -by_bias[0].col(j)[i];
            rows[(3 + i, constants + FORCE_BIAS + j)] = -by_bias[1].col(j)[i];
        }
    }
    let covariance = step_covariance(motion, rotation, noise) * (units * units);
    match covariance.cholesky() {
        Some(root) => root.l().solve_lower_triangular(&rows).unwrap_or(rows),
        None => rows,
    }
}

/// What moves is as good as not known any more, the constants are.
fn moved_anyhow(units: f64) -> DMatrix<f64> {
    let mut rows = DMatrix::zeros(N_MOVING, N + N_MOVING + 1);
    for i in 0..3 {
        rows[(i, N_MOVING + PLACE + i)] = 1.0 / (MAX_PLACE * units);
        rows[(3 + i, N_MOVING + SPEED + i)] = 1.0 / (MAX_SPEED * units);
    }
    rows
}

/// Of place and speed after a motion, metres.
pub(crate) fn step_covariance(
    motion: &Preintegrated,
    rotation: &DMat3,
    noise: &ImuNoise,
) -> SMatrix<f64, 6, 6> {
    let mut turned = SMatrix::<f64, 6, 9>::zeros();
    for row in 0..3 {
        for column in 0..3 {
            let at = rotation.col(column)[row];
            turned[(row, 6 + column)] = at;
            turned[(3 + row, 3 + column)] = at;
        }
    }
    let mut covariance = turned * motion.covariance() * turned.transpose();
    // The images' tilt is off anew in every frame, and gravity with it.
    let tilt = GRAVITY * noise.tilt * motion.secs;
    let (place, speed) = (0.5 * motion.secs * tilt, tilt);
    for i in 0..3 {
        covariance[(i, i)] += place * place;
        covariance[(3 + i, 3 + i)] += speed * speed;
        covariance[(i, 3 + i)] += place * speed;
        covariance[(3 + i, i)] += place * speed;
    }
    // Rounding of two samples' worth of noise keeps it positive.
    covariance + SMatrix::identity() * 1e-16
}

/// Solves with the length of gravity, which is units per metre times 9.81: a condition that is not linear, so a few times.
fn with_gravity(found: &Information, units: f64) -> Option<Information> {
    let (mut values, _) = found.solve()?;
    let mut with = found.clone();
    for _ in 0..4 {
        let direction = vector(&values, GRAVITY_AT).try_normalize()?;
        let weight = 1.0 / (GRAVITY_ERROR * GRAVITY * units);
        let mut row = DMatrix::zeros(1, N + 1);
        (0..3).for_each(|i| row[(0, GRAVITY_AT + i)] = weight * direction[i]);
        row[(0, UNITS)] = -weight * GRAVITY;
        with = found.clone();
        with.add(&row);
        (values, _) = with.solve()?;
    }
    Some(with)
}
