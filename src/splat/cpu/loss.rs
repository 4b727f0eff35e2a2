//! loss: rendered planes and the photo -> one number, and its gradient at every pixel.
//!
//! After `raster`. L1 + SSIM on colour, Huber on relative inverse depth. Equations: docs/GRADIENTS.md, losses.

use rayon::prelude::*;

use super::lanes::LANES;
use super::raster::{PLANE_MARGIN, Raster};
use super::ssim::{self, REACH, TAPS, Terms, Window};
use crate::frame::{DepthMap, RgbImage};
use crate::splat::StepSettings;

/// Relative error of inverse depth at which the depth loss turns from square to linear.
const HUBER_DELTA: f32 = 0.05;
/// A pixel that is mostly see-through has no depth to speak of.
const MIN_ALPHA_FOR_DEPTH: f32 = 0.5;
const MIN_CONFIDENCE_SUM: f64 = 1e-6;
/// Rows that one parallel task takes at least.
const ROWS_PER_TASK: usize = 4;

/// What the rendering should look like. The image has the size of the rendering; the depth map may be smaller.
#[derive(Debug, Clone, Copy)]
pub struct Target<'a> {
    pub image: &'a RgbImage,
    pub depth: Option<&'a DepthMap>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LossValue {
    /// Weighted sum of the parts below.
    pub total: f64,
    pub l1: f64,
    /// Mean SSIM, 1 is best.
    pub ssim: f64,
    /// Before its weight.
    pub depth: f64,
}

/// d loss / d plane, planes and stride as in `Raster`; margins hold nothing.
#[derive(Debug, Default)]
pub struct PixelGradients {
    pub planes: [Vec<f32>; 5],
    scratch: Scratch,
}

#[derive(Debug, Default)]
struct Scratch {
    stride: usize,
    target: Vec<f32>,
    /// x, y, x^2, y^2, xy blurred along rows.
    moments: [Vec<f32>; 5],
    /// p, q, r of `ssim::Terms`; two more rows to work in.
    terms: [Vec<f32>; 5],
    /// p, q, r blurred along rows.
    blurred: [Vec<f32>; 3],
    row_sums: Vec<[f64; 2]>,
    /// Column of the depth map that each pixel of a row takes.
    map_columns: Vec<usize>,
    zeros: Vec<f32>,
}

/// Compares the rendering with the photo. Fills `out` with the gradient.
pub fn loss(
    raster: &Raster,
    target: &Target<'_>,
    settings: &StepSettings,
    out: &mut PixelGradients,
) -> LossValue {
    out.resize(raster);
    let n = 3.0 * (raster.width_px * raster.height_px) as f64;
    if n == 0.0 {
        return LossValue::default();
    }
    let weight = f64::from(settings.ssim_weight);
    let weights = [((1.0 - weight) / n) as f32, (-weight / n) as f32];
    let mut value = LossValue::default();
    for channel in 0..3 {
        load_target(target.image, channel, raster, &mut out.scratch);
        blur_moments(raster, channel, &mut out.scratch);
        value.ssim += blur_terms(raster, &mut out.scratch) / n;
        value.l1 += photo_gradient(raster, channel, weights, out) / n;
    }
    value.depth = match target.depth {
        Some(depth) if settings.depth_weight > 0.0 => {
            depth_gradient(raster, depth, settings.depth_weight, out)
        }
        _ => {
            out.planes[3].fill(0.0);
            out.planes[4].fill(0.0);
            0.0
        }
    };
    value.total = (1.0 - weight) * value.l1 + weight * (1.0 - value.ssim);
    value.total += f64::from(settings.depth_weight) * value.depth;
    value
}

fn load_target(image: &RgbImage, channel: usize, raster: &Raster, scratch: &mut Scratch) {
    let width = raster.width_px;
    let rows = scratch
        .target
        .par_chunks_mut(raster.stride)
        .with_min_len(ROWS_PER_TASK);
    rows.zip(image.pixels.par_chunks(3 * width))
        .for_each(|(out, pixels)| {
            let (pixels, _) = pixels.as_chunks::<3>();
            for (out, pixel) in out[PLANE_MARGIN..].iter_mut().zip(pixels) {
                *out = f32::from(pixel[channel]) * (1.0 / 255.0);
            }
        });
}

fn blur_moments(raster: &Raster, channel: usize, scratch: &mut Scratch) {
    let (stride, width) = (raster.stride, raster.width_px);
    let [x, y, xx, yy, xy] = &mut scratch.moments;
    let inputs = raster.planes[channel]
        .par_chunks(stride)
        .zip(scratch.target.par_chunks(stride));
    let outputs = (
        x.par_chunks_mut(width),
        y.par_chunks_mut(width),
        xx.par_chunks_mut(width),
        yy.par_chunks_mut(width),
        xy.par_chunks_mut(width),
    );
    inputs
        .zip(outputs.into_par_iter())
        .with_min_len(ROWS_PER_TASK)
        .for_each(|((rendered, photo), out)| {
            let rendered = ssim::shifted(&rendered[PLANE_MARGIN - REACH..], width);
            let photo = ssim::shifted(&photo[PLANE_MARGIN - REACH..], width);
            ssim::blur(&rendered, out.0);
            ssim::blur(&photo, out.1);
            ssim::blur_product(&rendered, &rendered, out.2);
            ssim::blur_product(&photo, &photo, out.3);
            ssim::blur_product(&rendered, &photo, out.4);
        });
}

/// Finishes the blur of the moments, and starts the one of the derivatives. Returns the sum of SSIM.
fn blur_terms(raster: &Raster, scratch: &mut Scratch) -> f64 {
    let (stride, width) = (raster.stride, raster.width_px);
    let Scratch {
        moments,
        terms: [p, q, r, s, spare],
        blurred: [bp, bq, br],
        row_sums,
        zeros,
        ..
    } = scratch;
    let rows = (
        p.par_chunks_mut(stride),
        q.par_chunks_mut(stride),
        r.par_chunks_mut(stride),
        s.par_chunks_mut(stride),
        spare.par_chunks_mut(stride),
        bp.par_chunks_mut(width),
        bq.par_chunks_mut(width),
        br.par_chunks_mut(width),
        row_sums.par_iter_mut(),
    );
    rows.into_par_iter()
        .with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, (p, q, r, s, spare, bp, bq, br, sum))| {
            let mut rows = [p, q, r, s, spare];
            for (row, moment) in rows.iter_mut().zip(&*moments) {
                ssim::blur(
                    &window(moment, y, width, zeros),
                    &mut row[PLANE_MARGIN..][..width],
                );
            }
            {
                let [p, q, r, s, spare] =
                    rows.each_mut().map(|row| &mut row[PLANE_MARGIN..][..width]);
                ssim::terms_in_place(p, q, r, s, spare);
                sum[0] = sum_of(s);
            }
            for (row, out) in rows.iter().zip([bp, bq, br]) {
                ssim::blur(&ssim::shifted(&row[PLANE_MARGIN - REACH..], width), out);
            }
        });
    row_sums.iter().map(|sums| sums[0]).sum()
}

/// Returns the sum of absolute differences.
fn photo_gradient(
    raster: &Raster,
    channel: usize,
    weights: [f32; 2],
    out: &mut PixelGradients,
) -> f64 {
    let (stride, width) = (raster.stride, raster.width_px);
    let Scratch {
        target,
        blurred: [p, q, r],
        row_sums,
        zeros,
        ..
    } = &mut out.scratch;
    let rows = out.planes[channel]
        .par_chunks_mut(stride)
        .zip(row_sums.par_iter_mut());
    rows.with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, (out, sum))| {
            let rendered = raster.row(channel, y);
            let photo = &target[y * stride + PLANE_MARGIN..][..width];
            let terms = Terms {
                p: window(p, y, width, zeros),
                q: window(q, y, width, zeros),
                r: window(r, y, width, zeros),
            };
            ssim::gradient_row(
                &terms,
                rendered,
                photo,
                weights,
                &mut out[PLANE_MARGIN..][..width],
            );
            sum[0] = sum_of_differences(rendered, photo);
        });
    row_sums.iter().map(|sums| sums[0]).sum()
}

/// Rows y - REACH to y + REACH of a plane without margins; zeros beyond its edges.
fn window<'a>(plane: &'a [f32], y: usize, width: usize, zeros: &'a [f32]) -> Window<'a> {
    let mut window = [zeros; TAPS];
    for (t, row) in window.iter_mut().enumerate() {
        if let Some(inside) = (y + t)
            .checked_sub(REACH)
            .and_then(|y| plane.get(y * width..(y + 1) * width))
        {
            *row = inside;
        }
    }
    window
}

/// Returns the depth loss before its weight.
fn depth_gradient(raster: &Raster, map: &DepthMap, weight: f32, out: &mut PixelGradients) -> f64 {
    let Scratch {
        row_sums,
        map_columns,
        ..
    } = &mut out.scratch;
    let map_width = map.width_px as usize;
    map_columns.clear();
    // floor((x + 0.5) * map_width / width) in integers.
    map_columns
        .extend((0..raster.width_px).map(|x| (2 * x + 1) * map_width / (2 * raster.width_px)));
    let map_columns = &*map_columns;
    row_sums
        .par_iter_mut()
        .with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, sums)| {
            let confidences = depth_targets(raster, map, map_columns, y).flatten();
            *sums = [
                confidences
                    .map(|(_, confidence)| f64::from(confidence))
                    .sum(),
                0.0,
            ];
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
        for (x, target) in depth_targets(raster, map, map_columns, y).enumerate() {
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

/// Depth and confidence wanted at the pixels of a row, nearest neighbour.
fn depth_targets<'a>(
    raster: &Raster,
    map: &'a DepthMap,
    map_columns: &'a [usize],
    y: usize,
) -> impl Iterator<Item = Option<(f32, f32)>> + 'a {
    let (map_width, map_height) = (map.width_px as usize, map.height_px as usize);
    let map_y = (2 * y + 1) * map_height / (2 * raster.height_px);
    let row = map_y * map_width..(map_y + 1) * map_width;
    // Empty when the map is shorter than it says.
    let depths = map.depth.get(row.clone()).unwrap_or_default();
    let confidences = map.confidence.get(row).unwrap_or_default();
    map_columns.iter().map(|&x| {
        let (depth, confidence) = (*depths.get(x)?, *confidences.get(x)?);
        let is_usable =
            depth > 0.0 && depth.is_finite() && confidence > 0.0 && confidence.is_finite();
        is_usable.then_some((depth, confidence))
    })
}

/// Value and slope.
fn huber(error: f32) -> (f32, f32) {
    if error.abs() <= HUBER_DELTA {
        (0.5 * error * error / HUBER_DELTA, error / HUBER_DELTA)
    } else {
        (error.abs() - 0.5 * HUBER_DELTA, error.signum())
    }
}

fn sum_of(row: &[f32]) -> f64 {
    let (vectors, rest) = row.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for vector in vectors {
        for i in 0..LANES {
            sums[i] += vector[i];
        }
    }
    sums.iter().chain(rest).map(|&x| f64::from(x)).sum()
}

fn sum_of_differences(a: &[f32], b: &[f32]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for i in 0..LANES {
            sums[i] += (a[i] - b[i]).abs();
        }
    }
    let rest = a_rest
        .iter()
        .zip(b_rest)
        .map(|(a, b)| f64::from((a - b).abs()));
    sums.iter().map(|&x| f64::from(x)).sum::<f64>() + rest.sum::<f64>()
}

impl PixelGradients {
    fn resize(&mut self, raster: &Raster) {
        let n_padded = raster.stride * raster.height_px;
        let n_pixels = raster.width_px * raster.height_px;
        let scratch = &mut self.scratch;
        // Margins must stay zero, and another width moves them.
        if scratch.stride != raster.stride {
            scratch.target.clear();
            scratch.terms.iter_mut().for_each(Vec::clear);
        }
        scratch.stride = raster.stride;
        scratch.target.resize(n_padded, 0.0);
        scratch
            .terms
            .iter_mut()
            .for_each(|t| t.resize(n_padded, 0.0));
        scratch
            .moments
            .iter_mut()
            .chain(&mut scratch.blurred)
            .for_each(|m| m.resize(n_pixels, 0.0));
        scratch.row_sums.resize(raster.height_px, [0.0; 2]);
        scratch.zeros.resize(raster.width_px, 0.0);
        self.planes.iter_mut().for_each(|p| p.resize(n_padded, 0.0));
    }
}
