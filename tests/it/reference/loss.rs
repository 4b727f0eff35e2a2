//! A rendering and its target -> loss, and its gradient with respect to every pixel. docs/GRADIENTS.md 5.

use super::project::sigmoid;
use super::raster::Raster;
use super::{Params, Target, Weights};

const WINDOW_RADIUS: isize = 5;
const WINDOW_SIGMA: f64 = 1.5;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
/// Relative inverse-depth error at which Huber turns from square to straight.
const HUBER: f64 = 0.05;
/// Below this alpha a pixel's expected depth means nothing.
pub const MIN_DEPTH_ALPHA: f64 = 0.5;

#[derive(Debug, Clone)]
pub struct Loss {
    pub total: f64,
    /// Mean absolute difference, mean SSIM, weighted mean Huber: each before its weight.
    pub l1: f64,
    pub ssim: f64,
    pub depth: f64,
    /// Gradients of `total` with respect to the raster's outputs.
    pub v_rgb: Vec<f64>,
    pub v_alpha: Vec<f64>,
    pub v_depth_sum: Vec<f64>,
}

pub fn loss(raster: &Raster, target: &Target, weights: &Weights) -> Loss {
    let n = raster.alpha.len();
    let mut v_rgb = vec![0.0; 3 * n];
    let l1 = l1(&raster.rgb, &target.rgb, weights.l1, &mut v_rgb);
    let ssim = if weights.ssim == 0.0 {
        0.0
    } else {
        ssim(raster, target, -weights.ssim, &mut v_rgb)
    };
    let (mut v_alpha, mut v_depth_sum) = (vec![0.0; n], vec![0.0; n]);
    let depth = depth(
        raster,
        target,
        weights.depth,
        [&mut v_alpha, &mut v_depth_sum],
    );
    let total = weights.l1 * l1 + weights.ssim * (1.0 - ssim) + weights.depth * depth;
    Loss {
        total,
        l1,
        ssim,
        depth,
        v_rgb,
        v_alpha,
        v_depth_sum,
    }
}

fn l1(rendered: &[f64], wanted: &[f64], weight: f64, v_rgb: &mut [f64]) -> f64 {
    let n = rendered.len().max(1) as f64;
    let mut sum = 0.0;
    for ((r, g), v) in rendered.iter().zip(wanted).zip(v_rgb) {
        sum += (r - g).abs();
        *v += weight * if r == g { 0.0 } else { (r - g).signum() } / n;
    }
    sum / n
}

/// Mean SSIM over pixels and channels; adds `weight` times its gradient (Wang 2004, window as in 3DGS).
fn ssim(raster: &Raster, target: &Target, weight: f64, v_rgb: &mut [f64]) -> f64 {
    let n = (3 * raster.alpha.len()) as f64;
    let mut sum = 0.0;
    let bell = bell();
    for pixel in 0..raster.alpha.len() {
        let window = window(raster, pixel, &bell);
        for channel in 0..3 {
            let [mut mu_x, mut mu_y, mut xx, mut yy, mut xy] = [0.0; 5];
            for &(other, w) in &window {
                let (x, y) = (
                    raster.rgb[3 * other + channel],
                    target.rgb[3 * other + channel],
                );
                mu_x += w * x;
                mu_y += w * y;
                xx += w * x * x;
                yy += w * y * y;
                xy += w * x * y;
            }
            let (var_x, var_y, cov) = (xx - mu_x * mu_x, yy - mu_y * mu_y, xy - mu_x * mu_y);
            let (n1, n2) = (2.0 * mu_x * mu_y + C1, 2.0 * cov + C2);
            let (d1, d2) = (mu_x * mu_x + mu_y * mu_y + C1, var_x + var_y + C2);
            let s = n1 * n2 / (d1 * d2);
            sum += s;

            let by_var = -s / d2;
            let by_cov = 2.0 * n1 / (d1 * d2);
            let by_mu = 2.0 * mu_y * n2 / (d1 * d2) - 2.0 * mu_x * s / d1;
            // var_x and cov hold mu_x too.
            let by_mu = by_mu - 2.0 * mu_x * by_var - mu_y * by_cov;
            for &(other, w) in &window {
                let (x, y) = (
                    raster.rgb[3 * other + channel],
                    target.rgb[3 * other + channel],
                );
                v_rgb[3 * other + channel] +=
                    weight / n * w * (by_mu + 2.0 * x * by_var + y * by_cov);
            }
        }
    }
    sum / n.max(1.0)
}

/// Neighbours inside the picture with their Gaussian weights; what lies outside counts as 0, weights are not rescaled.
fn window(raster: &Raster, pixel: usize, bell: &[f64; 11]) -> Vec<(usize, f64)> {
    let (width, height) = (raster.width_px as isize, raster.height_px as isize);
    let (x, y) = (pixel as isize % width, pixel as isize / width);
    let bell = |offset: isize| bell[(offset + WINDOW_RADIUS) as usize];
    let mut window = Vec::with_capacity(121);
    for other_y in (y - WINDOW_RADIUS).max(0)..=(y + WINDOW_RADIUS).min(height - 1) {
        for other_x in (x - WINDOW_RADIUS).max(0)..=(x + WINDOW_RADIUS).min(width - 1) {
            let weight = bell(other_x - x) * bell(other_y - y);
            window.push(((other_y * width + other_x) as usize, weight));
        }
    }
    window
}

/// Gaussian weights of one row of the window, sum 1.
fn bell() -> [f64; 11] {
    let raw = std::array::from_fn(|ix| {
        (-0.5 * ((ix as f64 - WINDOW_RADIUS as f64) / WINDOW_SIGMA).powi(2)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|value: f64| value / sum)
}

/// Huber of the relative inverse-depth error, weighted by confidence; adds `weight` times its gradient.
fn depth(
    raster: &Raster,
    target: &Target,
    weight: f64,
    [v_alpha, v_depth_sum]: [&mut [f64]; 2],
) -> f64 {
    let total_confidence: f64 = target.depth.iter().map(|&(_, confidence)| confidence).sum();
    let norm = total_confidence.max(1e-6);
    let mut sum = 0.0;
    for (pixel, &(wanted, confidence)) in target.depth.iter().enumerate() {
        let alpha = raster.alpha[pixel];
        if confidence == 0.0 || alpha <= MIN_DEPTH_ALPHA {
            continue;
        }
        let rendered = raster.depth_sum[pixel] / alpha;
        let (value, slope) = huber(wanted / rendered - 1.0);
        sum += confidence * value;
        let v_depth = weight * confidence / norm * slope * -wanted / (rendered * rendered);
        v_depth_sum[pixel] += v_depth / alpha;
        v_alpha[pixel] -= v_depth * rendered / alpha;
    }
    sum / norm
}

fn huber(error: f64) -> (f64, f64) {
    if error.abs() <= HUBER {
        (0.5 * error * error / HUBER, error / HUBER)
    } else {
        (error.abs() - 0.5 * HUBER, error.signum())
    }
}

/// Mean opacity and mean scale of the visible splats (3DGS-MCMC); adds their gradients.
pub fn regularise(
    params: &Params,
    visible: &[usize],
    weights: &Weights,
    v_splats: &mut Params,
) -> f64 {
    let n = visible.len().max(1) as f64;
    let mut total = 0.0;
    for &ix in visible {
        let opacity = sigmoid(params.opacity_logits[ix]);
        total += weights.opacity * opacity / n;
        v_splats.opacity_logits[ix] += weights.opacity / n * opacity * (1.0 - opacity);
        for (log_scale, v) in params.log_scales[ix]
            .iter()
            .zip(&mut v_splats.log_scales[ix])
        {
            total += weights.scale * log_scale.exp() / (3.0 * n);
            *v += weights.scale * log_scale.exp() / (3.0 * n);
        }
    }
    total
}
