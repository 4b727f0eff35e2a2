//! Turns of a camera by its images, and by a gyroscope -> bias, mount and delay of the gyroscope.
//!
//! The bias by relative turns is the first step of VINS-Mono's alignment (Qin et al. 2018, section V-B1); mount and delay are estimated
//! with it, since both show in the same residuals: a mount that is off by a small turn turns the rate, and a delay adds the rate's
//! change. What a motion does not show keeps what it was believed to be before.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{SMatrix, SVector};

use crate::inertial::noise::ImuNoise;
use crate::inertial::preintegration::Preintegrated;
use crate::stats::median;
use splat_types::transform::rotation_vector;

/// Standard deviations of what is believed before: turn of the mount in radians, delay in seconds.
const MOUNT_STD: f64 = 0.01;
const DELAY_STD: f64 = 0.01;
/// Residuals beyond so many standard deviations count for less (Cauchy's loss).
const LOSS_STD: f64 = 3.0;
const N_STEPS: usize = 6;
/// Fewer turns say nothing.
const MIN_TURNS: usize = 3;

type Normal = SMatrix<f64, 7, 7>;

/// A turn by a gyroscope between two times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredTurn {
    pub secs: f64,
    /// `first_from_second`.
    pub turn: DQuat,
    /// A small turn in the axes of the second time by the bias.
    pub by_gyro: DMat3,
    /// About each axis, rad^2.
    pub variance: f64,
    /// Rates at both times, rad/s.
    pub rates: [DVec3; 2],
}

impl MeasuredTurn {
    pub fn of(motion: &Preintegrated) -> Self {
        Self {
            secs: motion.secs,
            turn: motion.turn,
            by_gyro: motion.turn_by_gyro,
            variance: motion.turn_variance(),
            rates: motion.rates,
        }
    }

    /// This turn and then the next one.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        let back = DMat3::from_quat(next.turn.inverse());
        Self {
            secs: self.secs + next.secs,
            turn: (self.turn * next.turn).normalize(),
            by_gyro: back * self.by_gyro + next.by_gyro,
            variance: self.variance + next.variance,
            rates: [self.rates[0], next.rates[1]],
        }
    }

    /// With another bias, mount and delay.
    pub fn corrected(&self, gyro_bias: DVec3, mount: DVec3, delay_secs: f64) -> DQuat {
        let by_bias = DQuat::from_scaled_axis(self.by_gyro * gyro_bias);
        let mount = DQuat::from_scaled_axis(mount);
        // A delay moves both ends, by the rates there.
        let ends = self
            .rates
            .map(|rate| DQuat::from_scaled_axis(rate * delay_secs));
        mount * ends[0].inverse() * (self.turn * by_bias) * ends[1] * mount.inverse()
    }
}

/// A turn between two times, by the images and by the gyroscope.
#[derive(Debug, Clone)]
pub struct TurnPair {
    /// `first_from_second` of the camera.
    pub seen: DQuat,
    /// Standard deviation about each axis, rad.
    pub seen_std: f64,
    pub measured: MeasuredTurn,
}

/// What turns show of a gyroscope.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnAlignment {
    /// rad/s, on top of the bias that was integrated with.
    pub gyro_bias: DVec3,
    pub gyro_bias_std: f64,
    /// A small turn that the samples need to be in the camera's axes, and its standard deviation.
    pub mount: DVec3,
    pub mount_std: f64,
    /// Seconds by which the stamps of the IMU are late: what a sample shows has been so long before its stamp.
    pub delay_secs: f64,
    pub delay_std: f64,
    /// Standard deviations by which a turn is off, in the median over the turns; about 1.5 where all is as stated.
    pub misfit: f64,
}

/// `None` of too few turns.
pub fn align(pairs: &[TurnPair], noise: &ImuNoise) -> Option<TurnAlignment> {
    if pairs.len() < MIN_TURNS {
        return None;
    }
    let prior = [noise.gyro_bias, MOUNT_STD, DELAY_STD];
    let prior = |ix: usize| prior[ix / 3].powi(-2);
    let mut found = SVector::<f64, 7>::zeros();
    let mut normal = Normal::zeros();
    for _ in 0..N_STEPS {
        normal = Normal::from_diagonal(&SVector::from_fn(|ix, _| prior(ix)));
        let mut gradient: SVector<f64, 7> = SVector::from_fn(|ix, _| -prior(ix) * found[ix]);
        // Before the bias is known, all turns are off: what counts for less is what is off by more than they are.
        let bend = LOSS_STD.max(2.0 * typical_misfit(pairs, &found));
        for pair in pairs {
            let (residual, slope, std) = pair.linearised(&found);
            let squared = residual.length_squared() / (std * std);
            let weight = 1.0 / (std * std * (1.0 + squared / (3.0 * bend * bend)));
            let residual = SVector::<f64, 3>::from(residual.to_array());
            normal += weight * slope.transpose() * slope;
            gradient += weight * slope.transpose() * residual;
        }
        found += normal.cholesky()?.solve(&gradient);
    }
    let covariance = normal.try_inverse()?;
    let std = |range: std::ops::Range<usize>| {
        range.map(|i| covariance[(i, i)]).fold(0.0, f64::max).sqrt()
    };
    let vector = |at: usize| DVec3::new(found[at], found[at + 1], found[at + 2]);
    Some(TurnAlignment {
        gyro_bias: vector(0),
        gyro_bias_std: std(0..3),
        mount: vector(3),
        mount_std: std(3..6),
        delay_secs: found[6],
        delay_std: std(6..7),
        misfit: typical_misfit(pairs, &found),
    })
}

/// Standard deviations by which turns are off, in the median.
fn typical_misfit(pairs: &[TurnPair], at: &SVector<f64, 7>) -> f64 {
    let off = |pair: &TurnPair| {
        let (residual, _, std) = pair.linearised(at);
        residual.length() / std
    };
    median(&mut pairs.iter().map(off).collect::<Vec<f64>>()).unwrap_or(0.0)
}

impl TurnPair {
    /// What is left of the turn with (bias, mount, delay), the slope of what they explain, and the residual's standard deviation.
    fn linearised(&self, at: &SVector<f64, 7>) -> (DVec3, SMatrix<f64, 3, 7>, f64) {
        let vector = |i: usize| DVec3::new(at[i], at[i + 1], at[i + 2]);
        let measured = &self.measured;
        let turn = measured.corrected(vector(0), vector(3), at[6]);
        let residual = rotation_vector(turn.inverse() * self.seen);
        // To first order of small residuals, which is enough to converge by.
        let back = DMat3::from_quat(turn.inverse());
        let by_mount = back - DMat3::IDENTITY;
        let by_delay = measured.rates[1] - back * measured.rates[0];
        let mut slope = SMatrix::<f64, 3, 7>::zeros();
        for row in 0..3 {
            for column in 0..3 {
                slope[(row, column)] = measured.by_gyro.col(column)[row];
                slope[(row, 3 + column)] = by_mount.col(column)[row];
            }
            slope[(row, 6)] = by_delay[row];
        }
        (
            residual,
            slope,
            (self.seen_std.powi(2) + measured.variance).sqrt(),
        )
    }
}

#[cfg(test)]
mod tests;
