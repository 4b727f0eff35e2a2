//! raster: splats of each tile -> colour, summed depth and transmittance of its pixels.
//!
//! After `bin`. One task per tile; per splat, the half rows that its ellipse reaches. Equations: docs/GRADIENTS.md, compositing.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::cpu::bin::Tiles;
use crate::cpu::lanes::{LANES, Lane, madd};
use crate::cpu::project::{ProjectedSplat, TILE_PX};
use crate::cpu::tile_splat::{BATCH, TILE_VECTORS, TileArea, TileSplat, load_batch};
use splat_types::rendering::Rendering;

/// A pixel stops before its transmittance falls to this.
pub(crate) const MIN_TRANSMITTANCE: f32 = 1e-4;
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

/// The image: by tiles as the loops need it, by rows as the loss needs it.
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

/// Composites all tiles.
pub fn raster(visible: &[ProjectedSplat], tiles: &Tiles, out: &mut Raster) {
    out.width_px = tiles.width_px as usize;
    out.height_px = tiles.height_px as usize;
    out.tiles.resize(tiles.n_tiles(), TilePixels::EMPTY);
    out.tiles
        .par_iter_mut()
        .enumerate()
        .for_each(|(tile, pixels)| {
            raster_tile(visible, tiles.of(tile), tiles.area(tile), pixels);
        });
    unroll(tiles.n_x, out);
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn raster_tile(
    visible: &[ProjectedSplat],
    instances: &[u32],
    area: TileArea,
    out: &mut TilePixels,
) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => composite::<true>(visible, instances, area, out),
        "aarch64+neon" => composite::<true>(visible, instances, area, out),
        _ => composite::<false>(visible, instances, area, out),
    }
}

#[inline(always)]
fn composite<const FMA: bool>(
    visible: &[ProjectedSplat],
    instances: &[u32],
    area: TileArea,
    out: &mut TilePixels,
) {
    out.clear(area);
    out.n_used = 0;
    let mut batch = [TileSplat::NONE; BATCH];
    for instances in instances.chunks(BATCH) {
        if all_stopped(&out.transmittance) {
            break;
        }
        out.n_used += instances.len() as u32;
        for splat in load_batch(visible, instances, area, &mut batch) {
            for v in splat.vectors() {
                blend::<FMA>(splat, v, out);
            }
        }
    }
    for t in out.transmittance.as_flattened_mut() {
        *t = t.abs();
    }
}

/// One vector of pixels. Everything goes through locals: LLVM makes masked stores of selects into memory, which
/// stall the loads behind them.
#[inline(always)]
fn blend<const FMA: bool>(splat: &TileSplat, v: usize, out: &mut TilePixels) {
    let (x, dy) = splat.offset_to(v);
    let [red, green, blue] = splat.color;
    let mut t = out.transmittance[v];
    let [mut r, mut g, mut b] = out.rgb.each_ref().map(|channel| channel[v]);
    let mut z = out.depth_sum[v];
    for i in 0..LANES {
        let (alpha, _) = splat.alpha::<FMA>(x - i as f32, dy);
        let next = t[i] * (1.0 - alpha);
        let is_over = next <= MIN_TRANSMITTANCE;
        let weight = if is_over { 0.0 } else { alpha * t[i] };
        r[i] = madd::<FMA>(weight, red, r[i]);
        g[i] = madd::<FMA>(weight, green, g[i]);
        b[i] = madd::<FMA>(weight, blue, b[i]);
        z[i] = madd::<FMA>(weight, splat.depth, z[i]);
        t[i] = if is_over { -t[i].abs() } else { next };
    }
    out.transmittance[v] = t;
    for (channel, value) in out.rgb.iter_mut().zip([r, g, b]) {
        channel[v] = value;
    }
    out.depth_sum[v] = z;
}

/// Pixels off the image count as stopped from the start.
#[inline(always)]
pub(crate) fn start_transmittance(area: TileArea) -> [Lane; TILE_VECTORS] {
    let mut t = [[-1.0; LANES]; TILE_VECTORS];
    for row in t
        .as_flattened_mut()
        .chunks_exact_mut(TILE_PX)
        .take(area.n_rows)
    {
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
        plane
            .par_chunks_mut(stride)
            .with_min_len(TILE_PX)
            .enumerate()
            .for_each(|(y, row)| {
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
            rendering
                .rgb
                .extend(r.iter().zip(g).zip(b).flat_map(|((&r, &g), &b)| [r, g, b]));
            rendering.alpha.extend_from_slice(alpha);
            rendering.depth.extend(
                depth_sum
                    .iter()
                    .zip(alpha)
                    .map(|(&d, &a)| if a > 0.0 { d / a } else { 0.0 }),
            );
        }
        rendering
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processors_without_fma_see_the_same_image() {
        let splat = |k: usize| ProjectedSplat {
            splat_ix: k as u32,
            depth: 1.0 + k as f32,
            center: [(7 * k % 19) as f32, (5 * k % 17) as f32],
            conic: [0.2, 0.01 * (k % 9) as f32, 0.1],
            opacity: 0.1 + 0.02 * (k % 40) as f32,
            color: [0.3, 0.6, 0.9],
            cut: 5.0,
            tiles: [0, 0, 1, 1],
        };
        let visible: Vec<_> = (0..60).map(splat).collect();
        let instances: Vec<_> = (0..60).collect();
        let area = TileArea {
            x: 0,
            y: 0,
            n_columns: 14,
            n_rows: 16,
        };
        let (mut fused, mut plain) = (TilePixels::EMPTY, TilePixels::EMPTY);
        composite::<true>(&visible, &instances, area, &mut fused);
        composite::<false>(&visible, &instances, area, &mut plain);
        for plane in 0..5 {
            for (a, b) in fused.plane(plane).iter().zip(plain.plane(plane)) {
                assert!((a - b).abs() < 1e-4, "plane {plane}: {a} and {b}");
            }
        }
    }
}
