//! Metres by wheels that are noisy, slip and rest.

use glam::{DQuat, DVec3};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::ground_truth::noise::normal;
use crate::length_ratio::*;

fn at(place: DVec3) -> Rigid {
    Rigid::new(DQuat::IDENTITY, place)
}

/// A walk of `n` keyframes in the map and by wheels that count 2.5 m a unit, each step off by a share of `noise`.
fn walk(n: usize, noise: f64, seed: u64) -> Vec<(Rigid, Rigid)> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let (mut place, mut wheels, mut track) = (DVec3::ZERO, DVec3::ZERO, Vec::new());
    for i in 0..n {
        track.push((at(place), at(wheels)));
        let orientation = i as f64 * 0.05;
        let step = DVec3::new(orientation.cos(), orientation.sin(), 0.0) * 0.1;
        place += step;
        wheels += 2.5 * step * (1.0 + noise * normal(&mut rng));
    }
    track
}

#[test]
fn wheels_give_metres_within_their_own_error_bar() {
    let mut inside = 0;
    for seed in 0..40 {
        let found = of_odometry(&walk(80, 0.01, seed), 0.0).unwrap();
        let off = found.log - 2.5_f64.ln();
        assert!(off.abs() < 0.01, "{off}");
        assert!(found.std < 0.01);
        inside += u32::from(off.abs() < 2.0 * found.std);
    }
    assert!(inside >= 34, "{inside} of 40 within two deviations");
}

#[test]
fn slipping_wheels_and_rests_are_outvoted() {
    let mut track = walk(80, 0.01, 3);
    // Wheels turn on the spot for a while: 2 m that the camera did not see.
    for (ix, (_, wheels)) in track.iter_mut().enumerate().skip(30) {
        wheels.translation.x += (ix - 30).min(4) as f64 * 0.5;
    }
    let rest = track[50];
    (0..20).for_each(|_| track.insert(50, rest));
    let found = of_odometry(&track, 0.0).unwrap();
    assert!((found.log - 2.5_f64.ln()).abs() < 0.02, "{found:?}");
}

#[test]
fn nothing_is_said_without_motion_or_agreement() {
    assert_eq!(of_odometry(&[], 0.0), None);
    let still = vec![(at(DVec3::ONE), at(DVec3::ONE)); 30];
    assert_eq!(of_odometry(&still, 0.0), None);
    let parked: Vec<_> = walk(40, 0.0, 0)
        .into_iter()
        .map(|(map, _)| (map, at(DVec3::ZERO)))
        .collect();
    assert_eq!(of_odometry(&parked, 0.0), None);
    assert_eq!(of_odometry(&walk(80, 3.0, 1), 0.0), None, "they contradict");
    assert_eq!(robust(vec![f64::NAN; 20], 0.0), None);
}
