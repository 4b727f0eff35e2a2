//! Motions found again, and images that give none.

use rand::RngExt;

use crate::two_view::epipolar::*;

const CAMERA: Intrinsics = Intrinsics {
    width_px: 640,
    height_px: 480,
    fx: 500.0,
    fy: 505.0,
    cx: 321.0,
    cy: 238.0,
};

/// 200 matches with up to 0.4 px of noise along each axis, every fifth one wrong.
fn pairs(pose: &Rigid) -> Vec<(DVec2, DVec2)> {
    let mut rng = Pcg32::seed_from_u64(8);
    let mut out = Vec::new();
    while out.len() < 200 {
        let mut number = |size: f64| rng.random_range(-size..size);
        let point = DVec3::new(number(2.0), number(2.0), 5.0 + number(2.0));
        let Some((a, b)) = CAMERA
            .project(point)
            .zip(CAMERA.project(pose.transform_point(point)))
        else {
            continue;
        };
        let wrong = if out.len() % 5 == 0 {
            DVec2::new(number(200.0), number(200.0))
        } else {
            DVec2::ZERO
        };
        out.push((a, b + wrong + DVec2::new(number(0.4), number(0.4))));
    }
    out
}

#[test]
fn the_motion_is_found_among_wrong_matches() {
    let pose = Rigid::exp(DVec3::new(0.8, 0.1, 0.2), DVec3::new(0.05, -0.15, 0.02));
    let found = motion(&pairs(&pose), [&CAMERA, &CAMERA], 1.0, 1).unwrap();
    let along = found
        .second_from_first
        .translation
        .dot(pose.translation.normalize());
    assert!(found.second_from_first.angle_to(&pose).to_degrees() < 0.15);
    assert!(along > 0.3_f64.to_radians().cos() - 1e-3, "{along}");
    assert!(
        found.inliers.len() >= 150 && found.parallax_deg > 5.0,
        "{} {}",
        found.inliers.len(),
        found.parallax_deg
    );
}

#[test]
fn a_mere_turn_shows_no_parallax_and_fits_a_homography() {
    let turn = Rigid::exp(DVec3::ZERO, DVec3::new(0.05, -0.15, 0.02));
    let matches = pairs(&turn);
    assert!(motion(&matches, [&CAMERA, &CAMERA], 1.0, 1).is_none_or(|m| m.parallax_deg < 0.3));
    assert!(homography_share(&matches, 1.0, 1) > 0.7);
    let moved = Rigid::exp(DVec3::new(0.8, 0.1, 0.2), DVec3::ZERO);
    assert!(homography_share(&pairs(&moved), 1.0, 1) < 0.5);
}

#[test]
fn too_few_or_equal_matches_give_nothing() {
    let same = vec![(DVec2::new(10.0, 20.0), DVec2::new(10.0, 20.0)); 40];
    assert!(motion(&same[..7], [&CAMERA, &CAMERA], 1.0, 1).is_none());
    assert!(motion(&same, [&CAMERA, &CAMERA], 1.0, 1).is_none_or(|m| m.parallax_deg < 1e-6));
    assert!(fundamental(&same[..10], 1.0, 1).is_none());
}
