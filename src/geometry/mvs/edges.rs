//! Depth next to a jump -> the side of the jump that the pixel itself is on.
//!
//! A matching window over the edge of a thing finds the thing also for pixels beside it, in all views alike, so that
//! cross-view verification does not notice. Here each pixel near a jump chooses between the depths around it by a
//! smaller window in which pixels of its own luma count most (Yoon and Kweon 2006); where no depth matches, there is
//! none.

use rayon::prelude::*;

use super::Prepared;
use super::sweep::Warp;
use super::zncc::{NOISE_VARIANCE, WINDOW};

/// Relative difference of depth that is a jump.
const JUMP: f32 = 0.04;
/// Reach of the matching window: pixels further from a jump are none of its business.
const REACH: usize = WINDOW / 2;
const RADIUS: usize = 2;
const SIDE: usize = 2 * RADIUS + 1;
/// A luma difference at which a neighbour counts 1/e.
const LIKE_LUMA: f32 = 10.0 / 255.0;
/// Every neighbour counts this much: a lone pixel has nothing to correlate.
const LEAST_LIKE: f32 = 0.02;
/// A depth that matches worse is none.
const MIN_ZNCC: f32 = 0.25;

/// Replaces the depths near jumps; 0 where none of those around matches.
pub(super) fn settle(reference: &Prepared, warps: &[Warp<'_>], depth: &mut [f32]) {
    let before = depth.to_vec();
    let width = reference.grey.width;
    let rows = depth.par_chunks_mut(width).enumerate();
    rows.for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let own = before[y * width + x];
            if own > 0.0
                && let Some(others) = across_jump(&before, [x, y], own, reference)
            {
                *value = chosen(reference, warps, [x, y], own, others);
            }
        }
    });
}

/// The nearest and the farthest depth within reach, where a jump lies between; own depth where it lies on one side only.
fn across_jump(
    depth: &[f32],
    [x, y]: [usize; 2],
    own: f32,
    reference: &Prepared,
) -> Option<[f32; 2]> {
    let (width, height) = (reference.grey.width, reference.grey.height);
    let (mut nearest, mut farthest) = (own, own);
    for row in y.saturating_sub(REACH)..(y + REACH + 1).min(height) {
        let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
        for &other in &depth[row * width..][columns] {
            if other > 0.0 {
                nearest = nearest.min(other);
                farthest = farthest.max(other);
            }
        }
    }
    let has_jump = farthest > own * (1.0 + JUMP) || own > nearest * (1.0 + JUMP);
    has_jump.then_some([nearest, farthest])
}

fn chosen(
    reference: &Prepared,
    warps: &[Warp<'_>],
    at: [usize; 2],
    own: f32,
    [nearest, farthest]: [f32; 2],
) -> f32 {
    let support = Support::new(reference, at);
    let score = |depth: f32| support.zncc(warps, at, f64::from(depth).recip());
    let is_other = |other: &f32| *other > own * (1.0 + JUMP) || own > other * (1.0 + JUMP);
    let others = [nearest, farthest].into_iter().filter(is_other);
    let mut best = (score(own), own);
    for other in others {
        let zncc = score(other);
        if zncc > best.0 {
            best = (zncc, other);
        }
    }
    if best.0 >= MIN_ZNCC { best.1 } else { 0.0 }
}

/// Neighbours of a pixel, by how much they are like it.
struct Support {
    weights: [f32; SIDE * SIDE],
    values: [f32; SIDE * SIDE],
    mean: f32,
    variance: f32,
}

impl Support {
    fn new(reference: &Prepared, [x, y]: [usize; 2]) -> Self {
        let grey = &reference.grey;
        let centre = grey.row(y)[x];
        let (mut weights, mut values) = ([0.0; SIDE * SIDE], [0.0; SIDE * SIDE]);
        for (k, (weight, value)) in weights.iter_mut().zip(&mut values).enumerate() {
            let column = (x + k % SIDE).checked_sub(RADIUS);
            let row = (y + k / SIDE).checked_sub(RADIUS);
            if let (Some(column), Some(row)) = (column, row)
                && column < grey.width
                && row < grey.height
            {
                *value = grey.row(row)[column];
                *weight = (-(*value - centre).abs() / LIKE_LUMA).exp().max(LEAST_LIKE);
            }
        }
        let total: f32 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= total);
        let mean: f32 = weights.iter().zip(&values).map(|(w, v)| w * v).sum();
        let variance: f32 = weights
            .iter()
            .zip(&values)
            .map(|(w, v)| w * (v - mean).powi(2))
            .sum();
        Self {
            weights,
            values,
            mean,
            variance: variance + NOISE_VARIANCE,
        }
    }

    /// Mean of the two sources that match best; -1 where none sees the point.
    fn zncc(&self, warps: &[Warp<'_>], at: [usize; 2], inverse_depth: f64) -> f32 {
        let (mut best, mut second) = (-1.0_f32, -1.0_f32);
        for warp in warps {
            let Some(found) = self.zncc_in(warp, at, inverse_depth) else {
                continue;
            };
            second = second.max(found.min(best));
            best = best.max(found);
        }
        if second > -1.0 {
            0.5 * (best + second)
        } else {
            best
        }
    }

    fn zncc_in(&self, warp: &Warp<'_>, [x, y]: [usize; 2], inverse_depth: f64) -> Option<f32> {
        let corner = warp
            .homogeneous(
                x as f64 - RADIUS as f64,
                y as f64 - RADIUS as f64,
                inverse_depth,
            )
            .as_vec3();
        let [right, down] = [0, 1].map(|k| glam::DVec3::from_array(warp.pixel_map[k]).as_vec3());
        let mut seen = [0.0_f32; SIDE * SIDE];
        for (k, value) in seen.iter_mut().enumerate() {
            let at = corner + right * (k % SIDE) as f32 + down * (k / SIDE) as f32;
            *value = warp.source.sample(at)?;
        }
        let mean: f32 = self.weights.iter().zip(&seen).map(|(w, v)| w * v).sum();
        let (mut variance, mut covariance) = (NOISE_VARIANCE, 0.0);
        for ((weight, own), other) in self.weights.iter().zip(&self.values).zip(&seen) {
            variance += weight * (other - mean).powi(2);
            covariance += weight * (own - self.mean) * (other - mean);
        }
        Some(covariance / (self.variance * variance).sqrt())
    }
}
