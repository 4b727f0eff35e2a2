//! Synthetic cameras and points with known truth.

use glam::{DQuat, DVec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::optim::bundle::problem::{Camera, Observation};
use crate::optim::bundle::*;
use splat_types::camera::Intrinsics;

fn vector(rng: &mut Pcg32, size: f64) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| rng.random_range(-size..size)))
}

/// Six cameras round 120 points, exact but for noise; the share `wrong` of the pixels is anywhere.
pub(crate) fn problem(noise_px: f64, wrong: f64) -> Problem {
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
                cam_from_world: pose,
                intrinsics,
                radial: 0.0,
                is_fixed: i < 2,
                hold: None,
                shares_lens: true,
            }
        })
        .collect();
    let points: Vec<DVec3> = (0..120).map(|_| vector(&mut rng, 1.5)).collect();
    let mut out = Problem {
        cameras: cameras.clone(),
        ..Problem::default()
    };
    for point in points {
        let mut seen = Vec::new();
        for (camera_ix, camera) in cameras.iter().enumerate() {
            let exact = intrinsics
                .project(camera.cam_from_world.transform_point(point))
                .unwrap();
            let off = vector(&mut rng, 1.0).truncate()
                * if rng.random_range(0.0..1.0) < wrong {
                    80.0
                } else {
                    noise_px
                };
            seen.push(Observation {
                camera_ix: camera_ix as u32,
                pixel: exact + off,
                depth: None,
            });
        }
        out.add_point(point, seen);
    }
    out
}

fn settings(max_steps: usize, loss_px: f64, refine_focal: bool) -> Settings {
    Settings {
        max_steps,
        loss_px,
        refine_focal,
        refine_radial: false,
    }
}

fn disturbed(truth: &Problem, focal: f64) -> Problem {
    let mut rng = Pcg32::seed_from_u64(12);
    let mut out = truth.clone();
    for camera in &mut out.cameras {
        camera.intrinsics.fx *= focal;
        camera.intrinsics.fy *= focal;
        if !camera.is_fixed {
            camera.cam_from_world =
                Rigid::exp(vector(&mut rng, 0.05), vector(&mut rng, 0.02)) * camera.cam_from_world;
        }
    }
    out.points
        .iter_mut()
        .for_each(|p| *p += vector(&mut rng, 0.05));
    out
}

fn worst_pose(a: &Problem, b: &Problem) -> f64 {
    let off = |(a, b): (&Camera, &Camera)| {
        a.cam_from_world.angle_to(&b.cam_from_world)
            + a.cam_from_world
                .translation
                .distance(b.cam_from_world.translation)
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
    let report = adjust(&mut found, &settings(60, 5.0, false));
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
    adjust(&mut found, &settings(100, 20.0, true));
    let focal = found.cameras[0].intrinsics;
    assert!(
        (focal.fx / 500.0 - 1.0).abs() < 1e-3 && (focal.fy / 505.0 - 1.0).abs() < 1e-3,
        "{focal:?}"
    );
}

/// The same cameras through a lens with that radial coefficient.
fn through(radial: f64, problem: &Problem) -> Problem {
    let mut out = problem.clone();
    for seen in &mut out.observations {
        let i = &problem.cameras[seen.camera_ix as usize].intrinsics;
        let plane = i.ray_in_cam(seen.pixel).truncate();
        let distorted = plane * (1.0 + radial * plane.length_squared());
        seen.pixel = DVec2::new(i.fx * distorted.x + i.cx, i.fy * distorted.y + i.cy);
    }
    out
}

#[test]
fn a_barrel_lens_and_its_focal_length_are_found_together() {
    let truth = through(-0.15, &problem(0.3, 0.0));
    let mut found = disturbed(&truth, 1.08);
    let report = adjust(
        &mut found,
        &Settings {
            refine_radial: true,
            ..settings(100, 5.0, true)
        },
    );
    let camera = &found.cameras[0];
    let std = report.radial.unwrap().std;
    let off = camera.radial + 0.15;
    assert!(std < 0.004 && off.abs() < 4.0 * std, "{off} beside {std}");
    assert!((camera.intrinsics.fx / 500.0 - 1.0).abs() < 5e-3);
    let mut without = disturbed(&truth, 1.08);
    let poor = adjust(&mut without, &settings(100, 5.0, true));
    assert!(poor.cost_after > 5.0 * report.cost_after);
    assert_eq!((without.cameras[0].radial, poor.radial), (0.0, None));
    assert!(report.radial.unwrap().gain > 1.0);
    let mut undistorted = disturbed(&problem(0.3, 0.0), 1.08);
    let all = Settings {
        refine_radial: true,
        ..settings(100, 5.0, true)
    };
    assert!(adjust(&mut undistorted, &all).radial.unwrap().gain < 0.02);
}

/// Held by as much as its pixels say, a pose goes about half of the way; held hard it stays, and free it goes all.
#[test]
fn a_pose_that_is_held_softly_bends() {
    let truth = problem(0.0, 0.0);
    let moved = Rigid::exp(DVec3::new(0.02, 0.0, 0.0), DVec3::ZERO);
    let gone = |hold: f64| {
        let mut found = truth.clone();
        // All others are held, so that only this one can give way.
        for (i, camera) in found.cameras.iter_mut().enumerate() {
            camera.is_fixed = i != 4;
        }
        let camera = &mut found.cameras[4];
        camera.cam_from_world = moved * camera.cam_from_world;
        let mut information = [[0.0; 6]; 6];
        (0..6).for_each(|k| information[k][k] = hold);
        camera.hold = (hold > 0.0).then_some(information);
        let start = camera.cam_from_world;
        adjust(&mut found, &settings(50, 5.0, false));
        let end = found.cameras[4].cam_from_world;
        (end * start.inverse()).translation.length() / 0.02
    };
    let (free, held) = (gone(0.0), gone(1e12));
    assert!((free - 1.0).abs() < 0.01 && held < 1e-3, "{free} {held}");
    let shares = [1e3, 1e5, 1e6].map(gone);
    assert!(shares.is_sorted_by(|a, b| a > b), "{shares:?}");
    assert!(shares[0] > 0.8 && shares[2] < 0.5, "{shares:?}");
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let solved = |n_threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        let mut found = disturbed(&problem(0.3, 0.05), 1.05);
        pool.build()
            .unwrap()
            .install(|| adjust(&mut found, &settings(12, 1.0, true)));
        let poses: Vec<Rigid> = found.cameras.iter().map(|c| c.cam_from_world).collect();
        (poses, found.points)
    };
    assert_eq!(solved(1), solved(3));
}

#[test]
fn one_pixel_in_twelve_may_be_anywhere() {
    let truth = problem(0.3, 0.08);
    let mut found = disturbed(&truth, 1.0);
    adjust(&mut found, &settings(60, 1.0, false));
    assert!(
        worst_pose(&truth, &found) < 5e-3,
        "{}",
        worst_pose(&truth, &found)
    );
}

#[test]
fn nothing_to_move_is_no_fault() {
    let mut empty = Problem::default();
    adjust(&mut empty, &settings(5, 1.0, true));
    let mut held = problem(0.5, 0.0);
    held.cameras.iter_mut().for_each(|c| c.is_fixed = true);
    let report = adjust(&mut held, &settings(20, 1.0, false));
    assert!(report.cost_after <= report.cost_before);
}

/// 500 cameras on a ring that look outwards at a wall, each point seen by about 20: a loop of a robot.
#[test]
fn a_long_loop_moves_as_a_whole() {
    let mut rng = Pcg32::seed_from_u64(4);
    let intrinsics = problem(0.0, 0.0).cameras[0].intrinsics;
    let turned = |share: f64| DQuat::from_rotation_y(std::f64::consts::TAU * share);
    let mut truth = Problem::default();
    for i in 0..500 {
        let turn = turned(f64::from(i) / 500.0);
        truth.cameras.push(Camera {
            cam_from_world: Rigid::new(turn, turn * (DVec3::Z * 40.0)).inverse(),
            intrinsics,
            radial: 0.0,
            is_fixed: i == 0,
            hold: None,
            shares_lens: false,
        });
    }
    for _ in 0..6000 {
        let out = DVec3::new(
            0.0,
            rng.random_range(-2.0..2.0),
            rng.random_range(45.0..49.0),
        );
        let point = turned(rng.random_range(0.0..1.0)) * out;
        let observation = |(i, camera): (usize, &Camera)| {
            let pixel = intrinsics.project(camera.cam_from_world.transform_point(point))?;
            let is_inside = pixel.x > 0.0 && pixel.x < 640.0 && pixel.y > 0.0 && pixel.y < 480.0;
            is_inside.then_some(Observation {
                camera_ix: i as u32,
                pixel,
                depth: None,
            })
        };
        let seen: Vec<Observation> = truth
            .cameras
            .iter()
            .enumerate()
            .filter_map(observation)
            .collect();
        truth.add_point(point, seen);
    }
    let mut found = disturbed(&truth, 1.0);
    let report = adjust(&mut found, &settings(8, 5.0, false));
    assert!(report.cost_after < 1e-3 * report.cost_before, "{report:?}");
}
