//! Derivatives against differences, and what motions do in an adjustment.

use glam::DQuat;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::optim::bundle::adjust;
use crate::optim::bundle::problem::RelativeMotion;
use crate::optim::bundle::problem::{Problem, Settings};
use crate::optim::bundle::relative_motion::*;
use crate::optim::bundle::tests::problem;

fn vector(rng: &mut Pcg32, size: f64) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| rng.random_range(-size..size)))
}

fn motion(problem: &Problem, first: u32, second: u32) -> RelativeMotion {
    let exact = RelativeMotion {
        first_ix: first,
        second_ix: second,
        first_from_second: Rigid::IDENTITY,
        std: [0.01, 0.004],
    };
    RelativeMotion {
        first_from_second: exact.between(&problem.cameras),
        ..exact
    }
}

#[test]
fn derivatives_are_those_of_differences() {
    let mut rng = Pcg32::seed_from_u64(3);
    for size in [1e-5, 0.1, 1.0, 3.0] {
        let mut problem = problem(0.0, 0.0);
        let mut motion = motion(&problem, 4, 1);
        motion.first_from_second.rotation *=
            DQuat::from_scaled_axis(vector(&mut rng, 0.577 * size));
        motion.first_from_second.translation += vector(&mut rng, size);
        let own = motion.derivatives(&motion.between(&problem.cameras));
        for (camera, ix) in [(0, 4), (1, 1)] {
            for k in 0..6 {
                let pose = problem.cameras[ix].cam_from_world;
                let mut at = |by: f64| {
                    let mut step = [DVec3::ZERO; 2];
                    step[k / 3][k % 3] = by;
                    problem.cameras[ix].cam_from_world = Rigid::exp(step[0], step[1]) * pose;
                    motion.residual(&problem.cameras)
                };
                let (plus, minus) = (at(1e-5), at(-1e-5));
                problem.cameras[ix].cam_from_world = pose;
                for row in 0..6 {
                    let slope = (plus[row] - minus[row]) / 2e-5;
                    let error = (own[camera][row][k] - slope).abs() / (1.0 / motion.std[1]);
                    assert!(
                        error < 1e-6,
                        "size {size}, camera {ix}, {row} by {k}: {error}"
                    );
                }
            }
        }
    }
}

fn settings() -> Settings {
    Settings {
        max_steps: 60,
        loss_px: 1.0,
        refine_focal: false,
        refine_radial: false,
    }
}

/// Cameras in a row without a single point, the first one fixed.
fn chain(n: u32) -> Problem {
    let mut out = problem(0.0, 0.0);
    let model = out.cameras[0].clone();
    out = Problem::default();
    for ix in 0..n {
        let mut camera = model.clone();
        let turn = DVec3::new(0.0, 0.1 * f64::from(ix), 0.02);
        camera.cam_from_world = Rigid::exp(DVec3::new(0.1, 0.0, 0.5 * f64::from(ix)), turn);
        camera.is_fixed = ix == 0;
        out.cameras.push(camera);
    }
    out.motions = (1..n).map(|ix| motion(&out, ix - 1, ix)).collect();
    out
}

#[test]
fn cameras_without_points_go_where_the_motions_say() {
    let truth = chain(5);
    let mut moved = truth.clone();
    let mut rng = Pcg32::seed_from_u64(5);
    for camera in &mut moved.cameras[1..] {
        let step = Rigid::exp(vector(&mut rng, 0.02), vector(&mut rng, 0.01));
        camera.cam_from_world = step * camera.cam_from_world;
    }
    adjust(&mut moved, &settings());
    for (a, b) in moved.cameras.iter().zip(&truth.cameras) {
        let off = a.cam_from_world * b.cam_from_world.inverse();
        assert!(off.translation.length() < 1e-6, "{off:?}");
        assert!(off.angle_to(&Rigid::IDENTITY) < 1e-6, "{off:?}");
    }
}

/// Of two chains of motions over the same cameras one is right; a motion of the other is far off.
#[test]
fn a_motion_that_is_far_off_counts_for_little() {
    let truth = chain(5);
    let mut slipped = truth.clone();
    let mut long = motion(&truth, 0, 4);
    long.std = [0.02, 0.008];
    slipped.motions.push(long);
    let step = &mut slipped.motions[2].first_from_second.translation;
    *step *= 1.3;
    let shift = step.length() * 0.3 / 1.3;
    slipped.motions.extend(truth.motions.iter().take(3).skip(2));
    adjust(&mut slipped, &settings());
    for (a, b) in slipped.cameras.iter().zip(&truth.cameras) {
        let off = a.cam_from_world.inverse().translation;
        let off = off.distance(b.cam_from_world.inverse().translation);
        assert!(off < 0.05 * shift, "{off} of {shift}");
    }
}
