use super::*;
use crate::inertial::preintegration::{Bias, Preintegrated};
use splat_types::inertial::ImuSample;
use splat_types::time::Stamp;

fn rate(secs: f64) -> DVec3 {
    let wave = |hertz: f64, phase: f64| (std::f64::consts::TAU * hertz * secs + phase).sin();
    DVec3::new(wave(0.6, 0.3), 0.8 * wave(0.9, 1.0), 1.2 * wave(0.4, 2.0))
}

/// What a second of the gyroscope shows from `secs` on.
fn second(secs: f64) -> (Preintegrated, [DVec3; 2]) {
    let sample = |ix: usize| ImuSample {
        stamp: Stamp::from_secs(secs + ix as f64 * 0.005),
        angular_velocity: rate(secs + ix as f64 * 0.005),
        acceleration: DVec3::ZERO,
    };
    let samples: Vec<ImuSample> = (0..=200).map(sample).collect();
    let ends = [rate(secs), rate(secs + 1.0)];
    let motion = Preintegrated::of(&samples, &Bias::default(), &ImuNoise::default());
    (motion, ends)
}

#[test]
fn slopes_are_central_differences() {
    let (motion, rates) = second(0.7);
    let pair = |seen: DQuat| TurnPair {
        seen,
        seen_std: 1e-3,
        measured: MeasuredTurn {
            rates,
            ..MeasuredTurn::of(&motion)
        },
    };
    let at = SVector::<f64, 7>::zeros();
    let (_, slope, _) = pair(motion.turn).linearised(&at);
    const STEP: f64 = 1e-5;
    for column in 0..7 {
        // What explains a turn that is moved by the unknown is that unknown: the residual falls by the slope.
        let moved = |sign: f64| {
            let mut at = at;
            at[column] = sign * STEP;
            pair(motion.turn).linearised(&at).0
        };
        let numeric = (moved(-1.0) - moved(1.0)) / (2.0 * STEP);
        for row in 0..3 {
            let off = (numeric[row] - slope[(row, column)]).abs();
            assert!(
                off < 1e-6,
                "row {row}, column {column}: {} {}",
                numeric[row],
                slope[(row, column)]
            );
        }
    }
}

#[test]
fn bias_mount_and_delay_come_of_exact_turns() {
    let bias = DVec3::new(0.01, -0.02, 0.005);
    let mount = DQuat::from_scaled_axis(DVec3::new(0.02, -0.015, 0.01));
    let delay = 0.004;
    let seconds: Vec<_> = (0..20).map(|ix| second(f64::from(ix) * 0.9)).collect();
    let pairs: Vec<TurnPair> = seconds
        .iter()
        .map(|(motion, rates)| {
            let ends = rates.map(|rate| DQuat::from_scaled_axis(rate * delay));
            let by_bias = DQuat::from_scaled_axis(motion.turn_by_gyro * bias);
            let own = ends[0].inverse() * (motion.turn * by_bias) * ends[1];
            TurnPair {
                seen: mount * own * mount.inverse(),
                seen_std: 1e-5,
                measured: MeasuredTurn {
                    rates: *rates,
                    ..MeasuredTurn::of(motion)
                },
            }
        })
        .collect();
    let noise = ImuNoise {
        gyro: 1e-6,
        ..ImuNoise::default()
    };
    let found = align(&pairs, &noise).unwrap();
    assert!(found.gyro_bias.distance(bias) < 1e-4, "{found:?}");
    assert!(
        found.mount.distance(mount.to_scaled_axis()) < 1e-3,
        "{found:?}"
    );
    assert!((found.delay_secs - delay).abs() < 1e-4, "{found:?}");
    assert!(align(&pairs[..2], &noise).is_none());
}
