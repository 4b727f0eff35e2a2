//! Scale by odometry, depth pictures and the floor.

use super::*;
use crate::geometry::align::noise::normal;
use glam::DQuat;

fn at(place: DVec3) -> Rigid {
    Rigid::new(DQuat::IDENTITY, place)
}

/// A walk of `n` keyframes in the map and by wheels that count 2.5 m a unit, each step off by a share of `noise`.
fn walk(n: usize, noise: f64, seed: u64) -> Vec<(Rigid, Rigid)> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let (mut place, mut wheels, mut track) = (DVec3::ZERO, DVec3::ZERO, Vec::new());
    for i in 0..n {
        track.push((at(place), at(wheels)));
        let heading = i as f64 * 0.05;
        let step = DVec3::new(heading.cos(), heading.sin(), 0.0) * 0.1;
        place += step;
        wheels += 2.5 * step * (1.0 + noise * normal(&mut rng));
    }
    track
}

#[test]
fn wheels_tell_metres_within_their_own_error_bar() {
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

fn flat(width_px: u32, height_px: u32, depth: impl Fn(u32, u32) -> f32) -> DepthMap {
    let n = width_px * height_px;
    let depth: Vec<f32> = (0..n).map(|k| depth(k % width_px, k / width_px)).collect();
    DepthMap {
        width_px,
        height_px,
        confidence: vec![1.0; depth.len()],
        depth,
    }
}

#[test]
fn a_depth_picture_of_another_size_tells_metres() {
    let units = flat(40, 30, |x, y| 1.0 + 0.1 * x as f32 + 0.05 * y as f32);
    let metres = flat(80, 60, |x, y| {
        3.0 * (1.0 + 0.1 * (x / 2) as f32 + 0.05 * (y / 2) as f32)
    });
    let log = depth_ratio(&metres, &units).unwrap();
    assert!((log - 3.0_f64.ln()).abs() < 1e-6);
    assert_eq!(depth_ratio(&DepthMap::none(), &units), None);
    assert_eq!(depth_ratio(&metres, &DepthMap::none()), None);
}

#[test]
fn the_floor_is_found_below_a_camera_that_looks_ahead_and_down() {
    let lens = Intrinsics {
        width_px: 80,
        height_px: 60,
        fx: 70.0,
        fy: 70.0,
        cx: 40.0,
        cy: 30.0,
    };
    let tilt: f64 = 0.3;
    let down = DVec3::new(0.0, tilt.cos(), tilt.sin());
    // A floor 1.4 units below, and a box on it at every third column.
    let depth = flat(80, 60, |x, y| {
        let ray = lens.ray_in_cam(glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        let share = down.dot(ray);
        let far = if share > 0.05 { 1.4 / share } else { 9.0 };
        (if x % 3 == 0 { 0.7 * far } else { far }) as f32
    });
    let height = height_above_floor(&depth, &lens, 1).unwrap();
    assert!((height - 1.4).abs() < 0.01, "{height}");
    let wall = flat(80, 60, |_, _| 3.0);
    assert_eq!(
        height_above_floor(&wall, &lens, 1),
        None,
        "a wall is no floor"
    );
    assert_eq!(height_above_floor(&DepthMap::none(), &lens, 1), None);
}
