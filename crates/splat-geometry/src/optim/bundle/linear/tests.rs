//! Derivatives against differences.

use crate::optim::bundle::linear::*;
use crate::optim::bundle::problem::Settings;
use crate::optim::bundle::tests::problem;
use crate::optim::bundle::{layout, split, total_cost};
use splat_types::transform::Rigid;

/// Derivatives of the cost by everything that moves, against central differences: half the cost has the gradient
/// `J^T r` of the weighted rows.
#[test]
fn gradients_are_those_of_differences() {
    let mut problem = problem(0.6, 0.02);
    for camera in &mut problem.cameras {
        camera.radial = -0.12;
        camera.is_fixed = false;
    }
    let mut hold = [[0.0; 6]; 6];
    (0..6).for_each(|k| hold[k][k] = 1e4 * (k + 1) as f64);
    problem.cameras[3].hold = Some(hold);
    for observation in problem.observations.iter_mut().step_by(3) {
        observation.depth = Some(MeasuredDepth {
            inverse: 0.21,
            px_per_inverse: 150.0,
        });
    }
    let settings = Settings {
        max_steps: 0,
        loss_px: 3.0,
        refine_focal: true,
        refine_radial: true,
    };
    let (flat, mut state) = split(&mut problem, &settings);
    state.cameras[3].cam_from_world =
        Rigid::exp(DVec3::splat(1e-4), DVec3::ZERO) * state.cameras[3].cam_from_world;
    let layout = layout(&flat);
    let normal = linearise(&flat, &state, &layout);
    let rows = || normal.chunks.iter().flat_map(|c| &c.rows);
    let dot = |a: [f64; 2], r: &Row| a[0] * r.residual[0] + a[1] * r.residual[1];
    let slope = |moved: &dyn Fn(&mut State, f64)| {
        let cost = |by: f64| {
            let mut state = state.clone();
            moved(&mut state, by);
            total_cost(&state, &flat)
        };
        (cost(1e-6) - cost(-1e-6)) / 4e-6
    };
    let close = |name: &str, own: f64, slope: f64| {
        let error = (own - slope).abs() / slope.abs().max(10.0);
        assert!(error < 1e-4, "{name}: {own} {slope}");
    };
    for camera in [0, 3] {
        let slot = layout.slot_of[camera];
        let (mut pose, held) = ([0.0; 6], &normal.holds[0]);
        for row in rows().filter(|r| r.slot == slot) {
            (0..6).for_each(|k| pose[k] += dot([row.by_pose[0][k], row.by_pose[1][k]], row));
        }
        if held.0 == slot as usize {
            (0..6).for_each(|k| pose[k] += held.2[k]);
        }
        for (k, own) in pose.into_iter().enumerate() {
            let moved = |state: &mut State, by: f64| {
                let mut v = [DVec3::ZERO; 2];
                v[k / 3][k % 3] = by;
                let pose = &mut state.cameras[camera].cam_from_world;
                *pose = Rigid::exp(v[0], v[1]) * *pose;
            };
            close(&format!("camera {camera}, {k}"), own, slope(&moved));
        }
    }
    for k in 0..LENS {
        let own = rows()
            .map(|r| dot([r.by_lens[0][k], r.by_lens[1][k]], r))
            .sum();
        let moved = |state: &mut State, by: f64| {
            for camera in &mut state.cameras {
                if k == 0 {
                    camera.intrinsics = camera.intrinsics.refocused(by.exp());
                } else {
                    camera.radial += by;
                }
            }
        };
        close(&format!("lens {k}"), own, slope(&moved));
    }
    for k in 0..3 {
        let moved = |state: &mut State, by: f64| state.points[7][k] += by;
        let block = normal.chunks.iter().flat_map(|c| &c.blocks).nth(7).unwrap();
        close(&format!("point {k}"), block.g[k], slope(&moved));
    }
}
