//! Poses that are tied to each other in pairs -> poses that agree with all edges as well as can be.
//!
//! Nodes are similarities, so that a unit which drifts along the way is found, too; where the unit is known they stay
//! rigid. Levenberg-Marquardt with Cauchy's loss on doubtful edges (Olson and Agarwal 2013 compare such losses). The normal
//! equations are factored row by row from the first entry of each: in order of time only the rows of loops are long.

pub mod edge;

mod normal;

#[cfg(test)]
mod tests;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::optim::damped::{self, LeastSquares, Schedule};
use crate::optim::pose_graph::edge::{DOF, Edge, Piece, residual, square};
use crate::optim::pose_graph::normal::Normal;
use splat_types::transform::Similarity;

/// Cauchy's loss bends at so many standard deviations in the end. At first it bends where the worst edge is, else links that
/// ask for a long way would pull no harder than ones that are wrong (graduated: Yang et al. 2020), then at so much less.
const BEND: f64 = 2.0;
const BEND_ROUND: f64 = 0.25;
const MAX_STEPS: usize = 60;
const MAX_MISFIT: f64 = 4.0;
const SCHEDULE: Schedule = Schedule {
    first: 1e-4,
    down: 0.1,
    least: 1e-12,
    up: 10.0,
    up_growth: 1.0,
    most: 1e8,
    min_gain: 1e-6,
};
/// Step of the central differences; residuals have about unit size.
const STEP: f64 = 1e-6;

#[derive(Debug, Clone, PartialEq)]
pub struct Graph {
    /// `map_from_node`.
    pub nodes: Vec<Similarity>,
    pub is_held: Vec<bool>,
    pub edges: Vec<Edge>,
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
    /// How far an edge is off, in standard deviations.
    pub fn misfit(&self, edge: &Edge) -> f64 {
        square(&residual(
            edge,
            &self.nodes[edge.first],
            &self.nodes[edge.second],
        ))
        .sqrt()
    }

    /// Mean misfit of the doubtful edges; NaN without any.
    pub fn mean_misfit(&self) -> f64 {
        let doubtful = self.edges.iter().filter(|t| t.is_doubtful);
        let (sum, n) = doubtful.fold((0.0, 0.0), |(sum, n), t| (sum + self.misfit(t), n + 1.0));
        sum / n
    }

    /// Spreads what doubtful edges ask for over the rest; `false` where they do not fit even then, or there are none.
    pub fn spread(&mut self) -> bool {
        let relaxed = self.relax(MAX_STEPS);
        let misfit = self.mean_misfit();
        tracing::debug!(?relaxed, misfit, "graph");
        misfit <= MAX_MISFIT && self.nodes.iter().all(Similarity::is_finite)
    }

    /// Moves all nodes but the held ones so that their edges fit, at most so many steps with each bend of the loss.
    pub fn relax(&mut self, max_steps: usize) -> Relaxed {
        let doubtful = self.edges.iter().filter(|t| t.is_doubtful);
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
        let mut nodes = std::mem::take(&mut self.nodes);
        let distorted = Distorted { graph: self, bend };
        let descent = damped::descend(&distorted, &mut nodes, &SCHEDULE, max_steps);
        self.nodes = nodes;
        Relaxed {
            cost_before: descent.cost_before,
            cost_after: descent.cost_after,
            n_steps: descent.n_steps,
        }
    }

    fn cost(&self, bend: f64) -> f64 {
        Distorted { graph: self, bend }.cost(&self.nodes)
    }
}

/// A graph with a loss that bends somewhere. Nodes stand apart from it: they are what moves.
struct Distorted<'a> {
    graph: &'a Graph,
    bend: f64,
}

impl LeastSquares for Distorted<'_> {
    type State = Vec<Similarity>;
    type Linear = Normal;

    fn cost(&self, nodes: &Vec<Similarity>) -> f64 {
        let bend = self.bend;
        let of = |edge: &Edge| {
            let square = square(&residual(edge, &nodes[edge.first], &nodes[edge.second]));
            if edge.is_doubtful {
                bend * bend * (square / (bend * bend)).ln_1p()
            } else {
                square
            }
        };
        self.graph.edges.iter().map(of).sum()
    }

    fn linearise(&self, nodes: &Vec<Similarity>) -> Normal {
        let graph = self.graph;
        let pieces: Vec<Piece> = graph
            .edges
            .par_iter()
            .map(|edge| piece(edge, nodes, self.bend))
            .collect();
        let mut normal = Normal::new(nodes.len(), &graph.edges);
        for (edge, piece) in graph.edges.iter().zip(&pieces) {
            normal.add(edge, piece);
        }
        for (ix, is_held) in graph.is_held.iter().enumerate() {
            let n_held = match (is_held, graph.moves_scale) {
                (true, _) => 0..DOF,
                (false, false) => DOF - 1..DOF,
                (false, true) => continue,
            };
            n_held.for_each(|axis| normal.hold(DOF * ix + axis));
        }
        normal
    }

    fn stepped(
        &self,
        nodes: &Vec<Similarity>,
        normal: &Normal,
        damping: f64,
    ) -> Option<Vec<Similarity>> {
        let step = normal.clone().solved(damping)?;
        Some(moved(nodes, &step))
    }
}

/// The edge's residual and its derivatives by both nodes, each weighed by the loss.
fn piece(edge: &Edge, nodes: &[Similarity], bend: f64) -> Piece {
    let (a, b) = (nodes[edge.first], nodes[edge.second]);
    let at = residual(edge, &a, &b);
    let weight = if edge.is_doubtful {
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
                residual(edge, &stepped(&a, &step), &b)
            } else {
                residual(edge, &a, &stepped(&b, &step))
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
