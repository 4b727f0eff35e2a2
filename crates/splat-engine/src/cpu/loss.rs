//! loss: rendered planes and the photo -> one number, and its gradient at every pixel.
//!
//! After `raster`. L1 + SSIM on exposed colour, weighted by pixel; depth is in `loss_depth`. Equations: docs/GRADIENTS.md,
//! losses.

use rayon::prelude::*;

use crate::cpu::lanes::LANES;
use crate::cpu::loss_buffers::{PixelGradients, ROWS_PER_TASK, Scratch};
use crate::cpu::loss_depth::depth_gradient;
use crate::cpu::raster::{PLANE_MARGIN, Raster};
use crate::cpu::ssim::{self, REACH, TAPS, Terms, Window};
use crate::settings::StepSettings;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;

/// What the rendering should look like. The image has the size of the rendering; the depth map may be smaller.
#[derive(Debug, Clone, Copy)]
pub struct Target<'a> {
    pub image: &'a RgbImage,
    pub depth: Option<&'a DepthMap>,
    /// Weight of each pixel, 255: all.
    pub mask: Option<&'a [u8]>,
    /// Log gain and offset of r, g, b that the rendering is compared with.
    pub exposure: [[f32; 3]; 2],
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
    /// d total / d log gain and offset of r, g, b.
    pub exposure: [[f64; 3]; 2],
}

/// Compares the rendering with the photo. Fills `out` with the gradient.
pub fn loss(
    raster: &Raster,
    target: &Target<'_>,
    settings: &StepSettings,
    out: &mut PixelGradients,
) -> LossValue {
    out.resize(raster);
    let n_pixels = raster.width_px * raster.height_px;
    if n_pixels == 0 {
        return LossValue::default();
    }
    let weight = f64::from(settings.ssim_weight);
    let margin = if settings.ssim_valid { REACH } else { 0 };
    let mut value = photo_loss(raster, target, (weight, margin), out);
    value.depth = match target.depth {
        Some(depth) if settings.weights.depth_weight > 0.0 => {
            depth_gradient(raster, depth, settings, out)
        }
        _ => {
            out.planes[3].fill(0.0);
            out.planes[4].fill(0.0);
            0.0
        }
    };
    value.total = (1.0 - weight) * value.l1 + weight * (1.0 - value.ssim);
    value.total += f64::from(settings.weights.depth_weight) * value.depth;
    value
}

/// Fills r, g, b of the gradient. SSIM is averaged over pixels that are `margin` away from the image's edges.
fn photo_loss(
    raster: &Raster,
    target: &Target<'_>,
    (ssim_weight, margin): (f64, usize),
    out: &mut PixelGradients,
) -> LossValue {
    let mut value = LossValue::default();
    let n = 3.0 * load_weights(target.mask, &mut out.scratch.weights);
    if n == 0.0 {
        // Nothing is wanted, so everything is right.
        out.planes[..3].iter_mut().for_each(|plane| plane.fill(0.0));
        value.ssim = 1.0;
        return value;
    }
    let n_ssim = match margin {
        0 => n,
        _ => 3.0 * sum_within(&out.scratch.weights, raster, margin),
    };
    let per_ssim = if n_ssim > 0.0 { 1.0 / n_ssim } else { 0.0 };
    let weights = [
        ((1.0 - ssim_weight) / n) as f32,
        (-ssim_weight * per_ssim) as f32,
    ];
    let [gains, offsets] = target.exposure;
    for channel in 0..3 {
        let exposure = [gains[channel].exp(), offsets[channel]];
        load_target(target.image, channel, raster, &mut out.scratch);
        expose(raster, channel, exposure, &mut out.scratch);
        blur_moments(raster, &mut out.scratch);
        let is_weighted = target.mask.is_some();
        value.ssim += blur_terms(raster, (is_weighted, margin), &mut out.scratch) * per_ssim;
        let [l1, by_gain, by_offset] = photo_gradient(raster, channel, exposure, weights, out);
        value.l1 += l1 / n;
        value.exposure[0][channel] = by_gain;
        value.exposure[1][channel] = by_offset;
    }
    if n_ssim == 0.0 {
        value.ssim = 1.0;
    }
    value
}

/// Of the pixels that are `margin` away from the edges.
fn sum_within(weights: &[f32], raster: &Raster, margin: usize) -> f64 {
    let (width, height) = (raster.width_px, raster.height_px);
    let rows = margin..height.saturating_sub(margin);
    let of_row = |y: usize| {
        let row = weights.get(y * width + margin..(y + 1) * width - margin);
        let row = row.unwrap_or_default().iter();
        row.map(|weight| f64::from(*weight)).sum::<f64>()
    };
    let is_wide = width > 2 * margin;
    rows.filter(|_| is_wide).map(of_row).sum()
}

/// Returns the sum of the weights.
fn load_weights(mask: Option<&[u8]>, weights: &mut [f32]) -> f64 {
    let Some(mask) = mask else {
        weights.fill(1.0);
        return weights.len() as f64;
    };
    let mut sum = 0_u64;
    for (weight, &byte) in weights.iter_mut().zip(mask) {
        *weight = f32::from(byte) * (1.0 / 255.0);
        sum += u64::from(byte);
    }
    sum as f64 / 255.0
}

/// The rendering as the view's camera would have shown it.
fn expose(raster: &Raster, channel: usize, [gain, offset]: [f32; 2], scratch: &mut Scratch) {
    let rows = scratch.exposed.par_chunks_mut(raster.stride);
    rows.with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, out)| {
            let rendered = raster.row(channel, y);
            for (out, x) in out[PLANE_MARGIN..].iter_mut().zip(rendered) {
                *out = gain * x + offset;
            }
        });
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

fn blur_moments(raster: &Raster, scratch: &mut Scratch) {
    let (stride, width) = (raster.stride, raster.width_px);
    let [x, y, xx, yy, xy] = &mut scratch.moments;
    let inputs = scratch
        .exposed
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

/// Finishes the blur of the moments, and starts the one of the derivatives. Returns the weighted sum of SSIM over the pixels that
/// are `margin` away from the edges; the others have no say.
fn blur_terms(raster: &Raster, (is_weighted, margin): (bool, usize), scratch: &mut Scratch) -> f64 {
    let (stride, width, height) = (raster.stride, raster.width_px, raster.height_px);
    let Scratch {
        moments,
        terms: [p, q, r, s, spare],
        blurred: [bp, bq, br],
        weights,
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
        weights.par_chunks(width),
        row_sums.par_iter_mut(),
    );
    rows.into_par_iter()
        .with_min_len(ROWS_PER_TASK)
        .enumerate()
        .for_each(|(y, (p, q, r, s, spare, bp, bq, br, weights, sum))| {
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
                if is_weighted {
                    for row in [&mut *p, &mut *q, &mut *r, &mut *s] {
                        row.iter_mut()
                            .zip(weights)
                            .for_each(|(x, weight)| *x *= weight);
                    }
                }
                if margin > 0 {
                    let is_inside = (margin..height.saturating_sub(margin)).contains(&y);
                    let sides = if is_inside { margin.min(width) } else { width };
                    for row in [&mut *p, &mut *q, &mut *r, &mut *s] {
                        row[..sides].fill(0.0);
                        row[width - sides..].fill(0.0);
                    }
                }
                sum[0] = sum_of([s], |[s]| s);
            }
            for (row, out) in rows.iter().zip([bp, bq, br]) {
                ssim::blur(&ssim::shifted(&row[PLANE_MARGIN - REACH..], width), out);
            }
        });
    row_sums.iter().map(|sums| sums[0]).sum()
}

/// Returns the weighted sum of absolute differences, and the gradients of the channel's log gain and offset.
fn photo_gradient(
    raster: &Raster,
    channel: usize,
    [gain, _]: [f32; 2],
    weights: [f32; 2],
    out: &mut PixelGradients,
) -> [f64; 3] {
    let (stride, width) = (raster.stride, raster.width_px);
    let Scratch {
        target,
        exposed,
        weights: pixel_weights,
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
        .for_each(|(y, (out, sums))| {
            let out = &mut out[PLANE_MARGIN..][..width];
            let [exposed, photo] =
                [&*exposed, &*target].map(|plane| &plane[y * stride + PLANE_MARGIN..][..width]);
            let pixel_weights = &pixel_weights[y * width..][..width];
            let terms = Terms {
                p: window(p, y, width, zeros),
                q: window(q, y, width, zeros),
                r: window(r, y, width, zeros),
            };
            ssim::gradient_row(&terms, exposed, photo, pixel_weights, weights, out);
            let compared = [pixel_weights, exposed, photo];
            sums[0] = sum_of(compared, |[weight, x, y]| weight * (x - y).abs());
            sums[2] = sum_of([out], |[v]| v);
            if gain != 1.0 {
                out.iter_mut().for_each(|v| *v *= gain);
            }
            sums[1] = sum_of([raster.row(channel, y), out], |[x, v]| x * v);
        });
    let mut total = [0.0; 3];
    for sums in &*row_sums {
        (0..3).for_each(|k| total[k] += sums[k]);
    }
    total
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

/// Sum of `value` of the numbers of each column, in f32 by lanes and then in f64: rows are short.
#[inline(always)]
fn sum_of<const N: usize>(rows: [&[f32]; N], value: impl Fn([f32; N]) -> f32) -> f64 {
    let parts = rows.map(|row| row.as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    for c in 0..parts[0].0.len() {
        let vectors = parts.map(|(vectors, _)| &vectors[c]);
        for (i, sum) in sums.iter_mut().enumerate() {
            *sum += value(vectors.map(|vector| vector[i]));
        }
    }
    let rests = parts.map(|(_, rest)| rest);
    let rest = (0..rests[0].len()).map(|i| f64::from(value(rests.map(|rest| rest[i]))));
    sums.iter().map(|&x| f64::from(x)).sum::<f64>() + rest.sum::<f64>()
}
