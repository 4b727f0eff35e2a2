//! Depth next to a jump -> the side of the jump that the pixel itself is on.
//!
//! A matching window over the edge of a thing finds the thing also for pixels beside it, in all views alike, so that
//! cross-view verification does not notice. Here each pixel near a jump chooses between the depths around it by a
//! smaller window in the finer image, in which pixels of its own luma count most (Yoon and Kweon 2006); where no
//! depth matches, there is none.

use glam::{DVec2, Vec2};
use multiversion::multiversion;
use rayon::prelude::*;

use crate::mvs::luma::Grey;
use crate::mvs::luma_map::LumaFit;
use crate::mvs::view::Prepared;
use crate::mvs::warp::Warp;
use crate::mvs::zncc::{NOISE_VARIANCE, WINDOW, integer};

/// Relative difference of depth that is a jump.
pub(crate) const JUMP: f32 = 0.025;
/// Reach of the matching window: pixels further from a jump are none of its business.
const REACH: usize = WINDOW / 2;
const RADIUS: usize = 2;
/// From one pixel of the window to the next, in pixels of the depth map. Closer together they report narrower things
/// apart, and lose more where poses are off by a part of a pixel.
const STEP_PX: f64 = 0.6;
const SIDE: usize = 2 * RADIUS + 1;
/// A luma difference at which a neighbour counts 1/e.
const LIKE_LUMA: f32 = 10.0 / 255.0;
/// Every neighbour counts this much: a lone pixel has nothing to correlate.
const LEAST_LIKE: f32 = 0.02;
/// Of a score, what the differences of luma say; the rest is ZNCC, to which a bright rim alone can look right. A larger
/// share costs depth where the light differs from place to place.
const LUMA_SHARE: f32 = 0.7;
/// A mean difference of luma from which on the window says no.
const MOST_OFF: f32 = 0.03;
/// A depth that matches worse is none.
const MIN_SCORE: f32 = 0.25;

/// Replaces the depths near jumps; 0 where none of those around matches.
///
/// Twice: what was chosen for the neighbours gives more of what there is to choose from.
pub(crate) fn settle(reference: &Prepared, warps: &[Warp<'_>], depth: &mut [f32]) {
    let first = depth.to_vec();
    choose(reference, warps, &first, None, depth);
    let second = depth.to_vec();
    choose(reference, warps, &second, Some(&first), depth);
}

/// `earlier`: the depths that have been chosen from already. Where the choice is the same, so is what is chosen.
fn choose(
    reference: &Prepared,
    warps: &[Warp<'_>],
    before: &[f32],
    earlier: Option<&[f32]>,
    depth: &mut [f32],
) {
    let width = reference.grey.width;
    let rows = depth.par_chunks_mut(width).enumerate();
    rows.for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let own = before[y * width + x];
            if own > 0.0
                && let Some(others) = across_jump(before, [x, y], own, reference)
                && !earlier.is_some_and(|earlier| {
                    let own = earlier[y * width + x];
                    across_jump(earlier, [x, y], own, reference) == Some(others)
                })
            {
                *value = chosen(reference, warps, [x, y], own, others);
            }
        }
    });
}

/// The nearest and the farthest depth within reach, where a jump lies between; own depth where it lies on one side only.
pub(crate) fn across_jump(
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
    let score = |depth: f32| support.score(warps, at, f64::from(depth).recip());
    let is_other = |other: &f32| *other > own * (1.0 + JUMP) || own > other * (1.0 + JUMP);
    let others = [nearest, farthest].into_iter().filter(is_other);
    let mut best = (score(own), own);
    for other in others {
        let found = score(other);
        if found > best.0 {
            best = (found, other);
        }
    }
    if best.0 >= MIN_SCORE { best.1 } else { 0.0 }
}

/// Neighbours of a pixel, by how much they are like it.
struct Support {
    /// Its number in the depth map, and its luma there.
    pixel: usize,
    luma: f32,
    /// They add up to 1; 0 in lanes beyond the window.
    weights: Lanes,
    mean: f32,
    off_mean: Lanes,
    variance: f32,
}

impl Support {
    fn new(reference: &Prepared, [x, y]: [usize; 2]) -> Self {
        let (grey, fine) = (&reference.grey, &reference.fine);
        let scale = finer(grey, fine);
        let centre = in_finer(DVec2::new(x as f64, y as f64), scale);
        let right = Vec2::new((STEP_PX * scale.x) as f32, 0.0);
        let down = Vec2::new(0.0, (STEP_PX * scale.y) as f32);
        let corner = centre.as_vec2() - (right + down) * RADIUS as f32;
        let seen = sampled(fine, corner, right, down);
        let own = seen[SIDE * SIDE / 2];
        let like = |value: f32| (-(value - own).abs() / LIKE_LUMA).exp().max(LEAST_LIKE);
        let mut weights = [0.0; LANES];
        let window = weights.iter_mut().zip(seen).take(SIDE * SIDE);
        window.for_each(|(weight, value)| *weight = like(value));
        let total: f32 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= total);
        let mean: f32 = weights.iter().zip(&seen).map(|(w, v)| w * v).sum();
        let off_mean = seen.map(|value| value - mean);
        let spread = weights.iter().zip(&off_mean).map(|(w, off)| w * off * off);
        let pixel = y * grey.width + x;
        Self {
            pixel,
            luma: grey.values[pixel],
            weights,
            mean,
            off_mean,
            variance: spread.sum::<f32>() + NOISE_VARIANCE,
        }
    }

    /// Mean of the two sources that match best; -1 where none sees the point.
    fn score(&self, warps: &[Warp<'_>], at: [usize; 2], inverse_depth: f64) -> f32 {
        let (mut best, mut second) = (-1.0_f32, -1.0_f32);
        for warp in warps {
            let Some(found) = self.score_in(warp, at, inverse_depth) else {
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

    /// The window is small enough for the way to the source to count as affine in it.
    fn score_in(&self, warp: &Warp<'_>, [x, y]: [usize; 2], inverse_depth: f64) -> Option<f32> {
        let place =
            |dx: f64, dy: f64| warp.pixel_in_source(x as f64 + dx, y as f64 + dy, inverse_depth);
        let scale = finer(warp.source, warp.fine);
        let centre = place(0.0, 0.0)?;
        let reach = RADIUS as f64 * STEP_PX;
        let right = (place(reach, 0.0)? - centre) * scale;
        let down = (place(0.0, reach)? - centre) * scale;
        let centre = in_finer(centre, scale);
        let (width, height) = (warp.fine.width as f64, warp.fine.height as f64);
        let spread = right.abs() + down.abs();
        let (low, high) = (centre - spread, centre + spread);
        if low.x < 0.0 || low.y < 0.0 || high.x >= width - 1.0 || high.y >= height - 1.0 {
            return None;
        }
        let (right, down) = (
            right.as_vec2() / RADIUS as f32,
            down.as_vec2() / RADIUS as f32,
        );
        let corner = centre.as_vec2() - (right + down) * RADIUS as f32;
        let light = warp.light_at(self.pixel, self.luma);
        Some(self.score_of(&sampled(warp.fine, corner, right, down), light))
    }

    fn score_of(&self, seen: &Lanes, light: LumaFit) -> f32 {
        let offset = light.of_source(self.mean) - self.mean;
        let [mean, square, covariance, off] = weighted_sums(
            [&self.weights, &self.off_mean, seen],
            [self.mean, light.gain, offset],
        );
        let variance = (square - mean * mean).max(0.0) + NOISE_VARIANCE;
        let zncc = covariance / (self.variance * variance).sqrt();
        let like = 1.0 - (off / MOST_OFF).min(1.0);
        zncc + LUMA_SHARE * (like - zncc)
    }
}

/// Weighted sums of `d`, what is seen less the mean: d, d^2, d times the own difference from the mean, and how far d is
/// from where `gain` and `offset` take that difference. Added up by lanes.
#[multiversion(targets("x86_64+avx2"))]
fn weighted_sums([weights, own, seen]: [&Lanes; 3], [mean, gain, offset]: [f32; 3]) -> [f32; 4] {
    let [mut first, mut square, mut product, mut off] = [[0.0_f32; REGISTER]; 4];
    for block in 0..LANES / REGISTER {
        for lane in 0..REGISTER {
            let k = block * REGISTER + lane;
            let d = seen[k] - mean;
            let weighted = weights[k] * d;
            first[lane] += weighted;
            square[lane] += weighted * d;
            product[lane] += weighted * own[k];
            off[lane] += weights[k] * (gain * own[k] + offset - d).abs();
        }
    }
    [first, square, product, off].map(|lanes| lanes.iter().sum())
}

/// Pixels of the finer image to one of the depth map.
fn finer(grey: &Grey, fine: &Grey) -> DVec2 {
    DVec2::new(
        fine.width as f64 / grey.width as f64,
        fine.height as f64 / grey.height as f64,
    )
}

/// Centres at integers on both sides.
fn in_finer(pixel: DVec2, scale: DVec2) -> DVec2 {
    (pixel + 0.5) * scale - 0.5
}

/// A window, filled up to whole registers.
const LANES: usize = (SIDE * SIDE).next_multiple_of(16);
const REGISTER: usize = 8;
type Lanes = [f32; LANES];

/// Bilinear values of a window, row by row. Beyond the border the outermost pixels go on.
#[multiversion(targets("x86_64+avx2"))]
fn sampled(source: &Grey, corner: Vec2, right: Vec2, down: Vec2) -> Lanes {
    let (mut index, mut share_x, mut share_y) = ([0_u32; LANES], [0.0; LANES], [0.0; LANES]);
    let last = [source.width - 2, source.height - 2].map(|cell| cell as f32);
    let (mut columns, mut rows) = ([0.0_f32; LANES], [0.0_f32; LANES]);
    for k in 0..SIDE * SIDE {
        (columns[k], rows[k]) = ((k % SIDE) as f32, (k / SIDE) as f32);
    }
    for k in 0..LANES {
        let u = corner.x + right.x * columns[k] + down.x * rows[k];
        let v = corner.y + right.y * columns[k] + down.y * rows[k];
        let (left, top) = (
            u.max(0.0).min(last[0]).floor(),
            v.max(0.0).min(last[1]).floor(),
        );
        share_x[k] = (u - left).clamp(0.0, 1.0);
        share_y[k] = (v - top).clamp(0.0, 1.0);
        index[k] = integer(top) * source.width as u32 + integer(left);
    }
    let [mut a, mut b, mut c, mut d] = [[0.0_f32; LANES]; 4];
    for k in 0..SIDE * SIDE {
        let at = index[k] as usize;
        let upper = &source.values[at..at + 2];
        let lower = &source.values[at + source.width..at + source.width + 2];
        (a[k], b[k], c[k], d[k]) = (upper[0], upper[1], lower[0], lower[1]);
    }
    std::array::from_fn(|k| {
        let above = a[k] + (b[k] - a[k]) * share_x[k];
        let below = c[k] + (d[k] - c[k]) * share_x[k];
        above + (below - above) * share_y[k]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_the_border_the_outermost_pixels_go_on() {
        let columns = (0..64).map(|ix| (ix % 8) as f32);
        let grey = Grey {
            width: 8,
            height: 8,
            values: columns.collect(),
            colours: Vec::new(),
        };
        for (corner, row) in [
            (-2.0, [0.0, 0.0, 0.0, 1.0, 2.0]),
            (5.0, [5.0, 6.0, 7.0, 7.0, 7.0]),
        ] {
            let seen = sampled(&grey, Vec2::splat(corner), Vec2::X, Vec2::Y);
            for k in 0..SIDE * SIDE {
                assert_eq!(seen[k], row[k % SIDE], "{corner} {k}");
            }
        }
    }
}
