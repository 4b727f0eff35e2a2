//! Edges' derivatives -> the step that fits them best, by Cholesky's factors over rows that begin at their first entry.
//!
//! In order of time only the rows of loops are long, and what is left out is never filled in.

use crate::optim::pose_graph::edge::{DOF, Edge, Piece};

/// `J^T J` below and on its diagonal, each row from its first entry, and `-J^T r`.
#[derive(Clone)]
pub(crate) struct Normal {
    first: Vec<usize>,
    rows: Vec<Vec<f64>>,
    right: Vec<f64>,
}

impl Normal {
    pub(crate) fn new(n_nodes: usize, edges: &[Edge]) -> Self {
        let mut first: Vec<usize> = (0..n_nodes).collect();
        for edge in edges {
            let (low, high) = (edge.first.min(edge.second), edge.first.max(edge.second));
            first[high] = first[high].min(low);
        }
        let first: Vec<usize> = (0..DOF * n_nodes)
            .map(|row| DOF * first[row / DOF])
            .collect();
        Self {
            rows: first
                .iter()
                .enumerate()
                .map(|(row, from)| vec![0.0; row + 1 - from])
                .collect(),
            right: vec![0.0; DOF * n_nodes],
            first,
        }
    }

    pub(crate) fn add(&mut self, edge: &Edge, piece: &Piece) {
        let unknown = |column: usize| {
            let node = if column < DOF {
                edge.first
            } else {
                edge.second
            };
            DOF * node + column % DOF
        };
        let dot = |a: &[f64; DOF], b: &[f64; DOF]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        for (i, column) in piece.jacobian.iter().enumerate() {
            let row = unknown(i);
            self.right[row] -= dot(column, &piece.residual);
            for (j, other) in piece.jacobian.iter().enumerate() {
                let at = unknown(j);
                if at <= row {
                    self.rows[row][at - self.first[row]] += dot(column, other);
                }
            }
        }
    }

    /// The unknown stays 0.
    pub(crate) fn hold(&mut self, unknown: usize) {
        self.right[unknown] = 0.0;
        self.rows[unknown].fill(0.0);
        let first = self.first[unknown];
        self.rows[unknown][unknown - first] = 1.0;
        for row in unknown + 1..self.rows.len() {
            if self.first[row] <= unknown {
                let first = self.first[row];
                self.rows[row][unknown - first] = 0.0;
            }
        }
    }

    /// By Cholesky's factors; `None` where the damped matrix has none.
    pub(crate) fn solved(mut self, damping: f64) -> Option<Vec<f64>> {
        let n = self.rows.len();
        for row in 0..n {
            if let Some(diagonal) = self.rows[row].last_mut() {
                *diagonal += damping * diagonal.abs().max(1e-9);
            }
        }
        for row in 0..n {
            let first = self.first[row];
            let (done, rest) = self.rows.split_at_mut(row);
            let own = &mut rest[0];
            for column in first..row {
                let (other, other_first) = (&done[column], self.first[column]);
                let from = first.max(other_first);
                let common = own[from - first..column - first].iter();
                let sum: f64 = common
                    .zip(&other[from - other_first..])
                    .map(|(a, b)| a * b)
                    .sum();
                own[column - first] = (own[column - first] - sum) / other[column - other_first];
            }
            let squares: f64 = own[..row - first].iter().map(|v| v * v).sum();
            let pivot = own[row - first] - squares;
            if pivot.is_nan() || pivot <= 0.0 {
                return None;
            }
            own[row - first] = pivot.sqrt();
        }
        Some(self.substituted())
    }

    /// Forward, then back, with the factors in place.
    fn substituted(self) -> Vec<f64> {
        let mut x = self.right;
        for row in 0..x.len() {
            let (first, own) = (self.first[row], &self.rows[row]);
            let sum: f64 = own[..row - first]
                .iter()
                .zip(&x[first..row])
                .map(|(a, b)| a * b)
                .sum();
            x[row] = (x[row] - sum) / own[row - first];
        }
        for row in (0..x.len()).rev() {
            let (first, own) = (self.first[row], &self.rows[row]);
            x[row] /= own[row - first];
            let value = x[row];
            for (at, factor) in (first..row).zip(own) {
                x[at] -= factor * value;
            }
        }
        x
    }
}
