//! Poses, points and focal lengths that fit the observations best: bundle adjustment in f64.
//!
//! Levenberg-Marquardt with the points eliminated (Schur complement, Triggs et al. 2000) and Cauchy's loss. The
//! sums run over a fixed number of chunks, so the result does not depend on the number of threads.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};
use rayon::prelude::*;

use crate::camera::Intrinsics;
use crate::pose::Rigid;

/// Chunks of points that are summed apart.
const CHUNKS: usize = 4;
/// Pose, then the logarithm of the focal length.
const PARAMS: usize = 7;

#[derive(Debug, Clone)]
pub struct Camera {
    pub cam_from_map: Rigid,
    pub intrinsics: Intrinsics,
    pub is_fixed: bool,
    /// This camera's focal length is the one that `Settings::refine_focal` moves.
    pub shares_focal: bool,
}

#[derive(Debug, Clone, Copy)]
pub struct Observation {
    pub camera_ix: usize,
    pub pixel: DVec2,
}

#[derive(Debug, Clone, Default)]
pub struct Problem {
    pub cameras: Vec<Camera>,
    pub points: Vec<DVec3>,
    /// One list a point.
    pub observations: Vec<Vec<Observation>>,
}

#[derive(Debug, Clone, Copy)]
pub struct Settings {
    pub max_steps: usize,
    /// Residual at which Cauchy's loss starts to bend.
    pub loss_px: f64,
    pub refine_focal: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    pub cost_before: f64,
    pub cost_after: f64,
    pub n_steps: usize,
}

/// Moves the free cameras, all points and, if asked, the one shared focal length.
pub fn adjust(problem: &mut Problem, settings: &Settings) -> Report {
    let layout = Layout::new(problem, settings.refine_focal);
    let mut cost = total_cost(problem, settings.loss_px);
    let mut report = Report {
        cost_before: cost,
        cost_after: cost,
        n_steps: 0,
    };
    let (mut damping, mut growth) = (1e-4, 2.0);
    let mut system = None;
    for _ in 0..settings.max_steps {
        report.n_steps += 1;
        let normal = system
            .take()
            .unwrap_or_else(|| linearise(problem, &layout, settings.loss_px));
        let candidate = step(problem, &layout, &normal, damping);
        let new_cost = candidate
            .as_ref()
            .map_or(f64::INFINITY, |c| total_cost(c, settings.loss_px));
        if let Some(candidate) = candidate.filter(|_| new_cost < cost) {
            *problem = candidate;
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
    report
}

/// Where each camera's pose stands in the reduced system; the focal length is last.
struct Layout {
    offset: Vec<Option<usize>>,
    focal: Option<usize>,
    n: usize,
}

impl Layout {
    fn new(problem: &Problem, refine_focal: bool) -> Self {
        let mut n = 0;
        let place = |camera: &Camera| {
            (!camera.is_fixed).then(|| {
                n += 6;
                n - 6
            })
        };
        let offset = problem.cameras.iter().map(place).collect();
        let has_focal = refine_focal && problem.cameras.iter().any(|c| c.shares_focal);
        Self {
            offset,
            focal: has_focal.then_some(n),
            n: n + usize::from(has_focal),
        }
    }

    /// Columns of one camera's seven parameters; `None` for those held.
    fn columns(&self, camera_ix: usize, shares_focal: bool) -> (Option<usize>, Option<usize>) {
        (self.offset[camera_ix], self.focal.filter(|_| shares_focal))
    }
}

/// One observation, linearised: rows of u and v over pose and focal, and over the point, already weighted.
struct Row {
    camera_ix: usize,
    by_camera: SMatrix<f64, 2, PARAMS>,
    by_point: SMatrix<f64, 2, 3>,
    residual: SVector<f64, 2>,
}

struct PointBlock {
    rows: Vec<Row>,
    /// Point-point block and gradient, before damping.
    v: Matrix3<f64>,
    g: Vector3<f64>,
}

struct Normal {
    blocks: Vec<PointBlock>,
}

fn linearise(problem: &Problem, _layout: &Layout, loss_px: f64) -> Normal {
    let rotations: Vec<DMat3> = problem
        .cameras
        .iter()
        .map(|c| c.cam_from_map.rotation_matrix())
        .collect();
    let block = |(point, seen): (&DVec3, &Vec<Observation>)| {
        let rows: Vec<Row> = seen
            .iter()
            .filter_map(|o| row(problem, &rotations, *point, o, loss_px))
            .collect();
        let mut v = Matrix3::zeros();
        let mut g = Vector3::zeros();
        for r in &rows {
            v += r.by_point.transpose() * r.by_point;
            g += r.by_point.transpose() * r.residual;
        }
        PointBlock { rows, v, g }
    };
    Normal {
        blocks: problem
            .points
            .par_iter()
            .zip(&problem.observations)
            .map(block)
            .collect(),
    }
}

fn row(
    problem: &Problem,
    rotations: &[DMat3],
    point: DVec3,
    seen: &Observation,
    loss_px: f64,
) -> Option<Row> {
    let camera = &problem.cameras[seen.camera_ix];
    let p = rotations[seen.camera_ix] * point + camera.cam_from_map.translation;
    let image = camera.intrinsics.project(p)?;
    let r = image - seen.pixel;
    // Square root of the weight of iteratively reweighted least squares.
    let w = (1.0 / (1.0 + r.length_squared() / (loss_px * loss_px))).sqrt();
    let (x, y, iz) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
    let (fx, fy) = (w * camera.intrinsics.fx, w * camera.intrinsics.fy);
    let by_camera = SMatrix::<f64, 2, PARAMS>::from_row_slice(&[
        fx * iz,
        0.0,
        -fx * x * iz,
        -fx * x * y,
        fx * (1.0 + x * x),
        -fx * y,
        fx * x,
        0.0,
        fy * iz,
        -fy * y * iz,
        -fy * (1.0 + y * y),
        fy * x * y,
        fy * x,
        fy * y,
    ]);
    let turn = rotations[seen.camera_ix].transpose();
    let (du, dv) = (
        turn * DVec3::new(fx * iz, 0.0, -fx * x * iz),
        turn * DVec3::new(0.0, fy * iz, -fy * y * iz),
    );
    let by_point = SMatrix::<f64, 2, 3>::new(du.x, du.y, du.z, dv.x, dv.y, dv.z);
    Some(Row {
        camera_ix: seen.camera_ix,
        by_camera,
        by_point,
        residual: SVector::<f64, 2>::new(w * r.x, w * r.y),
    })
}

/// Solves the damped reduced system and applies the step; `None` where it is not positive definite.
fn step(problem: &Problem, layout: &Layout, normal: &Normal, damping: f64) -> Option<Problem> {
    let n = layout.n;
    let chunk_len = normal.blocks.len().div_ceil(CHUNKS).max(1);
    let parts: Vec<(DMatrix<f64>, DVector<f64>)> = normal
        .blocks
        .par_chunks(chunk_len)
        .map(|blocks| {
            let mut s = DMatrix::zeros(n, n);
            let mut b = DVector::zeros(n);
            for block in blocks {
                eliminate(problem, layout, block, damping, (&mut s, &mut b));
            }
            (s, b)
        })
        .collect();
    let (mut s, mut b) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (part_s, part_b) in parts {
        s += part_s;
        b += part_b;
    }
    for i in 0..n {
        s[(i, i)] += 1e-12;
    }
    let delta = if n == 0 { b } else { -s.cholesky()?.solve(&b) };
    let moved = apply(problem, layout, normal, &delta, damping);
    delta.iter().all(|v| v.is_finite()).then_some(moved)
}

fn damped(v: &Matrix3<f64>, damping: f64) -> Option<Matrix3<f64>> {
    let mut v = *v;
    for i in 0..3 {
        v[(i, i)] += damping * v[(i, i)] + 1e-12;
    }
    v.try_inverse()
}

/// Adds one point's share to the lower triangle of the reduced system.
fn eliminate(
    problem: &Problem,
    layout: &Layout,
    block: &PointBlock,
    damping: f64,
    (s, b): (&mut DMatrix<f64>, &mut DVector<f64>),
) {
    let Some(inverse) = damped(&block.v, damping) else {
        return;
    };
    let cross: Vec<SMatrix<f64, PARAMS, 3>> = block
        .rows
        .iter()
        .map(|r| r.by_camera.transpose() * r.by_point)
        .collect();
    let columns: Vec<[Option<usize>; PARAMS]> = block
        .rows
        .iter()
        .map(|r| {
            let (pose, focal) =
                layout.columns(r.camera_ix, problem.cameras[r.camera_ix].shares_focal);
            std::array::from_fn(|i| if i < 6 { pose.map(|p| p + i) } else { focal })
        })
        .collect();
    for (i, row) in block.rows.iter().enumerate() {
        let mut own = row.by_camera.transpose() * row.by_camera;
        for k in 0..PARAMS {
            own[(k, k)] *= 1.0 + damping;
        }
        let reduced = cross[i] * inverse;
        let gradient = row.by_camera.transpose() * row.residual - reduced * block.g;
        for (a, column) in columns[i].iter().enumerate() {
            if let Some(column) = column {
                b[*column] += gradient[a];
            }
        }
        add(s, &columns[i], &columns[i], &own);
        for (j, other) in cross.iter().enumerate() {
            if columns[j].iter().all(Option::is_none) {
                continue;
            }
            add(s, &columns[i], &columns[j], &-(reduced * other.transpose()));
        }
    }
}

fn add(
    s: &mut DMatrix<f64>,
    rows: &[Option<usize>; PARAMS],
    columns: &[Option<usize>; PARAMS],
    values: &SMatrix<f64, PARAMS, PARAMS>,
) {
    for (c, column) in columns.iter().enumerate() {
        let Some(column) = column else { continue };
        for (r, row) in rows.iter().enumerate() {
            if let Some(row) = row.filter(|row| row >= column) {
                s[(row, *column)] += values[(r, c)];
            }
        }
    }
}

fn apply(
    problem: &Problem,
    layout: &Layout,
    normal: &Normal,
    delta: &DVector<f64>,
    damping: f64,
) -> Problem {
    let mut out = problem.clone();
    let focal_step = layout.focal.map_or(0.0, |i| delta[i].clamp(-0.3, 0.3));
    for (camera, offset) in out.cameras.iter_mut().zip(&layout.offset) {
        if let Some(at) = *offset {
            let (rho, theta) = (
                DVec3::new(delta[at], delta[at + 1], delta[at + 2]),
                DVec3::new(delta[at + 3], delta[at + 4], delta[at + 5]),
            );
            camera.cam_from_map = (Rigid::exp(rho, theta) * camera.cam_from_map).renormalized();
        }
        if camera.shares_focal {
            camera.intrinsics.fx *= focal_step.exp();
            camera.intrinsics.fy *= focal_step.exp();
        }
    }
    out.points
        .par_iter_mut()
        .zip(&normal.blocks)
        .for_each(|(point, block)| {
            let Some(inverse) = damped(&block.v, damping) else {
                return;
            };
            let mut right = block.g;
            for row in &block.rows {
                let (pose, focal) =
                    layout.columns(row.camera_ix, problem.cameras[row.camera_ix].shares_focal);
                let part = SVector::<f64, PARAMS>::from_fn(|i, _| {
                    let column = if i < 6 { pose.map(|p| p + i) } else { focal };
                    column.map_or(0.0, |c| delta[c])
                });
                right += row.by_point.transpose() * (row.by_camera * part);
            }
            let moved = inverse * right;
            *point -= DVec3::new(moved[0], moved[1], moved[2]);
        });
    out
}

/// Cauchy's loss over all observations; a point behind a camera costs as much as one 100 losses away.
fn total_cost(problem: &Problem, loss_px: f64) -> f64 {
    let rotations: Vec<DMat3> = problem
        .cameras
        .iter()
        .map(|c| c.cam_from_map.rotation_matrix())
        .collect();
    let cost = |(point, seen): (&DVec3, &Vec<Observation>)| -> f64 {
        let one = |o: &Observation| {
            let camera = &problem.cameras[o.camera_ix];
            let image = camera
                .intrinsics
                .project(rotations[o.camera_ix] * *point + camera.cam_from_map.translation);
            let square = image.map_or(1e4 * loss_px * loss_px, |p| p.distance_squared(o.pixel));
            loss_px * loss_px * (1.0 + square / (loss_px * loss_px)).ln()
        };
        seen.iter().map(one).sum()
    };
    let costs: Vec<f64> = problem
        .points
        .par_iter()
        .zip(&problem.observations)
        .map(cost)
        .collect();
    costs.iter().sum()
}

#[cfg(test)]
mod tests;
