//! Poses that are tied to each other in pairs -> poses that agree with all ties as well as can be.
//!
//! Nodes are similarities, so that a unit which drifts along the way is found, too; where the unit is known they stay
//! rigid. Levenberg-Marquardt with Cauchy's loss on doubtful ties (Olson and Agarwal 2013 compare such losses). The normal
//! equations are factored row by row from the first entry of each: in order of time only the rows of loops are long.

mod normal;
#[cfg(test)]
mod tests;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use self::normal::Normal;
use crate::pose::Similarity;

/// Place, turn and scale.
const DOF: usize = 7;
/// Cauchy's loss bends at so many standard deviations in the end. At first it bends where the worst tie is, else links that
/// ask for a long way would pull no harder than ones that are wrong (graduated: Yang et al. 2020), then at so much less.
const BEND: f64 = 2.0;
const BEND_ROUND: f64 = 0.25;
/// Standard deviations of neighbours on the way: place as a share of the step and of the depth, turn, scale.
const STEP_PLACE: f64 = 0.02;
const STEP_DEPTH: f64 = 0.004;
const STEP_TURN: f64 = 0.004;
const STEP_SCALE: f64 = 0.01;
/// The same of a link to a place seen again: place as a share of the depth.
const LINK_PLACE: f64 = 0.04;
const LINK_TURN: f64 = 0.015;
const LINK_SCALE: f64 = 0.03;
/// Neighbours that a node on a way is tied to, steps that spread what links ask for, and standard deviations that these
/// must fit within on average then.
const N_TIED: usize = 2;
const MAX_STEPS: usize = 60;
const MAX_MISFIT: f64 = 4.0;
const FIRST_DAMPING: f64 = 1e-4;
const MAX_DAMPING: f64 = 1e8;
/// Less than this share of the cost gained by a step ends it.
const MIN_GAIN: f64 = 1e-6;
/// Step of the central differences; residuals have about unit size.
const STEP: f64 = 1e-6;

/// What is known of the second node, seen from the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tie {
    pub first: usize,
    pub second: usize,
    pub first_from_second: Similarity,
    /// Standard deviations: of place in the second node's unit, of turn in radians, of the logarithm of scale.
    pub std: [f64; 3],
    /// May be wrong altogether: its pull ends where it is far off.
    pub is_doubtful: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Graph {
    /// `map_from_node`.
    pub nodes: Vec<Similarity>,
    pub is_held: Vec<bool>,
    pub ties: Vec<Tie>,
    /// Without it nodes are as large as they were: SE(3).
    pub moves_scale: bool,
}

/// What relaxing did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Relaxed {
    pub cost_before: f64,
    pub cost_after: f64,
    pub n_steps: usize,
}

impl Tie {
    /// Keeps two nodes as they lie, about as well as neighbours on a way do; `depth` as the second node sees it.
    pub fn as_is(nodes: &[Similarity], (first, second): (usize, usize), depth: f64) -> Self {
        let first_from_second = nodes[first].inverse() * nodes[second];
        let step = first_from_second.translation.length();
        Self {
            first,
            second,
            first_from_second,
            std: [
                STEP_PLACE * step + STEP_DEPTH * depth,
                STEP_TURN,
                STEP_SCALE,
            ],
            is_doubtful: false,
        }
    }

    /// Keeps a way as it lies: each of its nodes is tied to the ones before it. `depth` as a node sees it.
    pub fn along(way: &[usize], nodes: &[Similarity], depth: impl Fn(usize) -> f64) -> Vec<Self> {
        let tied = |(at, &second): (usize, &usize)| {
            let near = &way[at.saturating_sub(N_TIED)..at];
            let tie = |&first: &usize| Self::as_is(nodes, (first, second), depth(second));
            near.iter().map(tie).collect::<Vec<Self>>()
        };
        way.iter().enumerate().flat_map(tied).collect()
    }

    /// A place that was seen from both.
    pub fn link(
        first_from_second: Similarity,
        (first, second): (usize, usize),
        depth: f64,
    ) -> Self {
        Self {
            first,
            second,
            first_from_second,
            std: [LINK_PLACE * depth, LINK_TURN, LINK_SCALE],
            is_doubtful: true,
        }
    }
}

/// How far apart two motions put a place: share of its depth, radians, logarithm of scale.
pub fn apart(place: DVec3, depth: f64, a: &Similarity, b: &Similarity) -> [f64; 3] {
    let shift = a.transform_point(place).distance(b.transform_point(place));
    [
        shift / (depth * b.scale),
        (a.inverse() * *b).angle(),
        (a.scale / b.scale).ln().abs(),
    ]
}

impl Graph {
    /// How far a tie is off, in standard deviations.
    pub fn misfit(&self, tie: &Tie) -> f64 {
        square(&residual(
            tie,
            &self.nodes[tie.first],
            &self.nodes[tie.second],
        ))
        .sqrt()
    }

    /// Mean misfit of the doubtful ties; NaN without any.
    pub fn mean_misfit(&self) -> f64 {
        let doubtful = self.ties.iter().filter(|t| t.is_doubtful);
        let (sum, n) = doubtful.fold((0.0, 0.0), |(sum, n), t| (sum + self.misfit(t), n + 1.0));
        sum / n
    }

    /// Spreads what doubtful ties ask for over the rest; `false` where they do not fit even then, or there are none.
    pub fn spread(&mut self) -> bool {
        let relaxed = self.relax(MAX_STEPS);
        let misfit = self.mean_misfit();
        tracing::debug!(?relaxed, misfit, "graph");
        misfit <= MAX_MISFIT && self.nodes.iter().all(Similarity::is_finite)
    }

    /// Moves all nodes but the held ones so that their ties fit, at most so many steps with each bend of the loss.
    pub fn relax(&mut self, max_steps: usize) -> Relaxed {
        let doubtful = self.ties.iter().filter(|t| t.is_doubtful);
        let mut bend = doubtful.map(|t| self.misfit(t)).fold(BEND, f64::max);
        let cost_before = self.cost(BEND);
        let mut n_steps = 0;
        loop {
            let relaxed = self.relax_with(bend, max_steps);
            n_steps += relaxed.n_steps;
            if bend <= BEND || !bend.is_finite() {
                return Relaxed {
                    cost_before,
                    n_steps,
                    ..relaxed
                };
            }
            bend = (bend * BEND_ROUND).max(BEND);
        }
    }

    fn relax_with(&mut self, bend: f64, max_steps: usize) -> Relaxed {
        let mut cost = self.cost(bend);
        let mut relaxed = Relaxed {
            cost_before: cost,
            cost_after: cost,
            n_steps: 0,
        };
        let mut damping = FIRST_DAMPING;
        while relaxed.n_steps < max_steps && damping < MAX_DAMPING {
            relaxed.n_steps += 1;
            let Some(step) = self.normal_equations(bend).solved(damping) else {
                damping *= 10.0;
                continue;
            };
            let before = std::mem::take(&mut self.nodes);
            self.nodes = moved(&before, &step);
            let new_cost = self.cost(bend);
            if new_cost.is_nan() || new_cost >= cost {
                self.nodes = before;
                damping *= 10.0;
                continue;
            }
            damping = (damping * 0.1).max(1e-12);
            let gain = (cost - new_cost) / cost;
            cost = new_cost;
            if gain < MIN_GAIN {
                break;
            }
        }
        relaxed.cost_after = cost;
        relaxed
    }

    fn cost(&self, bend: f64) -> f64 {
        let of = |tie: &Tie| {
            let square = square(&residual(
                tie,
                &self.nodes[tie.first],
                &self.nodes[tie.second],
            ));
            if tie.is_doubtful {
                bend * bend * (square / (bend * bend)).ln_1p()
            } else {
                square
            }
        };
        self.ties.iter().map(of).sum()
    }

    fn normal_equations(&self, bend: f64) -> Normal {
        let pieces: Vec<Piece> = self
            .ties
            .par_iter()
            .map(|tie| self.piece(tie, bend))
            .collect();
        let mut normal = Normal::new(self.nodes.len(), &self.ties);
        for (tie, piece) in self.ties.iter().zip(&pieces) {
            normal.add(tie, piece);
        }
        for (ix, is_held) in self.is_held.iter().enumerate() {
            let n_held = match (is_held, self.moves_scale) {
                (true, _) => 0..DOF,
                (false, false) => DOF - 1..DOF,
                (false, true) => continue,
            };
            n_held.for_each(|axis| normal.hold(DOF * ix + axis));
        }
        normal
    }

    /// The tie's residual and its derivatives by both nodes, each weighed by the loss.
    fn piece(&self, tie: &Tie, bend: f64) -> Piece {
        let (a, b) = (self.nodes[tie.first], self.nodes[tie.second]);
        let at = residual(tie, &a, &b);
        let weight = if tie.is_doubtful {
            (1.0 + square(&at) / (bend * bend)).recip().sqrt()
        } else {
            1.0
        };
        let mut jacobian = [[0.0; DOF]; 2 * DOF];
        for (column, out) in jacobian.iter_mut().enumerate() {
            let shifted = |size: f64| {
                let mut step = [0.0; DOF];
                step[column % DOF] = size;
                if column < DOF {
                    residual(tie, &stepped(&a, &step), &b)
                } else {
                    residual(tie, &a, &stepped(&b, &step))
                }
            };
            let (plus, minus) = (shifted(STEP), shifted(-STEP));
            for row in 0..DOF {
                out[row] = weight * (plus[row] - minus[row]) / (2.0 * STEP);
            }
        }
        Piece {
            jacobian,
            residual: at.map(|r| weight * r),
        }
    }
}

/// By column: derivatives of the seven residuals by the first node, then by the second.
struct Piece {
    jacobian: [[f64; DOF]; 2 * DOF],
    residual: [f64; DOF],
}

fn square(residual: &[f64; DOF]) -> f64 {
    residual.iter().map(|r| r * r).sum()
}

/// In standard deviations: place, turn, logarithm of scale.
fn residual(tie: &Tie, a: &Similarity, b: &Similarity) -> [f64; DOF] {
    let off = tie.first_from_second.inverse() * (a.inverse() * *b);
    // The short way round; the angle of the logarithm stays below a half turn.
    let rotation = if off.rotation.w < 0.0 {
        -off.rotation
    } else {
        off.rotation
    };
    let turn = rotation.to_scaled_axis() / tie.std[1];
    let shift = off.translation / tie.std[0];
    [
        shift.x,
        shift.y,
        shift.z,
        turn.x,
        turn.y,
        turn.z,
        off.scale.ln() / tie.std[2],
    ]
}

fn stepped(node: &Similarity, step: &[f64]) -> Similarity {
    let delta = Similarity {
        scale: step[6].exp(),
        rotation: DQuat::from_scaled_axis(DVec3::new(step[3], step[4], step[5])),
        translation: DVec3::new(step[0], step[1], step[2]),
    };
    let moved = *node * delta;
    Similarity {
        rotation: moved.rotation.normalize(),
        ..moved
    }
}

fn moved(nodes: &[Similarity], step: &[f64]) -> Vec<Similarity> {
    let steps = step.chunks_exact(DOF);
    nodes
        .iter()
        .zip(steps)
        .map(|(n, s)| stepped(n, s))
        .collect()
}
