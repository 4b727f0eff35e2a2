use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use splat_types::time::Stamp;

const RATE_HZ: f64 = 200.0;

/// A hand that shakes hard: up to 4 rad/s and 8 m/s^2, in turns about changing axes.
fn signal(secs: f64) -> (DVec3, DVec3) {
    let wave = |hertz: f64, phase: f64| (std::f64::consts::TAU * hertz * secs + phase).sin();
    (
        DVec3::new(
            2.0 * wave(1.1, 0.3),
            1.5 * wave(1.7, 1.0),
            3.0 * wave(0.7, 2.0),
        ),
        DVec3::new(
            4.0 * wave(1.3, 0.1),
            9.81 + 3.0 * wave(2.0, 0.7),
            6.0 * wave(0.9, 1.9),
        ),
    )
}

fn samples(n: usize) -> Vec<ImuSample> {
    let sample = |ix: usize| {
        let secs = ix as f64 / RATE_HZ;
        let (angular_velocity, acceleration) = signal(secs);
        ImuSample {
            stamp: Stamp::from_secs(secs),
            angular_velocity,
            acceleration,
        }
    };
    (0..n).map(sample).collect()
}

/// Small steps of the plainest kind through the same signal, which changes evenly between samples.
fn reference(samples: &[ImuSample], bias: &Bias) -> (DQuat, DVec3, DVec3) {
    const STEPS: usize = 400;
    let (mut turn, mut speed, mut place) = (DQuat::IDENTITY, DVec3::ZERO, DVec3::ZERO);
    for two in samples.windows(2) {
        let dt = two[1].stamp.secs_since(two[0].stamp) / STEPS as f64;
        for step in 0..STEPS {
            let share = (step as f64 + 0.5) / STEPS as f64;
            let rate = two[0].angular_velocity.lerp(two[1].angular_velocity, share) - bias.gyro;
            let force = two[0].acceleration.lerp(two[1].acceleration, share) - bias.accelerometer;
            let half = turn * DQuat::from_scaled_axis(0.5 * dt * rate);
            let seen = half * force;
            place += speed * dt + 0.5 * dt * dt * seen;
            speed += dt * seen;
            turn = (turn * DQuat::from_scaled_axis(dt * rate)).normalize();
        }
    }
    (turn, speed, place)
}

fn bias() -> Bias {
    Bias {
        gyro: DVec3::new(0.02, -0.05, 0.03),
        accelerometer: DVec3::new(-0.1, 0.2, 0.05),
    }
}

fn integrated(bias: &Bias) -> Preintegrated {
    Preintegrated::of(&samples(201), bias, &ImuNoise::default())
}

#[test]
fn a_second_of_shaking_is_that_of_small_steps() {
    let (turn, speed, place) = reference(&samples(201), &bias());
    let found = integrated(&bias());
    let off = (found.turn.inverse() * turn).to_scaled_axis().length();
    assert!(off < 1e-6, "turn off by {off}");
    assert!(
        found.speed.distance(speed) < 1e-6,
        "{} {speed}",
        found.speed
    );
    assert!(
        found.place.distance(place) < 1e-6,
        "{} {place}",
        found.place
    );
    assert!((found.secs - 1.0).abs() < 1e-9);
}

#[test]
fn derivatives_by_the_biases_are_central_differences() {
    let found = integrated(&bias());
    const STEP: f64 = 1e-5;
    let moved = |axis: usize, sign: f64, is_gyro: bool| {
        let mut by = bias();
        let of = if is_gyro {
            &mut by.gyro
        } else {
            &mut by.accelerometer
        };
        of[axis] += sign * STEP;
        integrated(&by)
    };
    for axis in 0..3 {
        let [plus, minus] = [1.0, -1.0].map(|sign| moved(axis, sign, true));
        let turned = (minus.turn.inverse() * plus.turn).to_scaled_axis() / (2.0 * STEP);
        let slope = |a: DVec3, b: DVec3| (a - b) / (2.0 * STEP);
        let close = |a: DVec3, b: DVec3| assert!(a.distance(b) < 1e-6, "axis {axis}: {a} {b}");
        close(found.turn_by_gyro.col(axis), turned);
        close(
            found.speed_by_gyro.col(axis),
            slope(plus.speed, minus.speed),
        );
        close(
            found.place_by_gyro.col(axis),
            slope(plus.place, minus.place),
        );
        let [plus, minus] = [1.0, -1.0].map(|sign| moved(axis, sign, false));
        close(
            found.speed_by_accelerometer.col(axis),
            slope(plus.speed, minus.speed),
        );
        close(
            found.place_by_accelerometer.col(axis),
            slope(plus.place, minus.place),
        );
    }
}

#[test]
fn a_small_change_of_bias_is_corrected_to_first_order() {
    let by = Bias {
        gyro: DVec3::new(1e-4, 2e-4, -1e-4),
        accelerometer: DVec3::new(0.01, -0.02, 0.01),
    };
    let mut other = bias();
    other.gyro += by.gyro;
    other.accelerometer += by.accelerometer;
    let (found, exact) = (integrated(&bias()).corrected(&by), integrated(&other));
    assert!(found.turn.angle_between(exact.turn) < 1e-6);
    assert!(found.speed.distance(exact.speed) < 2e-6);
    assert!(found.place.distance(exact.place) < 2e-6);
}

/// 400 draws of the noise have the covariance that is stated.
#[test]
fn the_covariance_is_that_of_noisy_samples() {
    const N: usize = 400;
    let noise = ImuNoise {
        gyro: 2e-3,
        accelerometer: 2e-2,
        ..ImuNoise::default()
    };
    let exact = integrated(&bias());
    let mut random = Pcg32::seed_from_u64(7);
    let mut gaussian = |std: f64| {
        let mut one = || {
            let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
            radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
        };
        DVec3::new(one(), one(), one()) * std
    };
    let mut sum = Covariance9::zeros();
    for _ in 0..N {
        let mut noisy = samples(201);
        for sample in &mut noisy {
            sample.angular_velocity += gaussian(noise.gyro * RATE_HZ.sqrt());
            sample.acceleration += gaussian(noise.accelerometer * RATE_HZ.sqrt());
        }
        let found = Preintegrated::of(&noisy, &bias(), &noise);
        let turn = (exact.turn.inverse() * found.turn).to_scaled_axis();
        let (speed, place) = (found.speed - exact.speed, found.place - exact.place);
        let off = [turn, speed, place].map(|v| v.to_array()).concat();
        let off = nalgebra::SVector::<f64, 9>::from_column_slice(&off);
        sum += off * off.transpose() / N as f64;
    }
    let stated = Preintegrated::of(&samples(201), &bias(), &noise).covariance();
    for axis in 0..9 {
        let ratio = (sum[(axis, axis)] / stated[(axis, axis)]).sqrt();
        assert!((ratio - 1.0).abs() < 0.12, "axis {axis}: {ratio}");
    }
    let correlation = |m: &Covariance9| m[(4, 7)] / (m[(4, 4)] * m[(7, 7)]).sqrt();
    assert!((correlation(&sum) - correlation(&stated)).abs() < 0.05);
}

/// The blocks are those of the whole matrices, equation 62 of the paper.
#[test]
fn the_covariance_is_that_of_whole_matrices() {
    let (samples, noise) = (samples(101), ImuNoise::default());
    let mut whole = Covariance9::zeros();
    let mut turn = DQuat::IDENTITY;
    for two in samples.windows(2) {
        let secs = two[1].stamp.secs_since(two[0].stamp);
        let [rate, next] = [0, 1].map(|ix| two[ix].angular_velocity - bias().gyro);
        let start = Turned {
            turn,
            by_gyro: DMat3::ZERO,
        };
        let end = start.on((rate, next), secs).turn;
        let force = 0.5 * (two[0].acceleration + two[1].acceleration) - bias().accelerometer;
        let rotation = DMat3::from_quat(turn);
        let back = DMat3::from_quat(end.inverse() * turn);
        let tilted = -(rotation * skew(force));
        let (once, twice) = (tilted * secs, tilted * (0.5 * secs * secs));
        let mut by_state = Covariance9::identity();
        for (row, column) in (0..9).map(|ix| (ix / 3, ix % 3)) {
            by_state[(row, column)] = back.col(column)[row];
            by_state[(3 + row, column)] = once.col(column)[row];
            by_state[(6 + row, column)] = twice.col(column)[row];
        }
        (0..3).for_each(|i| by_state[(6 + i, 3 + i)] = secs);
        whole = by_state * whole * by_state.transpose();
        let (gyro, force) = (noise.gyro.powi(2), noise.accelerometer.powi(2));
        for i in 0..3 {
            whole[(i, i)] += gyro * secs;
            whole[(3 + i, 3 + i)] += force * secs;
            whole[(6 + i, 6 + i)] += force * secs.powi(3) / 3.0;
            whole[(3 + i, 6 + i)] += force * secs * secs / 2.0;
            whole[(6 + i, 3 + i)] += force * secs * secs / 2.0;
        }
        turn = end;
    }
    let found = Preintegrated::of(&samples, &bias(), &noise).covariance();
    let off = (found - whole).amax() / whole.amax();
    assert!(off < 1e-9, "off by {off}");
}
