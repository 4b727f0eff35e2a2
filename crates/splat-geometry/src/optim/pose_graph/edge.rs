//! What edges two nodes of a pose graph to each other, and by how much they miss it.

use splat_types::transform::{Similarity, rotation_vector};

/// Place, turn and scale.
pub(crate) const DOF: usize = 7;

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

/// What is known of the second node, seen from the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    pub first: usize,
    pub second: usize,
    pub first_from_second: Similarity,
    /// Standard deviations: of place in the second node's unit, of turn in radians, of the logarithm of scale.
    pub std: [f64; 3],
    /// May be wrong altogether: its pull ends where it is far off.
    pub is_doubtful: bool,
}

impl Edge {
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
            let edge = |&first: &usize| Self::as_is(nodes, (first, second), depth(second));
            near.iter().map(edge).collect::<Vec<Self>>()
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

/// By column: derivatives of the seven residuals by the first node, then by the second.
pub(crate) struct Piece {
    pub(crate) jacobian: [[f64; DOF]; 2 * DOF],
    pub(crate) residual: [f64; DOF],
}

pub(crate) fn square(residual: &[f64; DOF]) -> f64 {
    residual.iter().map(|r| r * r).sum()
}

/// In standard deviations: place, turn, logarithm of scale.
pub(crate) fn residual(edge: &Edge, a: &Similarity, b: &Similarity) -> [f64; DOF] {
    let off = edge.first_from_second.inverse() * (a.inverse() * *b);
    // The angle of the logarithm stays below a half turn.
    let turn = rotation_vector(off.rotation) / edge.std[1];
    let shift = off.translation / edge.std[0];
    [
        shift.x,
        shift.y,
        shift.z,
        turn.x,
        turn.y,
        turn.z,
        off.scale.ln() / edge.std[2],
    ]
}
