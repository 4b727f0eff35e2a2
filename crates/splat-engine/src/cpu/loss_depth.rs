//! loss_depth: rendered depth and alpha against a depth map -> one number, and its gradient at every pixel.
//!
//! Part of `loss`. Three ways to compare; only the first has a physical meaning. Equations: docs/GRADIENTS.md, losses.

use rayon::prelude::*;

use crate::cpu::loss_buffers::{PixelGradients, ROWS_PER_TASK, Scratch, Stretched};
use crate::cpu::raster::{PLANE_MARGIN, Raster};
use crate::settings::{DepthMode, StepSettings};
use splat_types::depth::DepthMap;

/// Relative error of inverse depth at which the depth loss turns from square to linear.
const HUBER_DELTA: f32 = 0.05;
/// A pixel that is mostly see-through has no depth to speak of.
const MIN_ALPHA_FOR_DEPTH: f32 = 0.5;
const MIN_CONFIDENCE_SUM: f64 = 1e-6;
/// What spans less, relative to its largest number, is flat: stretching it to 0..1 would amplify rounding.
const MIN_RELATIVE_RANGE: f32 = 1e-3;

/// The depth map at the pixels of the image.
struct Targets<'a> {
    map: &'a DepthMap,
    map_columns: &'a [usize],
    weights: &'a [f32],
    height_px: usize,
}

/// Fills alpha and depth sum of the gradient. Returns the depth loss before its weight.
pub(crate) fn depth_gradient(
    raster: &Raster,
    map: &DepthMap,
    settings: &StepSettings,
    out: &mut PixelGradients,
) -> f64 {
    let map_columns = &mut out.scratch.map_columns;
    let map_width = map.width_px as usize;
    map_columns.clear();
    // floor((x + 0.5) * map_width / width) in integers.
    map_columns
        .extend((0..raster.width_px).map(|x| (2 * x + 1) * map_width / (2 * raster.width_px)));
    match settings.depth_mode {
        DepthMode::InverseDepth => {
            inverse_gradient(raster, map, settings.weights.depth_weight, out)
        }
        mode => stretched_gradient(raster, map, mode, settings.weights.depth_weight, out),
    }
}

/// Huber of the relative error of inverse depth, weighted by confidence.
fn inverse_gradient(raster: &Raster, map: &DepthMap, weight: f32, out: &mut PixelGradients) -> f64 {
    let Scratch {
        row_sums,
        map_columns,
        weights,
        ..
    } = &mut out.scratch;
    let targets = Targets {
        map,
        map_columns,
        weights,
        height_px: raster.height_px,
    };
    row_sums
        .par_iter_mut()
        .with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, sums)| {
            let confidences = targets.of_row(y).flatten();
            let confidences = confidences.map(|(_, confidence)| f64::from(confidence));
            *sums = [confidences.sum(), 0.0, 0.0];
        });
    let confidence_sum = row_sums
        .iter()
        .map(|sums| sums[0])
        .sum::<f64>()
        .max(MIN_CONFIDENCE_SUM);
    let scale = (f64::from(weight) / confidence_sum) as f32;
    let [.., alpha_plane, depth_plane] = &mut out.planes;
    let rows = (
        alpha_plane.par_chunks_mut(raster.stride),
        depth_plane.par_chunks_mut(raster.stride),
        row_sums.par_iter_mut(),
    );
    let rows = rows.into_par_iter().with_min_len(ROWS_PER_TASK).enumerate();
    rows.for_each(|(y, (v_alpha, v_depth_sum, sums))| {
        v_alpha.fill(0.0);
        v_depth_sum.fill(0.0);
        let (alpha, depth_sum) = (raster.row(3, y), raster.row(4, y));
        for (x, target) in targets.of_row(y).enumerate() {
            let Some((target, confidence)) = target else {
                continue;
            };
            if alpha[x] <= MIN_ALPHA_FOR_DEPTH {
                continue;
            }
            let depth = depth_sum[x] / alpha[x];
            let (huber, slope) = huber(target / depth - 1.0);
            sums[1] += f64::from(confidence) * f64::from(huber);
            let v_depth = -scale * confidence * slope * target / (depth * depth);
            v_depth_sum[PLANE_MARGIN + x] = v_depth / alpha[x];
            v_alpha[PLANE_MARGIN + x] = -v_depth * depth / alpha[x];
        }
    });
    row_sums.iter().map(|sums| sums[1]).sum::<f64>() / confidence_sum
}

impl Targets<'_> {
    /// Depth and confidence wanted at the pixels of a row, nearest neighbour.
    fn of_row(&self, y: usize) -> impl Iterator<Item = Option<(f32, f32)>> + '_ {
        let map = self.map;
        let (map_width, map_height) = (map.width_px as usize, map.height_px as usize);
        let map_y = (2 * y + 1) * map_height / (2 * self.height_px);
        let row = map_y * map_width..(map_y + 1) * map_width;
        // Empty when the map is shorter than it says.
        let depths = map.depth.get(row.clone()).unwrap_or_default();
        let confidences = map.confidence.get(row).unwrap_or_default();
        let weights = &self.weights[y * self.map_columns.len()..];
        self.map_columns.iter().zip(weights).map(|(&x, &weight)| {
            let (depth, confidence) = (*depths.get(x)?, weight * *confidences.get(x)?);
            let is_usable =
                depth > 0.0 && depth.is_finite() && confidence > 0.0 && confidence.is_finite();
            is_usable.then_some((depth, confidence))
        })
    }

    /// The same whatever the confidence, where the pixel counts at all.
    fn depths_of_row(&self, y: usize) -> impl Iterator<Item = Option<f32>> + '_ {
        let map = self.map;
        let (map_width, map_height) = (map.width_px as usize, map.height_px as usize);
        let map_y = (2 * y + 1) * map_height / (2 * self.height_px);
        let row = map_y * map_width..(map_y + 1) * map_width;
        let is_whole = map.confidence.len() >= row.end;
        let depths = map.depth.get(row).filter(|_| is_whole).unwrap_or_default();
        let weights = &self.weights[y * self.map_columns.len()..];
        self.map_columns.iter().zip(weights).map(|(&x, &weight)| {
            let depth = *depths.get(x)?;
            let is_usable = depth > 0.0 && depth.is_finite() && weight > 0.0;
            is_usable.then_some(depth)
        })
    }
}

/// Mean difference of two images, each stretched to 0..1 over all pixels that have a depth, verified or not, whatever the map
/// covers: so FastSplatting has it. On one thread: this is for comparison with the paper, and a hundredth of a step.
fn stretched_gradient(
    raster: &Raster,
    map: &DepthMap,
    mode: DepthMode,
    weight: f32,
    out: &mut PixelGradients,
) -> f64 {
    out.planes[3].fill(0.0);
    out.planes[4].fill(0.0);
    let is_alpha = mode == DepthMode::PaperAlpha;
    collect(raster, map, is_alpha, &mut out.scratch);
    let pixels = &out.scratch.stretched;
    let ranges = (
        range(pixels, |pixel| pixel.rendered),
        range(pixels, |pixel| pixel.wanted),
    );
    let (Some(rendered), Some(wanted)) = ranges else {
        return 0.0;
    };
    let scale = f64::from(weight) / pixels.len() as f64 / f64::from(rendered.high - rendered.low);
    let [_, _, _, v_alpha, v_depth_sum] = &mut out.planes;
    let mut put = |pixel: &Stretched, v: f32| {
        let at = pixel.y * raster.stride + PLANE_MARGIN + pixel.x;
        if is_alpha {
            v_alpha[at] += v;
        } else {
            let alpha = raster.planes[3][at];
            // Where there is no splat there is nothing to move.
            if alpha > 0.0 {
                v_depth_sum[at] += v / alpha;
                v_alpha[at] -= v * pixel.rendered / alpha;
            }
        }
    };
    let (mut sum, mut v_low, mut v_high) = (0.0, 0.0, 0.0);
    for pixel in pixels {
        let stretched = rendered.stretch(pixel.rendered);
        let difference = stretched - wanted.stretch(pixel.wanted);
        sum += f64::from(difference.abs());
        let sign = f64::from(u8::from(difference > 0.0)) - f64::from(u8::from(difference < 0.0));
        // All move when the ends do.
        v_low -= sign * (1.0 - f64::from(stretched));
        v_high -= sign * f64::from(stretched);
        put(pixel, (scale * sign) as f32);
    }
    put(&pixels[rendered.low_ix], (scale * v_low) as f32);
    put(&pixels[rendered.high_ix], (scale * v_high) as f32);
    sum / pixels.len() as f64
}

/// Pixels that have a target. 1 - minmax(1/d) is minmax(-1/d).
fn collect(raster: &Raster, map: &DepthMap, is_alpha: bool, scratch: &mut Scratch) {
    let targets = Targets {
        map,
        map_columns: &scratch.map_columns,
        weights: &scratch.weights,
        height_px: raster.height_px,
    };
    scratch.stretched.clear();
    for y in 0..raster.height_px {
        let (alpha, depth_sum) = (raster.row(3, y), raster.row(4, y));
        for (x, target) in targets.depths_of_row(y).enumerate() {
            let Some(depth) = target else { continue };
            let (rendered, wanted) = if is_alpha {
                (alpha[x], depth)
            } else if alpha[x] > 0.0 {
                (depth_sum[x] / alpha[x], -1.0 / depth)
            } else {
                (0.0, -1.0 / depth)
            };
            scratch.stretched.push(Stretched {
                x,
                y,
                rendered,
                wanted,
            });
        }
    }
}

/// Smallest and largest number, and the first pixels that have them.
struct Range {
    low: f32,
    high: f32,
    low_ix: usize,
    high_ix: usize,
}

/// `None`: flat, empty or not finite.
fn range(pixels: &[Stretched], of: impl Fn(&Stretched) -> f32) -> Option<Range> {
    let first = of(pixels.first()?);
    let mut range = Range {
        low: first,
        high: first,
        low_ix: 0,
        high_ix: 0,
    };
    for (ix, value) in pixels.iter().map(of).enumerate() {
        if value < range.low {
            (range.low, range.low_ix) = (value, ix);
        }
        if value > range.high {
            (range.high, range.high_ix) = (value, ix);
        }
    }
    let (width, size) = (
        range.high - range.low,
        range.high.abs().max(range.low.abs()),
    );
    (width.is_finite() && width > MIN_RELATIVE_RANGE * size).then_some(range)
}

impl Range {
    fn stretch(&self, value: f32) -> f32 {
        (value - self.low) / (self.high - self.low)
    }
}

/// Value and slope.
fn huber(error: f32) -> (f32, f32) {
    if error.abs() <= HUBER_DELTA {
        (0.5 * error * error / HUBER_DELTA, error / HUBER_DELTA)
    } else {
        (error.abs() - 0.5 * HUBER_DELTA, error.signum())
    }
}
