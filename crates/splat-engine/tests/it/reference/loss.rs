//! A rendering and its target -> loss, and its gradient with respect to every pixel. docs/GRADIENTS.md 5.

use super::loss_depth::{Decisions, depth};
use super::project::sigmoid;
use super::raster::Raster;
use super::{Params, Target, Weights};

const WINDOW_RADIUS: isize = 5;
const WINDOW_SIGMA: f64 = 1.5;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
#[derive(Debug, Clone)]
pub struct Loss {
    pub total: f64,
    /// Mean absolute difference, mean SSIM, depth: each before its weight.
    pub l1: f64,
    pub ssim: f64,
    pub depth: f64,
    /// Gradients of `total` with respect to the raster's outputs.
    pub v_rgb: Vec<f64>,
    pub v_alpha: Vec<f64>,
    pub v_depth_sum: Vec<f64>,
    pub v_exposure: [[f64; 3]; 2],
    /// What the depth loss decided, and by how little.
    pub depth_decisions: Decisions,
}

pub fn loss(raster: &Raster, target: &Target, weights: &Weights) -> Loss {
    let n = raster.alpha.len();
    let [gain, offset] = target.exposure;
    let exposed: Vec<f64> = (0..3 * n)
        .map(|at| gain[at % 3].exp() * raster.rgb[at] + offset[at % 3])
        .collect();
    let mut v_rgb = vec![0.0; 3 * n];
    let norm = 3.0 * target.weights.iter().sum::<f64>();
    // Where no pixel counts, nothing is wrong.
    let (mut l1, mut ssim) = (0.0, 1.0);
    if norm > 0.0 {
        l1 = mean_difference(&exposed, target, weights.l1 / norm, &mut v_rgb) / norm;
        ssim = if weights.ssim == 0.0 {
            0.0
        } else {
            let size = [raster.width_px, raster.height_px];
            mean_ssim(&exposed, size, target, weights, &mut v_rgb)
        };
    }
    let mut v_exposure = [[0.0; 3]; 2];
    for (at, v) in v_rgb.iter_mut().enumerate() {
        v_exposure[1][at % 3] += *v;
        *v *= gain[at % 3].exp();
        v_exposure[0][at % 3] += *v * raster.rgb[at];
    }
    let (mut v_alpha, mut v_depth_sum) = (vec![0.0; n], vec![0.0; n]);
    let (depth, depth_decisions) = depth(raster, target, weights, [&mut v_alpha, &mut v_depth_sum]);
    let total = weights.l1 * l1
        + weights.ssim * (1.0 - ssim)
        + f64::from(weights.terms.depth_weight) * depth;
    Loss {
        total,
        l1,
        ssim,
        depth,
        v_rgb,
        v_alpha,
        v_depth_sum,
        v_exposure,
        depth_decisions,
    }
}

/// Weighted sum; adds `scale` times its gradient.
fn mean_difference(rendered: &[f64], target: &Target, scale: f64, v_rgb: &mut [f64]) -> f64 {
    let mut sum = 0.0;
    for (at, (r, g)) in rendered.iter().zip(&target.rgb).enumerate() {
        let weight = target.weights[at / 3];
        sum += weight * (r - g).abs();
        v_rgb[at] += scale * weight * if r == g { 0.0 } else { (r - g).signum() };
    }
    sum
}

/// Over all pixels, or those whose whole window lies in the image; adds the gradient of the loss's term.
fn mean_ssim(
    rendered: &[f64],
    size: [usize; 2],
    target: &Target,
    weights: &Weights,
    v_rgb: &mut [f64],
) -> f64 {
    let mut averaged = target.clone();
    if weights.ssim_valid {
        let reach = WINDOW_RADIUS as usize;
        for (pixel, weight) in averaged.weights.iter_mut().enumerate() {
            let (x, y) = (pixel % size[0], pixel / size[0]);
            let is_whole = |at: usize, side: usize| at >= reach && at + reach < side;
            *weight *= f64::from(u8::from(is_whole(x, size[0]) && is_whole(y, size[1])));
        }
    }
    let norm = 3.0 * averaged.weights.iter().sum::<f64>();
    if norm == 0.0 {
        return 1.0;
    }
    ssim_sum(rendered, size, &averaged, -weights.ssim / norm, v_rgb) / norm
}

/// Weighted sum of SSIM over pixels and channels; adds `scale` times its gradient (Wang 2004, window as in 3DGS).
pub fn ssim_sum(
    rendered: &[f64],
    [width, height]: [usize; 2],
    target: &Target,
    scale: f64,
    v_rgb: &mut [f64],
) -> f64 {
    let mut sum = 0.0;
    let bell = bell();
    for pixel in 0..width * height {
        let pixel_weight = target.weights[pixel];
        let window = window([width, height], pixel, &bell);
        for channel in 0..3 {
            let [mut mu_x, mut mu_y, mut xx, mut yy, mut xy] = [0.0; 5];
            for &(other, w) in &window {
                let at = 3 * other + channel;
                let (x, y) = (rendered[at], target.rgb[at]);
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
            sum += pixel_weight * s;

            let by_var = -s / d2;
            let by_cov = 2.0 * n1 / (d1 * d2);
            let by_mu = 2.0 * mu_y * n2 / (d1 * d2) - 2.0 * mu_x * s / d1;
            // var_x and cov hold mu_x too.
            let by_mu = by_mu - 2.0 * mu_x * by_var - mu_y * by_cov;
            for &(other, w) in &window {
                let at = 3 * other + channel;
                let (x, y) = (rendered[at], target.rgb[at]);
                v_rgb[at] += scale * pixel_weight * w * (by_mu + 2.0 * x * by_var + y * by_cov);
            }
        }
    }
    sum
}

/// Neighbours inside the image with their Gaussian weights; what lies outside counts as 0, weights are not rescaled.
fn window(size: [usize; 2], pixel: usize, bell: &[f64; 11]) -> Vec<(usize, f64)> {
    let [width, height] = size.map(|side| side as isize);
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

/// Mean opacity and mean scale of the visible splats (3DGS-MCMC); adds their gradients.
pub fn regularise(
    params: &Params,
    visible: &[usize],
    weights: &Weights,
    v_splats: &mut Params,
) -> f64 {
    let n = visible.len().max(1) as f64;
    let [by_opacity, by_scale] =
        [weights.terms.opacity_reg, weights.terms.scale_reg].map(f64::from);
    let mut total = 0.0;
    for &ix in visible {
        let opacity = sigmoid(params.opacity_logits[ix]);
        total += by_opacity * opacity / n;
        v_splats.opacity_logits[ix] += by_opacity / n * opacity * (1.0 - opacity);
        for (log_scale, v) in params.log_scales[ix]
            .iter()
            .zip(&mut v_splats.log_scales[ix])
        {
            total += by_scale * log_scale.exp() / (3.0 * n);
            *v += by_scale * log_scale.exp() / (3.0 * n);
        }
    }
    total
}
