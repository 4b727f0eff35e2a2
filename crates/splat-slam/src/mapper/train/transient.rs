//! What the map shows in a view, beside the view's image -> pixels of things that moved, which lose their weight.
//!
//! RobustNeRF (Sabour, Vora, Duckworth, Krasin, Fleet, Tagliasacchi 2023): what stands still is learnt from many views, so
//! large errors that hang together are of things that were there once. A single bad pixel is an edge or a highlight.

use std::sync::Arc;

use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

/// Mean error of r, g and b below which nothing has moved: where the map is right, the largest errors are edges that it blurs.
const MIN_ERROR: f32 = 0.1;
/// Fits of the exposure, and the share of pixels that the later ones take.
const N_FITS: usize = 3;
const FIT_SHARE: f32 = 0.8;
/// A stop up or down: beyond it is no exposure.
const MAX_GAIN: f64 = 2.0;
/// Half the width of the box that errors and votes are averaged over: 3 x 3 px.
const NEAR: usize = 1;
/// Half the width of the neighbourhood whose majority must agree: 17 x 17 px, as the patches of the paper.
const FAR: usize = 8;
/// Share of outliers among the pixels nearby, and in the neighbourhood, from which on a pixel is one (paper: 0.5, 0.6).
const NEAR_SHARE: f32 = 0.5;
const FAR_SHARE: f32 = 0.4;

/// Weights per pixel, 255 = all; `None`: every pixel counts. `share` of the pixels are taken to stand still.
pub(crate) fn mask(image: &RgbImage, rendering: &Rendering, share: f32) -> Option<Arc<[u8]>> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let n = width * height;
    if share >= 1.0 || n == 0 || rendering.rgb.len() != 3 * n {
        return None;
    }
    let errors = errors_under_best_exposure(image, rendering);
    let errors = box_mean(&errors, width, height, NEAR);
    let mut sorted = errors.clone();
    let rank = ((n as f32 * share) as usize).min(n - 1);
    let (_, bound, _) = sorted.select_nth_unstable_by(rank, f32::total_cmp);
    let bound = bound.max(MIN_ERROR);
    let is_far_off: Vec<f32> = errors
        .iter()
        .map(|e| if *e > bound { 1.0 } else { 0.0 })
        .collect();
    let near = box_mean(&is_far_off, width, height, NEAR);
    let far = box_mean(&is_far_off, width, height, FAR);
    let is_transient =
        |p: usize| is_far_off[p] > 0.0 && near[p] >= NEAR_SHARE && far[p] >= FAR_SHARE;
    let mask: Arc<[u8]> = (0..n)
        .map(|p| if is_transient(p) { 0 } else { u8::MAX })
        .collect();
    mask.contains(&0).then_some(mask)
}

/// Mean absolute error of r, g and b per pixel, where the rendering has the gain and offset per channel that fit the image best: a camera that
/// exposes anew changes every pixel, and nothing has moved. Least squares, then once more without the pixels that were off most.
fn errors_under_best_exposure(image: &RgbImage, rendering: &Rendering) -> Vec<f32> {
    let n = image.pixels.len() / 3;
    let mut is_used = vec![true; n];
    let mut errors = vec![0.0_f32; n];
    for _ in 0..N_FITS {
        errors.fill(0.0);
        for channel in 0..3 {
            let pairs = || {
                let wanted = image.pixels.iter().skip(channel).step_by(3);
                let found = rendering.rgb.iter().skip(channel).step_by(3);
                wanted.zip(found).map(|(w, f)| (f32::from(*w) / 255.0, *f))
            };
            let used = pairs().zip(&is_used).filter(|(_, is_used)| **is_used);
            let (gain, offset) = line_through(used.map(|(pair, _)| pair));
            for (error, (wanted, found)) in errors.iter_mut().zip(pairs()) {
                *error += (wanted - (gain * found + offset)).abs() / 3.0;
            }
        }
        let mut sorted = errors.clone();
        let rank = ((n as f32 * FIT_SHARE) as usize).min(n - 1);
        let (_, bound, _) = sorted.select_nth_unstable_by(rank, f32::total_cmp);
        let bound = *bound;
        for (is_used, error) in is_used.iter_mut().zip(&errors) {
            *is_used = *error <= bound;
        }
    }
    errors
}

/// Gain and offset that take the second numbers to the first, by least squares; none where they do not differ enough to say.
fn line_through(pairs: impl Iterator<Item = (f32, f32)>) -> (f32, f32) {
    let [mut n, mut x, mut y, mut xx, mut xy] = [0.0_f64; 5];
    for (wanted, found) in pairs {
        let (wanted, found) = (f64::from(wanted), f64::from(found));
        n += 1.0;
        x += found;
        y += wanted;
        xx += found * found;
        xy += found * wanted;
    }
    let spread = xx - x * x / n;
    if spread.is_nan() || spread < 1e-4 * n {
        return (1.0, 0.0);
    }
    let gain = ((xy - x * y / n) / spread).clamp(1.0 / MAX_GAIN, MAX_GAIN);
    (gain as f32, ((y - gain * x) / n) as f32)
}

/// Mean over a square of `2 * half + 1` pixels, of what lies in the image.
fn box_mean(values: &[f32], width: usize, height: usize, half: usize) -> Vec<f32> {
    let along = |n: usize, at: &dyn Fn(usize) -> f32, out: &mut dyn FnMut(usize, f32)| {
        let mut sum: f64 = (0..half.min(n)).map(|k| f64::from(at(k))).sum();
        for k in 0..n {
            if k + half < n {
                sum += f64::from(at(k + half));
            }
            if k > half {
                sum -= f64::from(at(k - half - 1));
            }
            let count = (k + half).min(n - 1) - k.saturating_sub(half) + 1;
            out(k, (sum / count as f64) as f32);
        }
    };
    let mut rows = vec![0.0; values.len()];
    for y in 0..height {
        along(width, &|x| values[y * width + x], &mut |x, v| {
            rows[y * width + x] = v;
        });
    }
    let mut all = vec![0.0; values.len()];
    for x in 0..width {
        along(height, &|y| rows[y * width + x], &mut |y, v| {
            all[y * width + x] = v;
        });
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 64;

    /// A grey image; the map shows it with an error where `off` says so.
    fn weights(off: impl Fn(usize, usize) -> bool, share: f32) -> Option<Arc<[u8]>> {
        let n = SIDE * SIDE;
        let image = RgbImage {
            width_px: SIDE as u32,
            height_px: SIDE as u32,
            pixels: vec![128; 3 * n],
        };
        let shown = |p: usize| {
            let noise = 0.01 * (p as f32 * 0.7).sin();
            let error = if off(p % SIDE, p / SIDE) { 0.4 } else { 0.0 };
            128.0 / 255.0 + noise + error
        };
        let rendering = Rendering {
            width_px: SIDE as u32,
            height_px: SIDE as u32,
            rgb: (0..3 * n).map(|v| shown(v / 3)).collect(),
            alpha: vec![1.0; n],
            depth: vec![1.0; n],
        };
        mask(&image, &rendering, share)
    }

    #[test]
    fn what_moved_loses_its_weight_and_lone_errors_keep_it() {
        let in_square = |x: usize, y: usize| (20..40).contains(&x) && (10..30).contains(&y);
        let lone = |x: usize, y: usize| x % 13 == 5 && y % 13 == 5;
        let found = weights(|x, y| in_square(x, y) || lone(x, y), 0.8).unwrap();
        assert_eq!(found[20 * SIDE + 30], 0, "middle of the square");
        assert_eq!(found[57 * SIDE + 57], 255, "a lone pixel");
        let n_off = found.iter().filter(|w| **w == 0).count();
        assert!(
            (300..520).contains(&n_off),
            "{n_off} of the square's 400 pixels"
        );
    }

    #[test]
    fn without_a_share_of_doubt_every_pixel_counts() {
        assert!(weights(|x, _| x < 30, 1.0).is_none());
        assert!(weights(|_, _| false, 0.95).is_none(), "noise is no thing");
    }

    /// Of an image with light and dark parts, taken darker than it is drawn, with a bright square in it or without.
    fn weights_of_a_darker_image(has_square: bool) -> Option<Arc<[u8]>> {
        let n = SIDE * SIDE;
        let shade = |p: usize| 0.2 + 0.6 * ((p % SIDE) as f32 / SIDE as f32);
        let is_square = |p: usize| (20..40).contains(&(p % SIDE)) && (10..30).contains(&(p / SIDE));
        let image = RgbImage {
            width_px: SIDE as u32,
            height_px: SIDE as u32,
            pixels: (0..n)
                .flat_map(|p| {
                    let dark = (255.0 * (0.6 * shade(p) + 0.02)).round() as u8;
                    [if has_square && is_square(p) {
                        250
                    } else {
                        dark
                    }; 3]
                })
                .collect(),
        };
        let rendering = Rendering {
            width_px: SIDE as u32,
            height_px: SIDE as u32,
            rgb: (0..n).flat_map(|p| [shade(p); 3]).collect(),
            alpha: vec![1.0; n],
            depth: vec![1.0; n],
        };
        mask(&image, &rendering, 0.8)
    }

    #[test]
    fn an_image_taken_darker_has_not_moved() {
        assert!(weights_of_a_darker_image(false).is_none());
        let found = weights_of_a_darker_image(true).unwrap();
        assert_eq!(found[20 * SIDE + 30], 0, "the square moved");
        let n_off = found.iter().filter(|w| **w == 0).count();
        assert!((300..520).contains(&n_off), "{n_off}");
    }
}
