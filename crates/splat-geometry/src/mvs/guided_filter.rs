//! Depth beside a jump -> the depth of most pixels around that have the same colour.
//!
//! Beside the edge of a thing, an even wall has nothing of its own to match: only that it looks like the wall further
//! off says where it is. A weighted median over like-coloured neighbours (Ma et al., ICCV 2013), taken in logarithmic
//! bins; the mean of the median's bin stands for it.

use rayon::prelude::*;

use crate::mvs::depth_edges::{JUMP, across_jump};
use crate::mvs::view::Prepared;

/// Neighbours reach further than the matching window spreads an edge, so that most of them are free of it.
const REACH: usize = 8;
const STRIDE: usize = 2;
const SIDE: usize = 2 * REACH / STRIDE + 1;
/// A difference of colour, summed over the channels, at which a neighbour counts 1/e.
const LIKE_COLOUR: f32 = 30.0;
const LIKE_PLACE_PX: f32 = 5.0;
/// Relative difference of depth beyond which the near side is a rim.
const RIM: f32 = 0.04;
const MAX_DIFFERENCE: usize = 3 * 255;

/// Bits of a positive f32 below those that number its bin: 32 bins an octave, 2 to 3 % wide.
const BIN_SHIFT: u32 = 18;
/// Eight octaves; depths beyond share the outermost bins.
const N_BINS: usize = 256;

/// Replaces depths near jumps where most of what looks alike is elsewhere.
pub(crate) fn settle(reference: &Prepared, depth: &mut [f32]) {
    let before = depth.to_vec();
    let Some(vote) = Vote::new(reference, &before) else {
        return;
    };
    let width = reference.grey.width;
    let rows = depth.par_chunks_mut(width).enumerate();
    rows.for_each_init(
        || [(0.0, 0.0); N_BINS],
        |bins, (y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                let own = before[y * width + x];
                if own > 0.0 && across_jump(&before, [x, y], own, reference).is_some() {
                    *value = vote.depth(bins, [x, y], own);
                }
            }
        },
    );
}

/// Whether a pixel lies on the near side of a jump, right beside it: what matching windows make too wide.
pub(crate) fn is_near_rim(
    depth: &[f32],
    (width, height): (usize, usize),
    x: usize,
    y: usize,
) -> bool {
    let farthest = depth[y * width + x] * (1.0 + RIM);
    (y.saturating_sub(1)..(y + 2).min(height)).any(|row| {
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        depth[row * width..][columns].iter().any(|d| *d > farthest)
    })
}

struct Vote<'a> {
    reference: &'a Prepared,
    depth: &'a [f32],
    /// Number of the first bin.
    base: u32,
    by_difference: Vec<f32>,
    by_place: [f32; SIDE * SIDE],
}

/// Weight of a bin, and weight times depth.
type Bin = (f32, f32);

impl<'a> Vote<'a> {
    /// `None` without any depth.
    fn new(reference: &'a Prepared, depth: &'a [f32]) -> Option<Self> {
        let found = depth.iter().copied().filter(|d| *d > 0.0);
        let nearest = found.min_by(f32::total_cmp)?;
        let by_difference = (0..=MAX_DIFFERENCE).map(|d| (-(d as f32) / LIKE_COLOUR).exp());
        let by_place = std::array::from_fn(|k| {
            let off = |ix: usize| (ix * STRIDE) as f32 - REACH as f32;
            (-off(k % SIDE).hypot(off(k / SIDE)) / LIKE_PLACE_PX).exp()
        });
        Some(Self {
            reference,
            depth,
            base: nearest.to_bits() >> BIN_SHIFT,
            by_difference: by_difference.collect(),
            by_place,
        })
    }

    fn bin(&self, depth: f32) -> usize {
        let bin = (depth.to_bits() >> BIN_SHIFT).saturating_sub(self.base);
        (bin as usize).min(N_BINS - 1)
    }

    /// `own` where the median is of the same surface.
    fn depth(&self, bins: &mut [Bin; N_BINS], at: [usize; 2], own: f32) -> f32 {
        let total = self.fill(bins, at);
        let mut below = 0.0;
        for (weight, weighted) in bins.iter() {
            below += weight;
            if below >= 0.5 * total && *weight > 0.0 {
                let median = weighted / weight;
                let is_other = median > own * (1.0 + JUMP) || own > median * (1.0 + JUMP);
                return if is_other { median } else { own };
            }
        }
        own
    }

    fn fill(&self, bins: &mut [Bin; N_BINS], [x, y]: [usize; 2]) -> f32 {
        bins.fill((0.0, 0.0));
        let grey = &self.reference.grey;
        let (width, height) = (grey.width, grey.height);
        let centre = grey.colours[y * width + x];
        let mut total = 0.0;
        for (k, by_place) in self.by_place.iter().enumerate() {
            // One that wraps around lies beyond the image like any other.
            let column = (x + k % SIDE * STRIDE).wrapping_sub(REACH);
            let row = (y + k / SIDE * STRIDE).wrapping_sub(REACH);
            if column >= width || row >= height {
                continue;
            }
            let at = row * width + column;
            let depth = self.depth[at];
            if depth > 0.0 {
                let colour = grey.colours[at];
                let difference: usize = (0..3)
                    .map(|c| usize::from(colour[c].abs_diff(centre[c])))
                    .sum();
                let weight = self.by_difference[difference] * by_place;
                let bin = &mut bins[self.bin(depth)];
                bin.0 += weight;
                bin.1 += weight * depth;
                total += weight;
            }
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mvs::luma::Grey;
    use splat_types::camera::Intrinsics;
    use splat_types::transform::Rigid;

    const SIDE_PX: usize = 48;
    const POST: std::ops::Range<usize> = 22..26;

    /// A post before an even wall; `fat` pixels on both sides of it have the depth of the post.
    fn post(fat: usize, wall: [u8; 3]) -> (Prepared, Vec<f32>) {
        let columns = || (0..SIDE_PX * SIDE_PX).map(|ix| ix % SIDE_PX);
        let colours = columns().map(|x| if POST.contains(&x) { [90; 3] } else { wall });
        let wide = POST.start - fat..POST.end + fat;
        let depth = columns().map(|x| if wide.contains(&x) { 2.0 } else { 5.0 });
        let grey = Grey {
            width: SIDE_PX,
            height: SIDE_PX,
            values: vec![0.0; SIDE_PX * SIDE_PX],
            colours: colours.collect(),
        };
        let prepared = Prepared {
            fine: Arc::new(grey.clone()),
            grey: Arc::new(grey),
            intrinsics: Intrinsics {
                width_px: SIDE_PX as u32,
                height_px: SIDE_PX as u32,
                fx: 40.0,
                fy: 40.0,
                cx: 24.0,
                cy: 24.0,
            },
            submap_from_cam: Rigid::IDENTITY,
        };
        (prepared, depth.collect())
    }

    fn settled(fat: usize, wall: [u8; 3]) -> Vec<f32> {
        let (prepared, mut depth) = post(fat, wall);
        settle(&prepared, &mut depth);
        depth
    }

    #[test]
    fn an_even_wall_beside_a_post_gets_its_own_depth_back() {
        // As wide as the small window that chose before can leave it.
        let exact = post(0, [200, 180, 160]).1;
        for (found, exact) in settled(2, [200, 180, 160]).iter().zip(exact) {
            assert!((found - exact).abs() < 1e-4, "{found} {exact}");
        }
    }

    #[test]
    fn what_is_right_stays() {
        assert_eq!(settled(0, [200, 180, 160]), post(0, [0; 3]).1);
    }

    #[test]
    fn colours_that_do_not_differ_leave_a_wide_thing_wide() {
        let found = settled(9, [90; 3]);
        assert_eq!(found[SIDE_PX * 24 + 24], 2.0);
    }

    #[test]
    fn only_the_near_side_of_a_jump_is_its_rim() {
        let (_, depth) = post(0, [0; 3]);
        let rims: Vec<usize> = (0..SIDE_PX)
            .filter(|x| is_near_rim(&depth, (SIDE_PX, SIDE_PX), *x, 20))
            .collect();
        assert_eq!(rims, [POST.start, POST.end - 1]);
    }

    #[test]
    fn a_image_without_depth_stays_without() {
        let (prepared, _) = post(0, [0; 3]);
        let mut depth = vec![0.0; SIDE_PX * SIDE_PX];
        settle(&prepared, &mut depth);
        assert!(depth.iter().all(|d| *d == 0.0));
    }
}
