//! Poses, points and one common lens that fit the observations best: bundle adjustment in f64.
//!
//! Levenberg-Marquardt with the points eliminated (Schur complement, Triggs et al. 2000) and Cauchy's loss. The
//! sums run over a fixed number of chunks, so the result does not depend on the number of threads.

mod reduced;

pub mod problem;

mod relative_motion;

mod linear;

use glam::DVec3;
use rayon::prelude::*;

use crate::optim::bundle::linear::{Normal, eliminate, follow, linearise};
use crate::optim::bundle::problem::{
    Flat, Problem, RadialReport, Report, Settings, State, project, strayed, times,
};
use crate::optim::bundle::reduced::{LENS, Layout};
use crate::optim::damped::{self, LeastSquares, Schedule};
use splat_types::transform::Rigid;

const SCHEDULE: Schedule = Schedule {
    first: 1e-4,
    down: 0.2,
    least: 1e-9,
    up: 2.0,
    up_growth: 2.0,
    most: 1e6,
    min_gain: 1e-5,
};
/// Largest change of the logarithm of the focal length and of the radial coefficient in one step.
const MAX_LENS_STEP: [f64; LENS] = [0.3, 0.1];
/// Points whose costs are summed apart.
const COST_CHUNK: usize = 1024;

/// Moves the free cameras, all points and, if asked, the one shared lens.
pub fn adjust(problem: &mut Problem, settings: &Settings) -> Report {
    let (flat, mut state) = split(problem, settings);
    let layout = layout(&flat);
    let report = descend(&mut state, &flat, &layout, settings.max_steps);
    problem.cameras = state.cameras;
    problem.points = state.points;
    report
}

/// What stays and what moves, which is taken from the problem.
fn split<'a>(problem: &'a mut Problem, settings: &Settings) -> (Flat<'a>, State) {
    let state = State {
        cameras: std::mem::take(&mut problem.cameras),
        points: std::mem::take(&mut problem.points),
    };
    let is_shared = state.cameras.iter().any(|c| c.shares_lens);
    let flat = Flat {
        observations: &problem.observations,
        ends: &problem.ends,
        motions: &problem.motions,
        start: state.cameras.clone(),
        loss_px: settings.loss_px,
        moves: [settings.refine_focal, settings.refine_radial].map(|asked| asked && is_shared),
    };
    (flat, state)
}

fn layout(flat: &Flat<'_>) -> Layout {
    let is_held: Vec<bool> = flat.start.iter().map(|c| c.is_fixed).collect();
    let cameras: Vec<u32> = flat.observations.iter().map(|o| o.camera_ix).collect();
    let starts = std::iter::once(0).chain(flat.ends.iter().copied());
    let points = starts
        .zip(flat.ends)
        .map(|(start, end)| &cameras[start..*end]);
    let pairs: Vec<[u32; 2]> = flat
        .motions
        .iter()
        .map(|motion| [motion.first_ix, motion.second_ix])
        .collect();
    let tied = pairs.iter().map(|pair| &pair[..]);
    Layout::new(&is_held, points.chain(tied))
}

/// Bundle adjustment as a problem of least squares.
struct Adjusting<'a, 'b> {
    flat: &'a Flat<'b>,
    layout: &'a Layout,
}

impl LeastSquares for Adjusting<'_, '_> {
    type State = State;
    type Linear = Normal;

    fn cost(&self, state: &State) -> f64 {
        total_cost(state, self.flat)
    }

    fn linearise(&self, state: &State) -> Normal {
        linearise(self.flat, state, self.layout)
    }

    fn stepped(&self, state: &State, normal: &Normal, damping: f64) -> Option<State> {
        step(state, self.flat, self.layout, normal, damping)
    }
}

fn descend(state: &mut State, flat: &Flat<'_>, layout: &Layout, max_steps: usize) -> Report {
    let adjusting = Adjusting { flat, layout };
    let descent = damped::descend(&adjusting, state, &SCHEDULE, max_steps);
    let mut report = Report {
        cost_before: descent.cost_before,
        cost_after: descent.cost_after,
        n_steps: descent.n_steps,
        radial: None,
    };
    if flat.moves[1] {
        let normal = descent
            .linear
            .unwrap_or_else(|| linearise(flat, state, layout));
        let solution = eliminate(&normal, layout, true, 1e-9).solve(flat.moves);
        let lens = state.cameras.iter().find(|c| c.shares_lens);
        let variance = solution.map(|s| s.lens_variance[1]);
        report.radial = lens.zip(variance).map(|(lens, variance)| RadialReport {
            std: (variance * normal.variance_px()).sqrt(),
            gain: lens.radial * lens.radial / (variance * normal.squares_px()),
        });
    }
    report
}

/// Solves the damped reduced system and applies the step; `None` where it is not positive definite.
fn step(
    state: &State,
    flat: &Flat<'_>,
    layout: &Layout,
    normal: &Normal,
    damping: f64,
) -> Option<State> {
    let system = eliminate(normal, layout, flat.moves_lens(), damping);
    let mut solution = system.solve(flat.moves)?;
    for (step, most) in solution.lens.iter_mut().zip(MAX_LENS_STEP) {
        *step = step.clamp(-most, most);
    }
    let mut out = state.clone();
    for (camera, &slot) in out.cameras.iter_mut().zip(&layout.slot_of) {
        if let Some([x, y, z, a, b, c]) = solution.poses.get(slot as usize).copied() {
            let motion = Rigid::exp(DVec3::new(x, y, z), DVec3::new(a, b, c));
            camera.cam_from_world = (motion * camera.cam_from_world).renormalized();
        }
        if camera.shares_lens {
            camera.intrinsics = camera.intrinsics.refocused(solution.lens[0].exp());
            camera.radial += solution.lens[1];
        }
    }
    follow(
        normal,
        &solution,
        (damping, flat.moves_lens()),
        &mut out.points,
    );
    Some(out)
}

/// Cauchy's loss over all observations, and what the holds cost; a point behind a camera costs as much as one
/// 100 losses away.
fn total_cost(state: &State, flat: &Flat<'_>) -> f64 {
    let rotations = state.rotations();
    let scale = 1.0 / (flat.loss_px * flat.loss_px);
    let of_point = |point_ix: usize, point: DVec3| -> f64 {
        // One logarithm of the product, unless it grows too large.
        let (mut logs, mut product) = (0.0, 1.0);
        for seen in flat.seen(point_ix..point_ix + 1) {
            let camera = &state.cameras[seen.camera_ix as usize];
            let p = rotations[seen.camera_ix as usize] * point + camera.cam_from_world.translation;
            let share = project(camera, p).map_or(1e4, |(image, ..)| {
                scale * image.distance_squared(seen.pixel)
            });
            product *= 1.0 + share;
            if let Some(depth) = seen.depth.filter(|_| p.z > 1e-9) {
                product *= 1.0 + scale * depth.residual_px(p.z).powi(2);
            }
            if product > 1e100 {
                logs += f64::ln(product);
                product = 1.0;
            }
        }
        logs + product.ln()
    };
    let of_chunk = |(chunk_ix, points): (usize, &[DVec3])| -> f64 {
        let numbered = points.iter().enumerate();
        numbered
            .map(|(i, p)| of_point(chunk_ix * COST_CHUNK + i, *p))
            .sum()
    };
    let chunks = state.points.par_chunks(COST_CHUNK).enumerate();
    let costs: Vec<f64> = chunks.map(of_chunk).collect();
    let holds = state
        .cameras
        .iter()
        .zip(&flat.start)
        .map(|(camera, start)| {
            camera
                .hold
                .filter(|_| !camera.is_fixed)
                .map_or(0.0, |hold| {
                    let off = strayed(camera, start);
                    times(&hold, &off).iter().zip(off).map(|(a, b)| a * b).sum()
                })
        });
    let motions = relative_motion::cost(&state.cameras, flat);
    (costs.iter().sum::<f64>() + motions) / scale + holds.sum::<f64>()
}

#[cfg(test)]
mod tests;
