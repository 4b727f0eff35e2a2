//! The reduced system of bundle adjustment: one 6x6 block for two cameras that see common points, and two parameters
//! of the lens that all may share. Solved by Cholesky within its envelope.
//!
//! Cameras of a stream see few others, so in the order of Cuthill and McKee (1969, reversed as by George 1971) each
//! block row is short: what lies left of its first block stays zero.

use rayon::prelude::*;

/// 6x6, row by row.
pub(crate) type Block = [f64; 36];
/// Logarithm of the focal length, radial coefficient.
pub(crate) const LENS: usize = 2;
/// Place of a camera that is held.
pub(crate) const HELD: u32 = u32::MAX;
/// Products of blocks below which a column is not worth sharing among threads.
const MIN_SHARED: usize = 2000;

/// Where each camera stands in the system.
#[derive(Debug)]
pub(crate) struct Layout {
    /// By camera: its block row, or `HELD`.
    pub(crate) slot_of: Vec<u32>,
    /// By block row: its first column that is not zero.
    first: Vec<usize>,
}

impl Layout {
    /// `points` lists the cameras that see each point, more than once if it likes.
    pub(crate) fn new<'a>(is_held: &[bool], points: impl Iterator<Item = &'a [u32]>) -> Self {
        let mut slot_of = vec![HELD; is_held.len()];
        let free: Vec<usize> = (0..is_held.len()).filter(|&i| !is_held[i]).collect();
        for (slot, &camera) in free.iter().enumerate() {
            slot_of[camera] = slot as u32;
        }
        let n = free.len();
        let mut meets = vec![false; n * n];
        let mut slots = Vec::new();
        for cameras in points {
            slots.clear();
            slots.extend(
                cameras
                    .iter()
                    .map(|&c| slot_of[c as usize])
                    .filter(|s| *s != HELD),
            );
            for &a in &slots {
                for &b in &slots {
                    meets[a as usize * n + b as usize] = true;
                }
            }
        }
        let others: Vec<Vec<usize>> = (0..n)
            .map(|a| (0..n).filter(|&b| b != a && meets[a * n + b]).collect())
            .collect();
        let mut place = vec![0; n];
        for (slot, old) in short_rows(&others).into_iter().enumerate() {
            place[old] = slot;
        }
        let mut first: Vec<usize> = (0..n).collect();
        for (a, others) in others.iter().enumerate() {
            for &b in others {
                first[place[a]] = first[place[a]].min(place[b]);
            }
        }
        for slot in slot_of.iter_mut().filter(|s| **s != HELD) {
            *slot = place[*slot as usize] as u32;
        }
        Self { slot_of, first }
    }

    pub(crate) fn n_slots(&self) -> usize {
        self.first.len()
    }
}

/// Order of the nodes of a graph in which every edge spans few others.
fn short_rows(others: &[Vec<usize>]) -> Vec<usize> {
    let n = others.len();
    let mut order: Vec<usize> = Vec::with_capacity(n);
    let mut is_taken = vec![false; n];
    while order.len() < n {
        let free = (0..n).filter(|&i| !is_taken[i]);
        let Some(seed) = free.min_by_key(|&i| others[i].len()) else {
            break;
        };
        // The last node reached from anywhere is near an end, and the order starts there.
        let end = breadth_first(seed, others, &mut is_taken.clone());
        let start = end.last().copied().unwrap_or(seed);
        order.extend(breadth_first(start, others, &mut is_taken));
    }
    order.reverse();
    order
}

fn breadth_first(start: usize, others: &[Vec<usize>], is_taken: &mut [bool]) -> Vec<usize> {
    let mut order = vec![start];
    is_taken[start] = true;
    let mut done = 0;
    while let Some(&node) = order.get(done) {
        done += 1;
        let mut next: Vec<usize> = others[node]
            .iter()
            .copied()
            .filter(|&o| !is_taken[o])
            .collect();
        next.sort_by_key(|&o| (others[o].len(), o));
        for o in next {
            is_taken[o] = true;
            order.push(o);
        }
    }
    order
}

/// Lower triangle, gradient, and the rows of the lens, which stand last.
#[derive(Debug)]
pub(crate) struct System {
    rows: Vec<Vec<Block>>,
    first: Vec<usize>,
    pub(crate) gradient: Vec<[f64; 6]>,
    /// 6x2 each, row by row.
    pub(crate) border: Vec<[f64; 12]>,
    pub(crate) corner: [[f64; LENS]; LENS],
    pub(crate) lens_gradient: [f64; LENS],
}

/// The step.
#[derive(Debug)]
pub(crate) struct Solution {
    /// By block row.
    pub(crate) poses: Vec<[f64; 6]>,
    pub(crate) lens: [f64; LENS],
    /// Diagonal of the inverse: variances for observations of variance 1.
    pub(crate) lens_variance: [f64; LENS],
}

impl System {
    pub(crate) fn zero(layout: &Layout) -> Self {
        let n = layout.n_slots();
        let row = |i: usize| vec![[0.0; 36]; i + 1 - layout.first[i]];
        Self {
            rows: (0..n).map(row).collect(),
            first: layout.first.clone(),
            gradient: vec![[0.0; 6]; n],
            border: vec![[0.0; 12]; n],
            corner: [[0.0; LENS]; LENS],
            lens_gradient: [0.0; LENS],
        }
    }

    /// `row >= column`, and both see a common point.
    pub(crate) fn block(&mut self, row: usize, column: usize) -> &mut Block {
        &mut self.rows[row][column - self.first[row]]
    }

    pub(crate) fn add(&mut self, other: &Self) {
        let rows = self.rows.iter_mut().flatten().flatten();
        add(rows, other.rows.iter().flatten().flatten());
        add(
            self.gradient.iter_mut().flatten(),
            other.gradient.iter().flatten(),
        );
        add(
            self.border.iter_mut().flatten(),
            other.border.iter().flatten(),
        );
        add(
            self.corner.iter_mut().flatten(),
            other.corner.iter().flatten(),
        );
        add(self.lens_gradient.iter_mut(), other.lens_gradient.iter());
    }

    /// The x for which the system times x is minus the gradient; `None` where it is not positive definite. Lens
    /// parameters that are not `moves` stay.
    pub(crate) fn solve(mut self, moves: [bool; LENS]) -> Option<Solution> {
        for (row, _) in self.rows.iter_mut().zip(0..) {
            if let Some(own) = row.last_mut() {
                (0..6).for_each(|k| own[7 * k] += 1e-12);
            }
        }
        self.factorise()?;
        let mut base = self.gradient.clone();
        self.substitute(&mut base);
        let mut lens = [0.0; LENS];
        let mut lens_variance = [0.0; LENS];
        let mut distorted = Vec::new();
        if moves.contains(&true) {
            distorted = (0..LENS).map(|k| self.border_column(k)).collect();
            let (mut left, mut right) = (self.corner, self.lens_gradient);
            for i in 0..LENS {
                right[i] -= self.across(i, &base);
                for (j, column) in distorted.iter().enumerate() {
                    left[i][j] -= self.across(i, column);
                }
                left[i][i] += 1e-12;
            }
            for i in (0..LENS).filter(|&i| !moves[i]) {
                right[i] = 0.0;
                (0..LENS).for_each(|j| (left[i][j], left[j][i]) = (0.0, 0.0));
                left[i][i] = 1.0;
            }
            let determinant = left[0][0] * left[1][1] - left[0][1] * left[1][0];
            if !(left[0][0] > 0.0 && determinant > 0.0) {
                return None;
            }
            let inverse = |i: usize, j: usize| {
                let sign = if i == j { 1.0 } else { -1.0 };
                sign * left[1 - j][1 - i] / determinant
            };
            for i in 0..LENS {
                lens[i] = -(inverse(i, 0) * right[0] + inverse(i, 1) * right[1]);
                lens_variance[i] = inverse(i, i);
            }
        }
        let mut poses = base;
        for (slot, pose) in poses.iter_mut().enumerate() {
            for (k, value) in pose.iter_mut().enumerate() {
                let bending = distorted.iter().zip(&lens).map(|(b, l)| b[slot][k] * l);
                *value = -*value - bending.sum::<f64>();
            }
        }
        let is_finite = poses.iter().flatten().chain(&lens).all(|v| v.is_finite());
        is_finite.then_some(Solution {
            poses,
            lens,
            lens_variance,
        })
    }

    /// Inverse of the pose part times one column of the border.
    fn border_column(&self, k: usize) -> Vec<[f64; 6]> {
        let column = |b: &[f64; 12]| std::array::from_fn(|r| b[LENS * r + k]);
        let mut x: Vec<[f64; 6]> = self.border.iter().map(column).collect();
        self.substitute(&mut x);
        x
    }

    fn across(&self, k: usize, x: &[[f64; 6]]) -> f64 {
        let one =
            |(b, x): (&[f64; 12], &[f64; 6])| (0..6).map(|r| b[LENS * r + k] * x[r]).sum::<f64>();
        self.border.iter().zip(x).map(one).sum::<f64>()
    }

    /// Rows become those of the Cholesky factor.
    fn factorise(&mut self) -> Option<()> {
        let n = self.rows.len();
        let mut turned: Vec<Block> = Vec::new();
        for j in 0..n {
            let (above, below) = self.rows.split_at_mut(j + 1);
            let row = &mut above[j];
            let n_left = row.len() - 1;
            turned.clear();
            turned.extend(row[..n_left].iter().map(transposed));
            let (left, own) = row.split_at_mut(n_left);
            subtract_products(&mut own[0], left, &turned);
            cholesky(&mut own[0])?;
            let (own, first, first_j) = (own[0], &self.first, self.first[j]);
            let reduce = |(offset, row): (usize, &mut Vec<Block>)| {
                let first_i = first[j + 1 + offset];
                if first_i > j {
                    return;
                }
                let start = first_i.max(first_j);
                let (left, rest) = row.split_at_mut(j - first_i);
                subtract_products(
                    &mut rest[0],
                    &left[start - first_i..],
                    &turned[start - first_j..],
                );
                divide(&mut rest[0], &own);
            };
            if below.len() * n_left > MIN_SHARED {
                below.par_iter_mut().enumerate().for_each(reduce);
            } else {
                below.iter_mut().enumerate().for_each(reduce);
            }
        }
        Some(())
    }

    /// `x` becomes the solution for the right side `x`; after `factorise`.
    fn substitute(&self, x: &mut [[f64; 6]]) {
        for i in 0..x.len() {
            let row = &self.rows[i];
            let mut sum = x[i];
            for (block, x) in row.iter().zip(&x[self.first[i]..i]) {
                for r in 0..6 {
                    sum[r] -= (0..6).map(|c| block[6 * r + c] * x[c]).sum::<f64>();
                }
            }
            let own = &row[row.len() - 1];
            for r in 0..6 {
                let done: f64 = (0..r).map(|c| own[6 * r + c] * sum[c]).sum();
                sum[r] = (sum[r] - done) / own[7 * r];
            }
            x[i] = sum;
        }
        for i in (0..x.len()).rev() {
            let row = &self.rows[i];
            let own = &row[row.len() - 1];
            let mut sum = x[i];
            for r in (0..6).rev() {
                let done: f64 = (r + 1..6).map(|c| own[6 * c + r] * sum[c]).sum();
                sum[r] = (sum[r] - done) / own[7 * r];
            }
            x[i] = sum;
            for (block, x) in row.iter().zip(&mut x[self.first[i]..i]) {
                for (r, value) in sum.iter().enumerate() {
                    (0..6).for_each(|c| x[c] -= block[6 * r + c] * value);
                }
            }
        }
    }
}

fn add<'a>(sum: impl Iterator<Item = &'a mut f64>, part: impl Iterator<Item = &'a f64>) {
    sum.zip(part).for_each(|(sum, part)| *sum += part);
}

fn transposed(block: &Block) -> Block {
    std::array::from_fn(|i| block[6 * (i % 6) + i / 6])
}

/// `to -= sum of left * turned`. Three rows at a time: their sums fit the registers.
fn subtract_products(to: &mut Block, left: &[Block], turned: &[Block]) {
    for (half, to) in to.as_chunks_mut::<18>().0.iter_mut().enumerate() {
        let mut sum = [0.0; 18];
        for (a, b) in left.iter().zip(turned) {
            for t in 0..6 {
                for r in 0..3 {
                    let value = a[18 * half + 6 * r + t];
                    (0..6).for_each(|c| sum[6 * r + c] += value * b[6 * t + c]);
                }
            }
        }
        to.iter_mut().zip(sum).for_each(|(to, sum)| *to -= sum);
    }
}

/// The lower triangle becomes its Cholesky factor; what lies above is not read.
fn cholesky(block: &mut Block) -> Option<()> {
    for r in 0..6 {
        for c in 0..=r {
            let done: f64 = (0..c).map(|t| block[6 * r + t] * block[6 * c + t]).sum();
            let rest = block[6 * r + c] - done;
            if r == c {
                // False for NaN, too.
                let is_positive = rest > 0.0 && rest.is_finite();
                block[7 * r] = is_positive.then(|| rest.sqrt())?;
            } else {
                block[6 * r + c] = rest / block[7 * c];
            }
        }
    }
    Some(())
}

/// `block` times the inverse of the transposed factor.
fn divide(block: &mut Block, factor: &Block) {
    for row in block.as_chunks_mut::<6>().0 {
        for c in 0..6 {
            let done: f64 = (0..c).map(|t| row[t] * factor[6 * c + t]).sum();
            row[c] = (row[c] - done) / factor[7 * c];
        }
    }
}

#[cfg(test)]
mod tests;
