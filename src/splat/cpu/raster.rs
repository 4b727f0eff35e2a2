//! raster: splats of each tile -> colour, summed depth and transmittance of its pixels.
//!
//! After `bin`. One task per tile; per splat, the half rows that its ellipse reaches. Equations: docs/GRADIENTS.md, compositing.

use multiversion::multiversion;
use rayon::prelude::*;

use super::bin::Tiles;
use super::lanes::{LANES, Lane, exp2, madd};
use super::project::{MIN_ALPHA, ProjectedSplat, TILE_PX};
use crate::splat::Rendering;

pub(crate) const MAX_ALPHA: f32 = 0.99;
/// A pixel stops before its transmittance falls to this.
pub(crate) const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Vectors in a row of a tile, and in a tile.
pub(crate) const ROW_VECTORS: usize = TILE_PX / LANES;
pub(crate) const TILE_VECTORS: usize = TILE_PX * ROW_VECTORS;
/// Splats between two looks at whether all pixels of the tile have stopped.
const STOP_CHECK_EVERY: usize = 16;
/// Zeros left and right of each row of a plane: SSIM's window reaches 5 pixels out.
pub const PLANE_MARGIN: usize = 8;

/// Pixels of one tile, vectors row by row.
#[derive(Debug, Clone)]
#[repr(align(64))]
pub struct TilePixels {
    /// Negative in the loops once the pixel has stopped; its size stays right.
    pub transmittance: [Lane; TILE_VECTORS],
    pub rgb: [[Lane; TILE_VECTORS]; 3],
    /// Sum of alpha T z.
    pub depth_sum: [Lane; TILE_VECTORS],
    /// Splats looked at before the whole tile had stopped.
    pub n_used: u32,
}

/// The picture: by tiles as the loops need it, by rows as the loss needs it.
#[derive(Debug, Default)]
pub struct Raster {
    pub width_px: usize,
    pub height_px: usize,
    pub tiles: Vec<TilePixels>,
    /// Length of a row of a plane: width and two margins.
    pub stride: usize,
    /// r, g, b, alpha, depth sum.
    pub planes: [Vec<f32>; 5],
}

/// Part of the picture that a tile covers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TileArea {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) n_columns: usize,
    pub(crate) n_rows: usize,
}

/// A splat as the loops of one tile want it.
#[derive(Debug, Clone)]
pub(crate) struct TileSplat {
    pub(crate) opacity: f32,
    /// From the centre of the tile's first pixel to the splat's centre.
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// `-log2 e` times the conic: exponent of two = half_a dx^2 + b dx dy + half_c dy^2.
    pub(crate) half_a: f32,
    pub(crate) b: f32,
    pub(crate) half_c: f32,
    pub(crate) rows: std::ops::Range<usize>,
    pub(crate) vectors: std::ops::Range<usize>,
}

/// Composites all tiles.
pub fn raster(visible: &[ProjectedSplat], tiles: &Tiles, out: &mut Raster) {
    out.width_px = tiles.width_px as usize;
    out.height_px = tiles.height_px as usize;
    out.tiles.resize(tiles.n_tiles(), TilePixels::EMPTY);
    out.tiles.par_iter_mut().enumerate().for_each(|(tile, pixels)| {
        raster_tile(visible, tiles.of(tile), tiles.area(tile), pixels);
    });
    unroll(tiles.n_x, out);
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn raster_tile(visible: &[ProjectedSplat], instances: &[u32], area: TileArea, out: &mut TilePixels) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => composite::<true>(visible, instances, area, out),
        "aarch64+neon" => composite::<true>(visible, instances, area, out),
        _ => composite::<false>(visible, instances, area, out),
    }
}

#[inline(always)]
fn composite<const FMA: bool>(visible: &[ProjectedSplat], instances: &[u32], area: TileArea, out: &mut TilePixels) {
    out.clear(area);
    out.n_used = instances.len() as u32;
    for (k, &ix) in instances.iter().enumerate() {
        if k % STOP_CHECK_EVERY == 0 && all_stopped(&out.transmittance) {
            out.n_used = k as u32;
            break;
        }
        let splat = &visible[ix as usize];
        let local = TileSplat::new(splat, area);
        let dx = local.dx();
        for row in local.rows.clone() {
            let dy = local.y - row as f32;
            for half in local.vectors.clone() {
                let v = row * ROW_VECTORS + half;
                let mut w = [0.0; LANES];
                let mut t = out.transmittance[v];
                for i in 0..LANES {
                    let alpha = local.alpha::<FMA>(dx[half][i], dy).0;
                    let next = t[i] * (1.0 - alpha);
                    let is_seen = alpha >= MIN_ALPHA;
                    let is_over = next <= MIN_TRANSMITTANCE;
                    w[i] = if is_seen && !is_over { alpha * t[i] } else { 0.0 };
                    let stopped = if is_over { -t[i].abs() } else { next };
                    t[i] = if is_seen { stopped } else { t[i] };
                }
                out.transmittance[v] = t;
                for i in 0..LANES {
                    out.rgb[0][v][i] = madd::<FMA>(w[i], splat.color[0], out.rgb[0][v][i]);
                    out.rgb[1][v][i] = madd::<FMA>(w[i], splat.color[1], out.rgb[1][v][i]);
                    out.rgb[2][v][i] = madd::<FMA>(w[i], splat.color[2], out.rgb[2][v][i]);
                    out.depth_sum[v][i] = madd::<FMA>(w[i], splat.depth, out.depth_sum[v][i]);
                }
            }
        }
    }
    for t in out.transmittance.as_flattened_mut() {
        *t = t.abs();
    }
}

/// Pixels off the picture count as stopped from the start.
#[inline(always)]
pub(crate) fn start_transmittance(area: TileArea) -> [Lane; TILE_VECTORS] {
    let mut t = [[-1.0; LANES]; TILE_VECTORS];
    for row in t.as_flattened_mut().chunks_exact_mut(TILE_PX).take(area.n_rows) {
        row[..area.n_columns].fill(1.0);
    }
    t
}

#[inline(always)]
pub(crate) fn all_stopped(transmittance: &[Lane; TILE_VECTORS]) -> bool {
    let mut live = [0u32; LANES];
    for t in transmittance {
        for i in 0..LANES {
            // The sign bit of a stopped pixel is set.
            live[i] |= !t[i].to_bits();
        }
    }
    live.iter().all(|bits| bits >> 31 == 0)
}

/// Tiles to planes of rows.
fn unroll(n_x: usize, out: &mut Raster) {
    let (width, tiles) = (out.width_px, &out.tiles);
    let stride = width + 2 * PLANE_MARGIN;
    // The margins must be zero, and another width moves them.
    let is_moved = out.stride != stride;
    out.stride = stride;
    for (p, plane) in out.planes.iter_mut().enumerate() {
        if is_moved {
            plane.clear();
        }
        plane.resize(stride * out.height_px, 0.0);
        plane.par_chunks_mut(stride).with_min_len(TILE_PX).enumerate().for_each(|(y, row)| {
            let tile_row = &tiles[y / TILE_PX * n_x..][..n_x];
            let row = &mut row[PLANE_MARGIN..][..width];
            for (pixels, out) in tile_row.iter().zip(row.chunks_mut(TILE_PX)) {
                let first = y % TILE_PX * TILE_PX;
                let from = &pixels.plane(p)[first..][..out.len()];
                out.copy_from_slice(from);
                if p == 3 {
                    out.iter_mut().for_each(|t| *t = 1.0 - *t);
                }
            }
        });
    }
}

impl TilePixels {
    pub(crate) const EMPTY: Self = Self {
        transmittance: [[1.0; LANES]; TILE_VECTORS],
        rgb: [[[0.0; LANES]; TILE_VECTORS]; 3],
        depth_sum: [[0.0; LANES]; TILE_VECTORS],
        n_used: 0,
    };

    #[inline(always)]
    fn clear(&mut self, area: TileArea) {
        self.transmittance = start_transmittance(area);
        self.rgb = [[[0.0; LANES]; TILE_VECTORS]; 3];
        self.depth_sum = [[0.0; LANES]; TILE_VECTORS];
    }

    fn plane(&self, plane: usize) -> &[f32] {
        match plane {
            0..=2 => self.rgb[plane].as_flattened(),
            3 => self.transmittance.as_flattened(),
            _ => self.depth_sum.as_flattened(),
        }
    }
}

impl TileSplat {
    #[inline(always)]
    pub(crate) fn new(splat: &ProjectedSplat, area: TileArea) -> Self {
        const LOG2_E: f32 = std::f32::consts::LOG2_E;
        let x = splat.center[0] - (area.x as f32 + 0.5);
        let y = splat.center[1] - (area.y as f32 + 0.5);
        let [a, b, c] = splat.conic;
        let [half_x, half_y] = splat.half_px;
        // Pixel k of a row is reached when |k - x| <= half_x; `as` cuts off and takes negative to 0.
        let first_row = ((y - half_y + 0.99) as usize).min(area.n_rows);
        let end_row = ((y + half_y + 1.0) as usize).clamp(first_row, area.n_rows);
        let first_column = (x - half_x + 0.99) as usize;
        let end_column = ((x + half_x + 1.0) as usize).min(area.n_columns);
        let first_vector = (first_column / LANES).min(ROW_VECTORS);
        Self {
            opacity: splat.opacity,
            x,
            y,
            half_a: -0.5 * LOG2_E * a,
            b: -LOG2_E * b,
            half_c: -0.5 * LOG2_E * c,
            rows: first_row..end_row,
            vectors: first_vector..end_column.div_ceil(LANES).max(first_vector),
        }
    }

    /// `dx` of each pixel of a row, the same in all rows.
    #[inline(always)]
    pub(crate) fn dx(&self) -> [Lane; ROW_VECTORS] {
        let mut dx = [[0.0; LANES]; ROW_VECTORS];
        for (k, dx) in dx.as_flattened_mut().iter_mut().enumerate() {
            *dx = self.x - k as f32;
        }
        dx
    }

    /// Alpha of a pixel, and whether it is below the clamp. `raster_backward` must come to the same bits.
    #[inline(always)]
    pub(crate) fn alpha<const FMA: bool>(&self, dx: f32, dy: f32) -> (f32, bool) {
        let along_x = madd::<FMA>(self.half_a, dx, self.b * dy);
        let exponent = madd::<FMA>(along_x, dx, self.half_c * dy * dy);
        let alpha = self.opacity * exp2::<FMA>(exponent);
        let is_free = alpha <= MAX_ALPHA;
        let alpha = if is_free { alpha } else { MAX_ALPHA };
        // Rounding may take the exponent of a needle above 0, where the Gaussian has no value; NaN goes here too.
        let alpha = if exponent <= 0.0 { alpha } else { 0.0 };
        (alpha, is_free)
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

impl Raster {
    /// A pixel row of a plane without its margins.
    pub fn row(&self, plane: usize, y: usize) -> &[f32] {
        &self.planes[plane][y * self.stride + PLANE_MARGIN..][..self.width_px]
    }

    pub fn rendering(&self) -> Rendering {
        let n_pixels = self.width_px * self.height_px;
        let mut rendering = Rendering {
            width_px: self.width_px as u32,
            height_px: self.height_px as u32,
            rgb: Vec::with_capacity(3 * n_pixels),
            alpha: Vec::with_capacity(n_pixels),
            depth: Vec::with_capacity(n_pixels),
        };
        for y in 0..self.height_px {
            let [r, g, b, alpha, depth_sum] = std::array::from_fn(|p| self.row(p, y));
            rendering.rgb.extend(r.iter().zip(g).zip(b).flat_map(|((&r, &g), &b)| [r, g, b]));
            rendering.alpha.extend_from_slice(alpha);
            rendering.depth.extend(depth_sum.iter().zip(alpha).map(|(&d, &a)| if a > 0.0 { d / a } else { 0.0 }));
        }
        rendering
    }
}
