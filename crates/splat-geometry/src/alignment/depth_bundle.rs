//! Tracks, rough poses and depth of an unknown unit in each view -> poses that fit pixels and depth.
//!
//! Bundle adjustment with a third residual beside u and v: the logarithm of the point's depth over the network's, less the
//! view's own log-scale. Dense and small: a window has a dozen cameras. `geometry::bundle` is for hundreds, pixels only.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};
use rayon::prelude::*;

use crate::alignment::depth_bundle_state::State;
use crate::alignment::depths::Depths;
use crate::alignment::matched::Matched;
use crate::alignment::tracks::Track;
use crate::optim::damped::{self, LeastSquares, Schedule};
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// Pose, log-scale of the view's depth, log-focal.
const PARAMS: usize = 8;
const PER_CAMERA: usize = 7;
/// Of these, the rotation.
const TURN: std::ops::Range<usize> = 3..6;
/// Standard deviations that hold what nothing else does: the common unit of all depths, and the focal length.
const SCALE_PRIOR: f64 = 0.3;
const FOCAL_PRIOR: f64 = 0.1;
/// Cauchy's loss bends at so many px (and standard deviations of depth), from rough to fine, for so many steps each.
const ROUNDS: [(f64, usize); 3] = [(16.0, 12), (4.0, 10), (1.0, 20)];
const SCHEDULE: Schedule = Schedule {
    first: 1e-3,
    down: 0.2,
    least: 1e-9,
    up: 8.0,
    up_growth: 1.0,
    most: 1e6,
    min_gain: 1e-5,
};
const CHUNKS: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Relative error that the depth is expected to have.
    pub depth_error: f64,
    pub moves_focal: bool,
    /// Orientations move; else only places and scales of depth, which leaves what lines said of orientations.
    pub turns: bool,
}

/// Moves the poses that are not held, and the focal length if asked. Returns each view's log-scale.
pub fn align(
    matched: &mut Matched,
    tracks: &[Track],
    depths: &Depths,
    settings: &Settings,
) -> Vec<f64> {
    let mut state = State::new(matched, tracks, depths);
    let mut fixed = Fixed::new(matched, &state, depths, settings);
    for (loss, max_steps) in ROUNDS {
        fixed.loss = loss;
        damped::descend(&fixed, &mut state, &SCHEDULE, max_steps);
    }
    let is_sound = state.poses.iter().all(Rigid::is_finite) && state.log_focal.is_finite();
    if is_sound {
        for (view, pose) in matched.views.iter_mut().zip(&state.poses) {
            if !view.is_held {
                view.cam_from_submap = *pose;
            }
            view.lens = view.lens.refocused(state.log_focal.exp());
        }
    }
    state.log_scales
}

/// One observation of one point.
struct ViewFeatures {
    view: usize,
    pixel: DVec2,
    log_depth: Option<f64>,
}

struct Fixed {
    lenses: Vec<Intrinsics>,
    seen: Vec<Vec<ViewFeatures>>,
    /// Columns of each camera's parameters.
    columns: Vec<[Option<usize>; PARAMS]>,
    n: usize,
    /// Pixels that weigh as much as a log-depth off by 1.
    depth_weight: f64,
    /// Where Cauchy's loss bends.
    loss: f64,
}

/// Derivatives are made anew for each damping: the points are eliminated with it.
impl LeastSquares for Fixed {
    type State = State;
    type Linear = ();

    fn cost(&self, state: &State) -> f64 {
        let rotations = rotations(state);
        let square = self.loss * self.loss;
        let one = |(point, seen): (&DVec3, &Vec<ViewFeatures>)| -> f64 {
            let part = |s: &ViewFeatures| {
                let Some((r, _)) = self.residual(state, &rotations, *point, s) else {
                    return 2.0 * square * 1e4_f64.ln();
                };
                let pixels = r[0] * r[0] + r[1] * r[1];
                square * ((1.0 + pixels / square).ln() + (1.0 + r[2] * r[2] / square).ln())
            };
            seen.iter().map(part).sum()
        };
        let parts: Vec<f64> = state.points.par_iter().zip(&self.seen).map(one).collect();
        let priors: f64 = state
            .log_scales
            .iter()
            .map(|s| (s / SCALE_PRIOR).powi(2))
            .sum();
        parts.iter().sum::<f64>() + priors + (state.log_focal / FOCAL_PRIOR).powi(2)
    }

    fn linearise(&self, _: &State) {}

    fn stepped(&self, state: &State, (): &(), damping: f64) -> Option<State> {
        let rotations = rotations(state);
        let blocks: Vec<Block> = (0..state.points.len())
            .into_par_iter()
            .map(|ix| self.block(state, &rotations, ix, damping))
            .collect();
        let chunk_len = blocks.len().div_ceil(CHUNKS).max(1);
        let parts: Vec<(DMatrix<f64>, DVector<f64>)> = blocks
            .par_chunks(chunk_len)
            .map(|blocks| {
                let mut sums = (DMatrix::zeros(self.n, self.n), DVector::zeros(self.n));
                blocks
                    .iter()
                    .for_each(|block| self.eliminate(block, damping, &mut sums));
                sums
            })
            .collect();
        let mut s = DMatrix::<f64>::zeros(self.n, self.n);
        let mut b = DVector::<f64>::zeros(self.n);
        for (part_s, part_b) in parts {
            s += part_s;
            b += part_b;
        }
        self.add_priors(state, &mut s, &mut b);
        let delta = -s.cholesky()?.solve(&b);
        delta
            .iter()
            .all(|v| v.is_finite())
            .then(|| self.moved(state, &blocks, &delta))
    }
}

impl Fixed {
    fn new(matched: &Matched, state: &State, depths: &Depths, settings: &Settings) -> Self {
        let is_anchored = matched.views.iter().any(|s| s.is_held);
        let mut n = 0;
        let mut columns = vec![[None; PARAMS]; matched.views.len()];
        for (ix, (aligned_view, own)) in matched.views.iter().zip(&mut columns).enumerate() {
            let is_free = !aligned_view.is_held && (is_anchored || ix > 0);
            for (k, column) in own.iter_mut().take(PER_CAMERA).enumerate() {
                let is_turn = TURN.contains(&k);
                if (is_free && (settings.turns || !is_turn)) || k == PER_CAMERA - 1 {
                    *column = Some(n);
                    n += 1;
                }
            }
        }
        if settings.moves_focal {
            columns.iter_mut().for_each(|own| own[PARAMS - 1] = Some(n));
            n += 1;
        }
        let seen = |track: &Track| {
            let one = |&(view, feature): &(usize, usize)| ViewFeatures {
                view,
                pixel: matched.views[view].pixels[feature],
                log_depth: depths[view][feature].map(f64::ln),
            };
            track.iter().map(one).collect()
        };
        Self {
            lenses: matched.views.iter().map(|s| s.lens).collect(),
            seen: state.tracks.iter().map(seen).collect(),
            columns,
            n,
            depth_weight: 1.0 / settings.depth_error.max(1e-6),
            loss: ROUNDS[0].0,
        }
    }

    /// Residual (u, v, depth) in px and the point in the camera; `None` behind it.
    fn residual(
        &self,
        state: &State,
        rotations: &[DMat3],
        point: DVec3,
        seen: &ViewFeatures,
    ) -> Option<(SVector<f64, 3>, DVec3)> {
        let p = rotations[seen.view] * point + state.poses[seen.view].translation;
        let lens = self.lenses[seen.view].refocused(state.log_focal.exp());
        let off = lens.project(p)? - seen.pixel;
        let depth = seen.log_depth.map_or(0.0, |given| {
            self.depth_weight * (p.z.ln() - given - state.log_scales[seen.view])
        });
        Some((SVector::<f64, 3>::new(off.x, off.y, depth), p))
    }

    fn row(
        &self,
        state: &State,
        rotations: &[DMat3],
        (point, seen): (DVec3, &ViewFeatures),
    ) -> Option<Row> {
        let (r, p) = self.residual(state, rotations, point, seen)?;
        let square = self.loss * self.loss;
        // Square roots of the weights of iteratively reweighted least squares.
        let w = (1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / square)).sqrt();
        let w_depth = (1.0 / (1.0 + r[2] * r[2] / square)).sqrt();
        let focal = state.log_focal.exp();
        let lens = &self.lenses[seen.view];
        let (fx, fy) = (w * focal * lens.fx, w * focal * lens.fy);
        let (x, y, iz) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
        let d = if seen.log_depth.is_some() {
            w_depth * self.depth_weight
        } else {
            0.0
        };
        let in_cam = [
            DVec3::new(fx * iz, 0.0, -fx * x * iz),
            DVec3::new(0.0, fy * iz, -fy * y * iz),
            DVec3::new(0.0, 0.0, d * iz),
        ];
        let by_rest = [[0.0, fx * x], [0.0, fy * y], [-d, 0.0]];
        let turn = rotations[seen.view].transpose();
        let mut by_camera = SMatrix::<f64, 3, PARAMS>::zeros();
        let mut by_point = SMatrix::<f64, 3, 3>::zeros();
        for (i, g) in in_cam.iter().enumerate() {
            // A turn theta moves the point by theta x p.
            let by_turn = p.cross(*g);
            let point = turn * *g;
            for k in 0..3 {
                by_camera[(i, k)] = g[k];
                by_camera[(i, 3 + k)] = by_turn[k];
                by_point[(i, k)] = point[k];
            }
            by_camera[(i, 6)] = by_rest[i][0];
            by_camera[(i, 7)] = by_rest[i][1];
        }
        Some(Row {
            view: seen.view,
            by_camera,
            by_point,
            residual: SVector::<f64, 3>::new(w * r[0], w * r[1], w_depth * r[2]),
        })
    }

    fn block(&self, state: &State, rotations: &[DMat3], ix: usize, damping: f64) -> Block {
        let rows: Vec<Row> = self.seen[ix]
            .iter()
            .filter_map(|s| self.row(state, rotations, (state.points[ix], s)))
            .collect();
        let (mut v, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for row in &rows {
            v += row.by_point.transpose() * row.by_point;
            g += row.by_point.transpose() * row.residual;
        }
        for i in 0..3 {
            v[(i, i)] += damping * v[(i, i)] + 1e-12;
        }
        Block {
            rows,
            inverse: v.try_inverse(),
            g,
        }
    }

    fn add_priors(&self, state: &State, s: &mut DMatrix<f64>, b: &mut DVector<f64>) {
        for (columns, scale) in self.columns.iter().zip(&state.log_scales) {
            if let Some(at) = columns[PER_CAMERA - 1] {
                s[(at, at)] += SCALE_PRIOR.powi(-2);
                b[at] += scale * SCALE_PRIOR.powi(-2);
            }
        }
        if let Some(at) = self.columns.first().and_then(|c| c[PARAMS - 1]) {
            s[(at, at)] += FOCAL_PRIOR.powi(-2);
            b[at] += state.log_focal * FOCAL_PRIOR.powi(-2);
        }
        for i in 0..self.n {
            s[(i, i)] += 1e-9;
        }
    }

    /// Adds one point's share to the lower triangle of the reduced system.
    fn eliminate(&self, block: &Block, damping: f64, (s, b): &mut (DMatrix<f64>, DVector<f64>)) {
        let Some(inverse) = block.inverse else { return };
        let cross: Vec<SMatrix<f64, PARAMS, 3>> = block
            .rows
            .iter()
            .map(|r| r.by_camera.transpose() * r.by_point)
            .collect();
        for (i, row) in block.rows.iter().enumerate() {
            let mut own = row.by_camera.transpose() * row.by_camera;
            for k in 0..PARAMS {
                own[(k, k)] *= 1.0 + damping;
            }
            let reduced = cross[i] * inverse;
            let gradient = row.by_camera.transpose() * row.residual - reduced * block.g;
            let columns = &self.columns[row.view];
            for (k, column) in columns.iter().enumerate() {
                if let Some(column) = column {
                    b[*column] += gradient[k];
                }
            }
            add(s, columns, columns, &own);
            let has_focal = columns[PARAMS - 1].is_some();
            for (other, w) in block.rows.iter().zip(&cross) {
                // All of it would fall into the upper triangle.
                if other.view > row.view && !has_focal {
                    continue;
                }
                add(
                    s,
                    columns,
                    &self.columns[other.view],
                    &-(reduced * w.transpose()),
                );
            }
        }
    }

    fn moved(&self, state: &State, blocks: &[Block], delta: &DVector<f64>) -> State {
        let at = |column: Option<usize>| column.map_or(0.0, |c| delta[c]);
        let mut out = state.clone();
        for (ix, columns) in self.columns.iter().enumerate() {
            let part: [f64; PARAMS] = columns.map(at);
            let (rho, theta) = (
                DVec3::from_slice(&part[..3]),
                DVec3::from_slice(&part[3..6]),
            );
            if columns[0].is_some() {
                out.poses[ix] = (Rigid::exp(rho, theta) * state.poses[ix]).renormalized();
            }
            out.log_scales[ix] += part[6].clamp(-1.0, 1.0);
        }
        let focal = self.columns.first().and_then(|c| c[PARAMS - 1]);
        out.log_focal = (out.log_focal + at(focal)).clamp(-1.0, 1.0);
        for (point, block) in out.points.iter_mut().zip(blocks) {
            let Some(inverse) = block.inverse else {
                continue;
            };
            let mut right = block.g;
            for row in &block.rows {
                let columns = &self.columns[row.view];
                let part = SVector::<f64, PARAMS>::from_fn(|i, _| at(columns[i]));
                right += row.by_point.transpose() * (row.by_camera * part);
            }
            let moved = inverse * right;
            *point -= DVec3::new(moved[0], moved[1], moved[2]);
        }
        out
    }
}

/// One observation, linearised and weighted.
struct Row {
    view: usize,
    by_camera: SMatrix<f64, 3, PARAMS>,
    by_point: SMatrix<f64, 3, 3>,
    residual: SVector<f64, 3>,
}

struct Block {
    rows: Vec<Row>,
    /// Of the damped point-point block.
    inverse: Option<Matrix3<f64>>,
    g: Vector3<f64>,
}

fn rotations(state: &State) -> Vec<DMat3> {
    state.poses.iter().map(Rigid::rotation_matrix).collect()
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
