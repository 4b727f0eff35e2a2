//! Samples between two times -> one motion, whatever the pose and speed that it begins with (Forster et al. 2017, "On-Manifold
//! Preintegration for Real-Time Visual-Inertial Odometry", section VI).
//!
//! Between samples, rates and forces are taken to change evenly. For that signal turns are right to the fifth order of the time
//! between samples (Magnus expansion) and places to the fourth (Simpson's rule), instead of to the second as by the midpoint.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::SMatrix;

use crate::inertial::noise::ImuNoise;
use splat_types::inertial::ImuSample;
use splat_types::transform::skew;

/// Covariance of a turn in the axes of the second time, and of speed and place in those of the first.
pub type Covariance9 = SMatrix<f64, 9, 9>;

/// The motion between two times, in the axes of the first, without what gravity and the speed at the first add.
#[derive(Debug, Clone, PartialEq)]
pub struct Preintegrated {
    pub secs: f64,
    /// `first_from_second`.
    pub turn: DQuat,
    /// m/s.
    pub speed: DVec3,
    /// m.
    pub place: DVec3,
    /// Derivatives by the gyroscope's bias: a small turn in the axes of the second, of speed and of place.
    pub turn_by_gyro: DMat3,
    pub speed_by_gyro: DMat3,
    pub place_by_gyro: DMat3,
    /// And by the accelerometer's.
    pub speed_by_accelerometer: DMat3,
    pub place_by_accelerometer: DMat3,
    /// Rates at both ends, rad/s.
    pub rates: [DVec3; 2],
    uncertainty: Uncertainty,
}

/// Covariance of a turn, a speed and a place, by blocks. That of the turn is the same about every axis, as the gyroscope's noise is.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Uncertainty {
    turn: f64,
    speed_turn: DMat3,
    place_turn: DMat3,
    speed: DMat3,
    place_speed: DMat3,
    place: DMat3,
}

/// What a sensor is off by all the time: rad/s and m/s^2.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Bias {
    pub gyro: DVec3,
    pub accelerometer: DVec3,
}

/// A turn and its derivative by the gyroscope's bias, from the start to somewhere within.
#[derive(Debug, Clone, Copy)]
struct Turned {
    turn: DQuat,
    by_gyro: DMat3,
}

impl Turned {
    /// Goes on by a rate that changes evenly from `first` to `second` in `secs`.
    fn on(&self, (first, second): (DVec3, DVec3), secs: f64) -> Self {
        // Magnus expansion of R' = R [w] for a linear w, to the fourth order.
        let commutator = secs * secs / 12.0;
        let angle = 0.5 * secs * (first + second) + commutator * first.cross(second);
        let by_bias = -secs * DMat3::IDENTITY + commutator * (skew(second) - skew(first));
        let step = DQuat::from_scaled_axis(angle);
        let back = DMat3::from_quat(step.inverse());
        Self {
            turn: self.turn * step,
            by_gyro: back * self.by_gyro + right_jacobian(angle) * by_bias,
        }
    }

    /// A force, turned into the axes at the start, and its derivative by the gyroscope's bias.
    fn force(&self, force: DVec3) -> (DVec3, DMat3) {
        let rotation = DMat3::from_quat(self.turn);
        (rotation * force, -(rotation * skew(force)) * self.by_gyro)
    }
}

impl Preintegrated {
    /// Of samples in order of time; fewer than two are no motion.
    pub fn of(samples: &[ImuSample], bias: &Bias, noise: &ImuNoise) -> Self {
        let mut sum = Self {
            secs: 0.0,
            turn: DQuat::IDENTITY,
            speed: DVec3::ZERO,
            place: DVec3::ZERO,
            turn_by_gyro: DMat3::ZERO,
            speed_by_gyro: DMat3::ZERO,
            place_by_gyro: DMat3::ZERO,
            speed_by_accelerometer: DMat3::ZERO,
            place_by_accelerometer: DMat3::ZERO,
            rates: [samples.first(), samples.last()]
                .map(|s| s.map_or(DVec3::ZERO, |s| s.angular_velocity - bias.gyro)),
            uncertainty: Uncertainty::NONE,
        };
        for two in samples.windows(2) {
            sum.add(&two[0], &two[1], bias, noise);
        }
        sum.turn = sum.turn.normalize();
        sum
    }

    fn add(&mut self, first: &ImuSample, second: &ImuSample, bias: &Bias, noise: &ImuNoise) {
        let secs = second.stamp.secs_since(first.stamp);
        let rate = [first, second].map(|s| s.angular_velocity - bias.gyro);
        let force = [first, second].map(|s| s.acceleration - bias.accelerometer);
        let middle_rate = 0.5 * (rate[0] + rate[1]);
        let middle_force = 0.5 * (force[0] + force[1]);
        let start = Turned {
            turn: self.turn,
            by_gyro: self.turn_by_gyro,
        };
        let middle = start.on((rate[0], middle_rate), 0.5 * secs);
        let end = start.on((rate[0], rate[1]), secs);
        let seen = [
            start.force(force[0]),
            middle.force(middle_force),
            end.force(force[1]),
        ];
        let turned = [&start, &middle, &end].map(|t| DMat3::from_quat(t.turn));
        let back = DMat3::from_quat(end.turn.inverse()) * turned[0];
        let tilted = -(turned[0] * skew(middle_force));
        self.uncertainty.go_on((&back, &tilted), secs, noise);
        // Simpson's rule, once for the speed and twice for the place.
        let once = [1.0, 4.0, 1.0].map(|w| w * secs / 6.0);
        let twice = [1.0, 2.0, 0.0].map(|w| w * secs * secs / 6.0);
        self.place += self.speed * secs;
        self.place_by_gyro += self.speed_by_gyro * secs;
        self.place_by_accelerometer += self.speed_by_accelerometer * secs;
        for (ix, (force, by_gyro)) in seen.iter().enumerate() {
            self.place += twice[ix] * *force;
            self.place_by_gyro += twice[ix] * *by_gyro;
            self.place_by_accelerometer -= twice[ix] * turned[ix];
            self.speed += once[ix] * *force;
            self.speed_by_gyro += once[ix] * *by_gyro;
            self.speed_by_accelerometer -= once[ix] * turned[ix];
        }
        (self.turn, self.turn_by_gyro) = (end.turn, end.by_gyro);
        self.secs += secs;
    }

    /// Of the turn about each axis, rad^2.
    pub fn turn_variance(&self) -> f64 {
        self.uncertainty.turn
    }

    /// In rows and columns of turn, speed and place.
    pub fn covariance(&self) -> Covariance9 {
        let of = &self.uncertainty;
        let turn = of.turn * DMat3::IDENTITY;
        let blocks = [
            [turn, of.speed_turn.transpose(), of.place_turn.transpose()],
            [of.speed_turn, of.speed, of.place_speed.transpose()],
            [of.place_turn, of.place_speed, of.place],
        ];
        Covariance9::from_fn(|i, j| blocks[i / 3][j / 3].col(j % 3)[i % 3])
    }

    /// The same for a bias that is otherwise by a little, to first order (equation 44).
    #[must_use]
    pub fn corrected(&self, by: &Bias) -> Self {
        let turn = DQuat::from_scaled_axis(self.turn_by_gyro * by.gyro);
        Self {
            turn: (self.turn * turn).normalize(),
            speed: self.speed
                + self.speed_by_gyro * by.gyro
                + self.speed_by_accelerometer * by.accelerometer,
            place: self.place
                + self.place_by_gyro * by.gyro
                + self.place_by_accelerometer * by.accelerometer,
            ..self.clone()
        }
    }
}

impl Uncertainty {
    const NONE: Self = Self {
        turn: 0.0,
        speed_turn: DMat3::ZERO,
        place_turn: DMat3::ZERO,
        speed: DMat3::ZERO,
        place_speed: DMat3::ZERO,
        place: DMat3::ZERO,
    };

    /// Equation 62 of the paper over `secs`, by blocks: a turn goes `back` into the axes of the next sample, and tilts the force by
    /// `tilted` times itself.
    fn go_on(&mut self, (back, tilted): (&DMat3, &DMat3), secs: f64, noise: &ImuNoise) {
        let half = 0.5 * secs * secs;
        let turned = *tilted * self.turn;
        let forth = back.transpose();
        // Place and speed before their own rows change.
        let speed_tilt = *tilted * self.speed_turn.transpose();
        let place_tilt = *tilted * self.place_turn.transpose();
        let by_tilt = turned * tilted.transpose();
        let both = |m: DMat3| m + m.transpose();
        self.place += both(self.place_speed * secs + place_tilt * half)
            + self.speed * (secs * secs)
            + both(speed_tilt * (half * secs))
            + by_tilt * (half * half);
        self.place_speed += self.speed * secs
            + place_tilt.transpose() * secs
            + speed_tilt * half
            + speed_tilt.transpose() * (secs * secs)
            + by_tilt * (half * secs);
        self.speed += both(speed_tilt) * secs + by_tilt * (secs * secs);
        self.place_turn = (self.place_turn + self.speed_turn * secs + turned * half) * forth;
        self.speed_turn = (self.speed_turn + turned * secs) * forth;
        self.turn += noise.gyro.powi(2) * secs;
        let force = noise.accelerometer.powi(2);
        self.speed += DMat3::IDENTITY * (force * secs);
        self.place_speed += DMat3::IDENTITY * (force * half);
        self.place += DMat3::IDENTITY * (force * secs.powi(3) / 3.0);
    }
}

/// Of SO(3) at a rotation vector (Forster et al. 2017, equation 8).
fn right_jacobian(v: DVec3) -> DMat3 {
    let (squared, matrix) = (v.length_squared(), skew(v));
    // The series near zero, where the closed forms are 0 / 0.
    let (first, second) = if squared < 1e-6 {
        (0.5 - squared / 24.0, 1.0 / 6.0 - squared / 120.0)
    } else {
        let angle = squared.sqrt();
        (
            (1.0 - angle.cos()) / squared,
            (angle - angle.sin()) / (squared * angle),
        )
    };
    DMat3::IDENTITY - matrix * first + matrix * matrix * second
}

#[cfg(test)]
mod tests;
