//! A visible splat as the pixel loops of one tile want it: what `raster` and `raster_backward` share.
//!
//! Both must come to the same alphas, to the bit.

use crate::cpu::bin::{CUT_SLACK, Tiles};
use crate::cpu::lanes::{LANES, exp2, madd};
use crate::cpu::project::{MIN_ALPHA, ProjectedSplat, TILE_PX};

/// A splat never hides all behind it: what it hides gets no gradient (Kerbl et al. 2023).
const MAX_ALPHA: f32 = 0.99;
/// Vectors in a row of a tile, and in a tile.
pub(crate) const ROW_VECTORS: usize = TILE_PX / LANES;
pub(crate) const TILE_VECTORS: usize = TILE_PX * ROW_VECTORS;
/// Splats of a tile that are fetched together; between batches, a look at whether all pixels have stopped.
pub(crate) const BATCH: usize = 16;

/// Part of the image that a tile covers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TileArea {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) n_columns: usize,
    pub(crate) n_rows: usize,
}

/// A splat as the loops of one tile want it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TileSplat {
    pub(crate) opacity: f32,
    /// From the centre of the tile's first pixel to the splat's centre.
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// `-log2 e` times the conic: exponent of two = half_a dx^2 + b dx dy + half_c dy^2.
    pub(crate) half_a: f32,
    pub(crate) b: f32,
    pub(crate) half_c: f32,
    pub(crate) color: [f32; 3],
    pub(crate) depth: f32,
    /// Bit v: the splat reaches a pixel of vector v.
    reach: u32,
}

/// Brings the next splats of a tile from all over memory into one place; the loads overlap.
#[inline(always)]
pub(crate) fn load_batch<'a>(
    visible: &[ProjectedSplat],
    instances: &[u32],
    area: TileArea,
    batch: &'a mut [TileSplat; BATCH],
) -> &'a [TileSplat] {
    for (slot, &ix) in batch.iter_mut().zip(instances) {
        *slot = TileSplat::new(&visible[ix as usize], area);
    }
    &batch[..instances.len()]
}

impl TileSplat {
    pub(crate) const NONE: Self = Self {
        opacity: 0.0,
        x: 0.0,
        y: 0.0,
        half_a: 0.0,
        b: 0.0,
        half_c: 0.0,
        color: [0.0; 3],
        depth: 0.0,
        reach: 0,
    };

    #[inline(always)]
    fn new(splat: &ProjectedSplat, area: TileArea) -> Self {
        const LOG2_E: f32 = std::f32::consts::LOG2_E;
        let [a, b, c] = splat.conic;
        let mut local = Self {
            opacity: splat.opacity,
            x: splat.center[0] - (area.x as f32 + 0.5),
            y: splat.center[1] - (area.y as f32 + 0.5),
            half_a: -0.5 * LOG2_E * a,
            b: -LOG2_E * b,
            half_c: -0.5 * LOG2_E * c,
            color: splat.color,
            depth: splat.depth,
            reach: 0,
        };
        local.reach = local.reach(-LOG2_E * (splat.cut + CUT_SLACK));
        local
    }

    /// Vectors of which some point lies where the exponent is at least `cut`: its maximum along a row is that of a parabola.
    #[inline(always)]
    fn reach(&self, cut: f32) -> u32 {
        let ridge = -0.5 * self.b / self.half_a;
        let mut bits = [0u32; TILE_VECTORS];
        for (v, bit) in bits.iter_mut().enumerate() {
            let (high, dy) = self.offset_to(v);
            let low = high - (LANES - 1) as f32;
            let dx = ridge * dy;
            let dx = if dx < low { low } else { dx };
            let dx = if dx > high { high } else { dx };
            let exponent = (self.half_a * dx + self.b * dy) * dx + self.half_c * dy * dy;
            *bit = if exponent < cut { 0 } else { 1 << v };
        }
        bits.iter().fold(0, |all, bit| all | bit)
    }

    /// From the centre of a vector's first pixel to the splat's centre.
    #[inline(always)]
    pub(crate) fn offset_to(&self, v: usize) -> (f32, f32) {
        let (row, half) = (v / ROW_VECTORS, v % ROW_VECTORS);
        (self.x - (half * LANES) as f32, self.y - row as f32)
    }

    /// Vectors of the tile that the splat reaches.
    #[inline(always)]
    pub(crate) fn vectors(&self) -> impl Iterator<Item = usize> {
        let mut left = self.reach;
        std::iter::from_fn(move || {
            let v = left.trailing_zeros();
            left &= left.wrapping_sub(1);
            (v < u32::BITS).then_some(v as usize)
        })
    }

    /// Alpha of a pixel, 0 where it is too faint to count, and whether it is below the upper clamp.
    /// `raster_backward` must come to the same bits.
    #[inline(always)]
    pub(crate) fn alpha<const FMA: bool>(&self, dx: f32, dy: f32) -> (f32, bool) {
        let along_x = madd::<FMA>(self.half_a, dx, self.b * dy);
        let exponent = madd::<FMA>(along_x, dx, self.half_c * dy * dy);
        let alpha = self.opacity * exp2::<FMA>(exponent);
        // Rounding may take the exponent of a needle above 0, where the Gaussian has no value; NaN is out too.
        let is_seen = (alpha >= MIN_ALPHA) & (exponent <= 0.0);
        let is_free = alpha <= MAX_ALPHA;
        let clamped = if is_free { alpha } else { MAX_ALPHA };
        (if is_seen { clamped } else { 0.0 }, is_free)
    }
}

impl Tiles {
    pub(crate) fn area(&self, tile: usize) -> TileArea {
        let (x, y) = (tile % self.n_x * TILE_PX, tile / self.n_x * TILE_PX);
        TileArea {
            x,
            y,
            n_columns: TILE_PX.min(self.width_px as usize - x),
            n_rows: TILE_PX.min(self.height_px as usize - y),
        }
    }
}
