//! Made-up cameras and points with known truth.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;

fn vector(rng: &mut Pcg32, size: f64) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| rng.random_range(-size..size)))
}

/// Six cameras round 120 points, exact but for noise; the share `wrong` of the pixels is anywhere.
fn problem(noise_px: f64, wrong: f64) -> Problem {
    let mut rng = Pcg32::seed_from_u64(11);
    let intrinsics = Intrinsics {
        width_px: 640,
        height_px: 480,
        fx: 500.0,
        fy: 505.0,
        cx: 320.0,
        cy: 240.0,
    };
    let cameras: Vec<Camera> = (0..6)
        .map(|i| {
            let pose = Rigid::exp(
                vector(&mut rng, 0.8) + DVec3::Z * 5.0,
                vector(&mut rng, 0.3),
            );
            Camera {
                cam_from_map: pose,
                intrinsics,
                is_fixed: i < 2,
                shares_focal: true,
            }
        })
        .collect();
    let points: Vec<DVec3> = (0..120).map(|_| vector(&mut rng, 1.5)).collect();
    let mut observations = Vec::new();
    for point in &points {
        let mut seen = Vec::new();
        for (camera_ix, camera) in cameras.iter().enumerate() {
            let exact = intrinsics
                .project(camera.cam_from_map.transform_point(*point))
                .unwrap();
            let off = vector(&mut rng, 1.0).truncate()
                * if rng.random_range(0.0..1.0) < wrong {
                    80.0
                } else {
                    noise_px
                };
            seen.push(Observation {
                camera_ix,
                pixel: exact + off,
            });
        }
        observations.push(seen);
    }
    Problem {
        cameras,
        points,
        observations,
    }
}

fn disturbed(truth: &Problem, focal: f64) -> Problem {
    let mut rng = Pcg32::seed_from_u64(12);
    let mut out = truth.clone();
    for camera in &mut out.cameras {
        camera.intrinsics.fx *= focal;
        camera.intrinsics.fy *= focal;
        if !camera.is_fixed {
            camera.cam_from_map =
                Rigid::exp(vector(&mut rng, 0.05), vector(&mut rng, 0.02)) * camera.cam_from_map;
        }
    }
    out.points
        .iter_mut()
        .for_each(|p| *p += vector(&mut rng, 0.05));
    out
}

fn worst_pose(a: &Problem, b: &Problem) -> f64 {
    let off = |(a, b): (&Camera, &Camera)| {
        a.cam_from_map.angle_to(&b.cam_from_map)
            + a.cam_from_map
                .translation
                .distance(b.cam_from_map.translation)
    };
    a.cameras
        .iter()
        .zip(&b.cameras)
        .map(off)
        .fold(0.0, f64::max)
}

#[test]
fn exact_pixels_give_back_exact_poses_and_points() {
    let truth = problem(0.0, 0.0);
    let mut found = disturbed(&truth, 1.0);
    let report = adjust(
        &mut found,
        &Settings {
            max_steps: 60,
            loss_px: 5.0,
            refine_focal: false,
        },
    );
    assert!(report.cost_after < 1e-6 * report.cost_before, "{report:?}");
    assert!(
        worst_pose(&truth, &found) < 1e-5,
        "{}",
        worst_pose(&truth, &found)
    );
    let off = truth
        .points
        .iter()
        .zip(&found.points)
        .map(|(a, b)| a.distance(*b))
        .fold(0.0, f64::max);
    assert!(off < 1e-4, "{off}");
}

#[test]
fn a_wrong_focal_length_is_corrected() {
    let truth = problem(0.0, 0.0);
    let mut found = disturbed(&truth, 1.15);
    adjust(
        &mut found,
        &Settings {
            max_steps: 100,
            loss_px: 20.0,
            refine_focal: true,
        },
    );
    let focal = found.cameras[0].intrinsics;
    assert!(
        (focal.fx / 500.0 - 1.0).abs() < 1e-3 && (focal.fy / 505.0 - 1.0).abs() < 1e-3,
        "{focal:?}"
    );
}

#[test]
fn one_pixel_in_twelve_may_be_anywhere() {
    let truth = problem(0.3, 0.08);
    let mut found = disturbed(&truth, 1.0);
    adjust(
        &mut found,
        &Settings {
            max_steps: 60,
            loss_px: 1.0,
            refine_focal: false,
        },
    );
    assert!(
        worst_pose(&truth, &found) < 5e-3,
        "{}",
        worst_pose(&truth, &found)
    );
}

#[test]
fn nothing_to_move_is_no_fault() {
    let mut empty = Problem::default();
    adjust(
        &mut empty,
        &Settings {
            max_steps: 5,
            loss_px: 1.0,
            refine_focal: true,
        },
    );
    let mut held = problem(0.5, 0.0);
    held.cameras.iter_mut().for_each(|c| c.is_fixed = true);
    let report = adjust(
        &mut held,
        &Settings {
            max_steps: 20,
            loss_px: 1.0,
            refine_focal: false,
        },
    );
    assert!(report.cost_after <= report.cost_before);
}
