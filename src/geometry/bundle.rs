//! Poses, points and one common lens that fit the observations best: bundle adjustment in f64.
//!
//! Levenberg-Marquardt with the points eliminated (Schur complement, Triggs et al. 2000) and Cauchy's loss. The
//! sums run over a fixed number of chunks, so the result does not depend on the number of threads.

mod linear;
mod reduced;

use std::ops::Range;

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use self::linear::{Normal, eliminate, follow, linearise};
use self::reduced::{LENS, Layout};
use crate::camera::Intrinsics;
use crate::pose::Rigid;

/// Largest change of the logarithm of the focal length and of the radial coefficient in one step.
const MAX_LENS_STEP: [f64; LENS] = [0.3, 0.1];
/// Points whose costs are summed apart.
const COST_CHUNK: usize = 1024;

#[derive(Debug, Clone)]
pub struct Camera {
    pub cam_from_map: Rigid,
    pub intrinsics: Intrinsics,
    /// The lens shows what a pinhole has at radius r of the plane z = 1 at `r (1 + radial r^2)`: OpenCV's k1.
    pub radial: f64,
    pub is_fixed: bool,
    /// px^-2, over a shift and a turn in the camera's axes: what else than the observations is known of the pose,
    /// which speaks for leaving it where it starts.
    pub hold: Option<[[f64; 6]; 6]>,
    /// This camera's focal length and radial coefficient are those that `Settings` may move.
    pub shares_lens: bool,
}

#[derive(Debug, Clone, Copy)]
pub struct Observation {
    pub camera_ix: u32,
    pub pixel: DVec2,
}

/// Points are added with `add_point`, which keeps their observations side by side.
#[derive(Debug, Clone, Default)]
pub struct Problem {
    pub cameras: Vec<Camera>,
    pub points: Vec<DVec3>,
    observations: Vec<Observation>,
    /// By point: where its observations end.
    ends: Vec<usize>,
}

impl Problem {
    pub fn add_point(&mut self, point: DVec3, seen: impl IntoIterator<Item = Observation>) {
        self.points.push(point);
        self.observations.extend(seen);
        self.ends.push(self.observations.len());
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Settings {
    pub max_steps: usize,
    /// Residual at which Cauchy's loss starts to bend.
    pub loss_px: f64,
    pub refine_focal: bool,
    pub refine_radial: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    pub cost_before: f64,
    pub cost_after: f64,
    pub n_steps: usize,
    /// Of the radial coefficient, where it was refined.
    pub radial: Option<RadialReport>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RadialReport {
    /// Standard deviation.
    pub std: f64,
    /// By what share the weighted squares of the errors would grow without it.
    pub gain: f64,
}

/// What moves.
#[derive(Debug, Clone)]
struct State {
    cameras: Vec<Camera>,
    points: Vec<DVec3>,
}

/// What stays.
#[derive(Debug)]
struct Flat<'a> {
    observations: &'a [Observation],
    ends: &'a [usize],
    start: Vec<Camera>,
    loss_px: f64,
    moves: [bool; LENS],
}

impl Flat<'_> {
    fn moves_lens(&self) -> bool {
        self.moves.contains(&true)
    }

    fn seen(&self, points: Range<usize>) -> &[Observation] {
        let start = |ix: usize| ix.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.observations[start(points.start)..start(points.end)]
    }

    /// Ranges of points with about equally many observations.
    fn chunks(&self, n: usize) -> Vec<Range<usize>> {
        let bound = |i: usize| {
            let before = self.observations.len() * i / n;
            if i == n {
                self.ends.len()
            } else {
                self.ends.partition_point(|end| *end < before)
            }
        };
        (0..n).map(|i| bound(i)..bound(i + 1)).collect()
    }
}

impl State {
    fn rotations(&self) -> Vec<DMat3> {
        let poses = self.cameras.iter().map(|c| &c.cam_from_map);
        poses.map(Rigid::rotation_matrix).collect()
    }
}

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
    Layout::new(&is_held, points)
}

fn descend(state: &mut State, flat: &Flat<'_>, layout: &Layout, max_steps: usize) -> Report {
    let mut cost = total_cost(state, flat);
    let mut report = Report {
        cost_before: cost,
        cost_after: cost,
        n_steps: 0,
        radial: None,
    };
    let (mut damping, mut growth) = (1e-4, 2.0);
    let mut system = None;
    for _ in 0..max_steps {
        report.n_steps += 1;
        let normal = system
            .take()
            .unwrap_or_else(|| linearise(flat, state, layout));
        let candidate = step(state, flat, layout, &normal, damping);
        let new_cost = candidate
            .as_ref()
            .map_or(f64::INFINITY, |c| total_cost(c, flat));
        if let Some(candidate) = candidate.filter(|_| new_cost < cost) {
            *state = candidate;
            let gain = (cost - new_cost) / cost.max(1e-300);
            cost = new_cost;
            damping = (damping * 0.2).max(1e-9);
            growth = 2.0;
            if gain < 1e-5 {
                break;
            }
        } else {
            system = Some(normal);
            damping *= growth;
            growth *= 2.0;
            if damping > 1e6 {
                break;
            }
        }
    }
    report.cost_after = cost;
    if flat.moves[1] {
        let normal = system.unwrap_or_else(|| linearise(flat, state, layout));
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
            camera.cam_from_map = (motion * camera.cam_from_map).renormalized();
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
            let p = rotations[seen.camera_ix as usize] * point + camera.cam_from_map.translation;
            let share = project(camera, p).map_or(1e4, |(image, ..)| {
                scale * image.distance_squared(seen.pixel)
            });
            product *= 1.0 + share;
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
    costs.iter().sum::<f64>() / scale + holds.sum::<f64>()
}

/// Pixel of a point in the camera, and the plane z = 1 it went through; `None` behind the camera, or where the
/// radial polynomial has folded.
fn project(camera: &Camera, point_in_cam: DVec3) -> Option<(DVec2, DVec2, f64)> {
    if point_in_cam.z <= 1e-9 {
        return None;
    }
    let plane = point_in_cam.truncate() / point_in_cam.z;
    let bend = camera.radial * plane.length_squared();
    let i = &camera.intrinsics;
    let stretch = 1.0 + bend;
    (3.0 * bend > -1.0).then(|| {
        let pixel = DVec2::new(
            i.fx * stretch * plane.x + i.cx,
            i.fy * stretch * plane.y + i.cy,
        );
        (pixel, plane, stretch)
    })
}

/// How far a camera has moved from where it is held: shift, then turn.
fn strayed(camera: &Camera, start: &Camera) -> [f64; 6] {
    let motion = camera.cam_from_map * start.cam_from_map.inverse();
    let (shift, turn) = (motion.translation, motion.rotation.to_scaled_axis());
    [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
}

fn times(matrix: &[[f64; 6]; 6], v: &[f64; 6]) -> [f64; 6] {
    std::array::from_fn(|i| (0..6).map(|j| matrix[i][j] * v[j]).sum())
}

#[cfg(test)]
mod tests;
