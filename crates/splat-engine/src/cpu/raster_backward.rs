//! raster_backward: gradients of the pixels -> gradient of each instance's 2D Gaussian.
//!
//! After `loss`. Walks the tile front to back as `raster` did, so that nothing of the way there has to be kept.
//! Each instance has its own slot: no atomics, and sums in a fixed order. Equations: docs/GRADIENTS.md, compositing.

use multiversion::multiversion;

use crate::cpu::bin::Tiles;
use crate::cpu::lanes::{LANES, Lane, madd};
use crate::cpu::loss_buffers::PixelGradients;
use crate::cpu::project::{ProjectedSplat, TILE_PX};
use crate::cpu::raster::{
    MIN_TRANSMITTANCE, PLANE_MARGIN, Raster, TilePixels, start_transmittance,
};
use crate::cpu::tile_splat::{BATCH, ROW_VECTORS, TILE_VECTORS, TileArea, TileSplat, load_batch};

/// d loss / d one instance.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct InstanceGradient {
    pub center: [f32; 2],
    /// To a, b, c of the conic, b counted once.
    pub conic: [f32; 3],
    pub opacity: f32,
    pub color: [f32; 3],
    pub depth: f32,
}

/// Slots of the instances that `raster` looked at; those behind a full tile have none.
#[derive(Debug, Default)]
pub struct InstanceGradients {
    /// Tile t owns `slots[starts[t]..starts[t + 1]]`, as many as it used.
    pub starts: Vec<u32>,
    pub slots: Vec<InstanceGradient>,
}

/// The pixels of a tile, and what the loss wants of them.
struct TileGradients {
    /// Per channel r, g, b and the depth sum.
    v: [[Lane; TILE_VECTORS]; 4],
    /// What lies behind, seen through the gradient: sum over the splats to come of alpha T (v . colour), less the
    /// transmittance's part.
    behind: [Lane; TILE_VECTORS],
    transmittance: [Lane; TILE_VECTORS],
}

/// Sums over the pixels of one instance, by column: along a column dx is constant and needs no sum of its own.
#[derive(Default)]
struct ColumnSums {
    /// v_sigma times 1, dy, dy^2.
    moments: [[Lane; ROW_VECTORS]; 3],
    /// Weight times the pixel's gradient, r g b and depth.
    channels: [[Lane; ROW_VECTORS]; 4],
}

/// Fills one slot per instance.
pub fn raster_backward(
    visible: &[ProjectedSplat],
    tiles: &Tiles,
    raster: &Raster,
    pixels: &PixelGradients,
    out: &mut InstanceGradients,
) {
    out.starts.clear();
    out.starts.push(0);
    let mut n_slots = 0;
    for tile in &raster.tiles {
        n_slots += tile.n_used;
        out.starts.push(n_slots);
    }
    out.slots
        .resize(n_slots as usize, InstanceGradient::default());
    let job = Job {
        visible,
        tiles,
        raster,
        pixels,
        starts: &out.starts,
    };
    job.run(0, raster.tiles.len(), &mut out.slots);
}

#[derive(Clone, Copy)]
struct Job<'a> {
    visible: &'a [ProjectedSplat],
    tiles: &'a Tiles,
    raster: &'a Raster,
    pixels: &'a PixelGradients,
    starts: &'a [u32],
}

impl Job<'_> {
    /// Halves the tiles until one is left; each half takes its own part of the slots.
    fn run(self, first: usize, end: usize, slots: &mut [InstanceGradient]) {
        if end - first > 1 {
            let middle = usize::midpoint(first, end);
            let (left, right) =
                slots.split_at_mut((self.starts[middle] - self.starts[first]) as usize);
            rayon::join(
                || self.run(first, middle, left),
                || self.run(middle, end, right),
            );
        } else if first < end && !slots.is_empty() {
            let area = self.tiles.area(first);
            let mut gradients =
                TileGradients::load(self.raster, self.pixels, &self.raster.tiles[first], area);
            raster_backward_tile(
                self.visible,
                self.tiles.of(first),
                area,
                &mut gradients,
                slots,
            );
        }
    }
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn raster_backward_tile(
    visible: &[ProjectedSplat],
    instances: &[u32],
    area: TileArea,
    pixels: &mut TileGradients,
    out: &mut [InstanceGradient],
) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => walk::<true>(visible, instances, area, pixels, out),
        "aarch64+neon" => walk::<true>(visible, instances, area, pixels, out),
        _ => walk::<false>(visible, instances, area, pixels, out),
    }
}

#[inline(always)]
fn walk<const FMA: bool>(
    visible: &[ProjectedSplat],
    instances: &[u32],
    area: TileArea,
    pixels: &mut TileGradients,
    out: &mut [InstanceGradient],
) {
    let mut batch = [TileSplat::NONE; BATCH];
    for (instances, out) in instances.chunks(BATCH).zip(out.chunks_mut(BATCH)) {
        let splats = load_batch(visible, &instances[..out.len()], area, &mut batch);
        for ((splat, out), &ix) in splats.iter().zip(out).zip(instances) {
            let mut sums = ColumnSums::default();
            for v in splat.vectors() {
                add_pixels::<FMA>(splat, v, pixels, &mut sums);
            }
            *out = sums.gradient(splat, visible[ix as usize].conic);
        }
    }
}

/// One vector of pixels; locals for the reason given at `raster`'s.
#[inline(always)]
fn add_pixels<const FMA: bool>(
    splat: &TileSplat,
    p: usize,
    pixels: &mut TileGradients,
    sums: &mut ColumnSums,
) {
    let half = p % ROW_VECTORS;
    let (x, dy) = splat.offset_to(p);
    let [red, green, blue] = splat.color;
    let (mut t, mut behind) = (pixels.transmittance[p], pixels.behind[p]);
    let [v_r, v_g, v_b, v_z] = pixels.v.each_ref().map(|v| v[p]);
    let [mut m0, mut m1, mut m2] = sums.moments.each_ref().map(|m| m[half]);
    let [mut sum_r, mut sum_g, mut sum_b, mut sum_z] = sums.channels.each_ref().map(|c| c[half]);
    for i in 0..LANES {
        let (alpha, is_free) = splat.alpha::<FMA>(x - i as f32, dy);
        let next = t[i] * (1.0 - alpha);
        let is_over = next <= MIN_TRANSMITTANCE;
        let weight = if is_over { 0.0 } else { alpha * t[i] };
        let seen = madd::<FMA>(red, v_r[i], green * v_g[i]);
        let seen = madd::<FMA>(blue, v_b[i], seen);
        let seen = madd::<FMA>(splat.depth, v_z[i], seen);
        behind[i] = madd::<FMA>(-weight, seen, behind[i]);
        let v_alpha = madd::<FMA>(t[i], seen, -behind[i] / (1.0 - alpha));
        // Alpha 0 stands for a pixel that the splat does not reach.
        let v_sigma = if is_free & !is_over {
            -alpha * v_alpha
        } else {
            0.0
        };
        m0[i] += v_sigma;
        m1[i] = madd::<FMA>(v_sigma, dy, m1[i]);
        m2[i] = madd::<FMA>(v_sigma, dy * dy, m2[i]);
        sum_r[i] = madd::<FMA>(weight, v_r[i], sum_r[i]);
        sum_g[i] = madd::<FMA>(weight, v_g[i], sum_g[i]);
        sum_b[i] = madd::<FMA>(weight, v_b[i], sum_b[i]);
        sum_z[i] = madd::<FMA>(weight, v_z[i], sum_z[i]);
        t[i] = if is_over { -t[i].abs() } else { next };
    }
    pixels.transmittance[p] = t;
    pixels.behind[p] = behind;
    for (sum, value) in sums.moments.iter_mut().zip([m0, m1, m2]) {
        sum[half] = value;
    }
    for (sum, value) in sums.channels.iter_mut().zip([sum_r, sum_g, sum_b, sum_z]) {
        sum[half] = value;
    }
}

impl ColumnSums {
    #[inline(always)]
    fn gradient(&self, splat: &TileSplat, [a, b, c]: [f32; 3]) -> InstanceGradient {
        let [m0, m1, m2] = self.moments.each_ref().map(|m| m.as_flattened());
        let mut moment_x = [0.0; TILE_PX];
        let mut moment_xx = [0.0; TILE_PX];
        let mut moment_xy = [0.0; TILE_PX];
        for i in 0..TILE_PX {
            let dx = splat.x - i as f32;
            moment_x[i] = m0[i] * dx;
            moment_xx[i] = m0[i] * dx * dx;
            moment_xy[i] = m1[i] * dx;
        }
        let (sum, x, y) = (total(m0), total(&moment_x), total(m1));
        let [red, green, blue, depth] = self.channels.each_ref().map(|c| total(c.as_flattened()));
        InstanceGradient {
            center: [a * x + b * y, b * x + c * y],
            conic: [0.5 * total(&moment_xx), total(&moment_xy), 0.5 * total(m2)],
            opacity: -sum / splat.opacity,
            color: [red, green, blue],
            depth,
        }
    }
}

/// Pairwise, which vectorises.
#[inline(always)]
fn total(lanes: &[f32]) -> f32 {
    let mut sums = [0.0; TILE_PX];
    sums.copy_from_slice(lanes);
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            sums[i] += sums[i + half];
        }
    }
    sums[0]
}

impl TileGradients {
    fn load(
        raster: &Raster,
        gradients: &PixelGradients,
        tile: &TilePixels,
        area: TileArea,
    ) -> Self {
        let mut v = [[[0.0; LANES]; TILE_VECTORS]; 4];
        let mut behind = [[0.0; LANES]; TILE_VECTORS];
        for row in 0..area.n_rows {
            let first = (area.y + row) * raster.stride + PLANE_MARGIN + area.x;
            let [v_r, v_g, v_b, v_a, v_z] = gradients
                .planes
                .each_ref()
                .map(|plane| &plane[first..][..area.n_columns]);
            for (v, from) in v.iter_mut().zip([v_r, v_g, v_b, v_z]) {
                v.as_flattened_mut()[row * TILE_PX..][..area.n_columns].copy_from_slice(from);
            }
            let behind = &mut behind.as_flattened_mut()[row * TILE_PX..][..area.n_columns];
            for (x, (behind, v_a)) in behind.iter_mut().zip(v_a).enumerate() {
                let at = |plane: &[Lane; TILE_VECTORS]| plane.as_flattened()[row * TILE_PX + x];
                let [r, g, b] = tile.rgb.each_ref().map(at);
                *behind = r * v_r[x] + g * v_g[x] + b * v_b[x] + at(&tile.depth_sum) * v_z[x]
                    - at(&tile.transmittance) * v_a;
            }
        }
        Self {
            v,
            behind,
            transmittance: start_transmittance(area),
        }
    }
}
