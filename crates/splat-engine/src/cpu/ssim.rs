//! Rows of the SSIM computation (Wang et al. 2004): 11x11 Gaussian window, images count as 0 beyond their edges.
//!
//! `loss` calls them: moments blurred along rows, then along columns, terms per pixel, and the same blurs backwards.

use multiversion::multiversion;

use crate::cpu::lanes::madd;

pub(crate) const TAPS: usize = 11;
/// Pixels that the window reaches to each side.
pub(crate) const REACH: usize = TAPS / 2;

/// Normalised Gaussian, sigma 1.5 px.
const WINDOW: [f32; TAPS] = [
    0.001_028_38,
    0.007_598_758,
    0.036_000_773,
    0.109_360_69,
    0.213_005_54,
    0.266_011_72,
    0.213_005_54,
    0.109_360_69,
    0.036_000_773,
    0.007_598_758,
    0.001_028_38,
];
/// Stabilisers for values of range 1.
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;

/// The inputs of one output row, one per tap: neighbouring rows, or one row shifted.
pub(crate) type Window<'a> = [&'a [f32]; TAPS];

/// Blurred derivatives of SSIM that make up the gradient of one row, before their second blur.
pub(crate) struct Terms<'a> {
    pub(crate) p: Window<'a>,
    pub(crate) q: Window<'a>,
    pub(crate) r: Window<'a>,
}

/// `row` must hold `REACH` values more on each side than the output.
pub(crate) fn shifted(row: &[f32], n: usize) -> Window<'_> {
    std::array::from_fn(|t| &row[t..t + n])
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn blur(window: &Window<'_>, out: &mut [f32]) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => blur_with::<true>(window, out),
        "aarch64+neon" => blur_with::<true>(window, out),
        _ => blur_with::<false>(window, out),
    }
}

#[inline(always)]
fn blur_with<const FMA: bool>(window: &Window<'_>, out: &mut [f32]) {
    let n = out.len();
    let rows: Window<'_> = std::array::from_fn(|t| &window[t][..n]);
    for i in 0..n {
        let mut sum = 0.0;
        for t in 0..TAPS {
            sum = madd::<FMA>(WINDOW[t], rows[t][i], sum);
        }
        out[i] = sum;
    }
}

/// Blurs the product of two rows.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn blur_product(x: &Window<'_>, y: &Window<'_>, out: &mut [f32]) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => blur_product_with::<true>(x, y, out),
        "aarch64+neon" => blur_product_with::<true>(x, y, out),
        _ => blur_product_with::<false>(x, y, out),
    }
}

#[inline(always)]
fn blur_product_with<const FMA: bool>(x: &Window<'_>, y: &Window<'_>, out: &mut [f32]) {
    let n = out.len();
    let xs: Window<'_> = std::array::from_fn(|t| &x[t][..n]);
    let ys: Window<'_> = std::array::from_fn(|t| &y[t][..n]);
    for i in 0..n {
        let mut sum = 0.0;
        for t in 0..TAPS {
            sum = madd::<FMA>(WINDOW[t] * xs[t][i], ys[t][i], sum);
        }
        out[i] = sum;
    }
}

/// Blurred x, y, x^2, y^2, xy of a row become p, q, r of `gradient_row` and, in `yy`, SSIM itself.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn terms_in_place(
    x: &mut [f32],
    y: &mut [f32],
    xx: &mut [f32],
    yy: &mut [f32],
    xy: &mut [f32],
) {
    let n = x.len();
    let (y, xx, yy, xy) = (&mut y[..n], &mut xx[..n], &mut yy[..n], &mut xy[..n]);
    for i in 0..n {
        let (mu_x, mu_y) = (x[i], y[i]);
        let (mu_xx, mu_yy, mu_xy) = (mu_x * mu_x, mu_y * mu_y, mu_x * mu_y);
        let n1 = 2.0 * mu_xy + C1;
        let n2 = 2.0 * (xy[i] - mu_xy) + C2;
        let d1 = mu_xx + mu_yy + C1;
        let d2 = (xx[i] - mu_xx) + (yy[i] - mu_yy) + C2;
        let (inv_d1, inv_d2) = (1.0 / d1, 1.0 / d2);
        let inv = inv_d1 * inv_d2;
        let s = n1 * n2 * inv;
        let ds_dmu = 2.0 * (mu_y * n2 * inv - mu_x * s * inv_d1);
        let ds_dxx = -s * inv_d2;
        let ds_dxy = 2.0 * n1 * inv;
        x[i] = ds_dmu - 2.0 * mu_x * ds_dxx - mu_y * ds_dxy;
        y[i] = ds_dxx;
        xx[i] = ds_dxy;
        yy[i] = s;
    }
}

/// `weights[0] * pixel_weight * sign(x - y) + weights[1] * dSSIM/dx` of a row; the terms are weighted already.
#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn gradient_row(
    terms: &Terms<'_>,
    x: &[f32],
    y: &[f32],
    pixel_weights: &[f32],
    weights: [f32; 2],
    out: &mut [f32],
) {
    multiversion::target::match_target! {
        "x86_64+avx2+fma" => gradient_row_with::<true>(terms, x, y, pixel_weights, weights, out),
        "aarch64+neon" => gradient_row_with::<true>(terms, x, y, pixel_weights, weights, out),
        _ => gradient_row_with::<false>(terms, x, y, pixel_weights, weights, out),
    }
}

#[inline(always)]
fn gradient_row_with<const FMA: bool>(
    terms: &Terms<'_>,
    x: &[f32],
    y: &[f32],
    pixel_weights: &[f32],
    weights: [f32; 2],
    out: &mut [f32],
) {
    let n = out.len();
    let (x, y, pixel_weights) = (&x[..n], &y[..n], &pixel_weights[..n]);
    let p: Window<'_> = std::array::from_fn(|t| &terms.p[t][..n]);
    let q: Window<'_> = std::array::from_fn(|t| &terms.q[t][..n]);
    let r: Window<'_> = std::array::from_fn(|t| &terms.r[t][..n]);
    for i in 0..n {
        let (mut sum_p, mut sum_q, mut sum_r) = (0.0, 0.0, 0.0);
        for t in 0..TAPS {
            sum_p = madd::<FMA>(WINDOW[t], p[t][i], sum_p);
            sum_q = madd::<FMA>(WINDOW[t], q[t][i], sum_q);
            sum_r = madd::<FMA>(WINDOW[t], r[t][i], sum_r);
        }
        let difference = x[i] - y[i];
        let sign = f32::from(u8::from(difference > 0.0)) - f32::from(u8::from(difference < 0.0));
        let sign = pixel_weights[i] * sign;
        out[i] = weights[0] * sign + weights[1] * (sum_p + 2.0 * x[i] * sum_q + y[i] * sum_r);
    }
}
