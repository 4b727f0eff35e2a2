//! What the map shows in a view, beside the view's image -> pixels of things that moved, which lose their weight.
//!
//! RobustNeRF (Sabour, Vora, Duckworth, Krasin, Fleet, Tagliasacchi 2023): what stands still is learnt from many views, so
//! large errors that hang together are of things that were there once. A single bad pixel is an edge or a highlight.

use std::sync::Arc;

use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

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
    let errors: Vec<f32> = image
        .pixels
        .chunks_exact(3)
        .zip(rendering.rgb.chunks_exact(3))
        .map(|(wanted, found)| {
            let parts = wanted.iter().zip(found);
            parts
                .map(|(w, f)| (f32::from(*w) / 255.0 - f).abs())
                .sum::<f32>()
                / 3.0
        })
        .collect();
    let errors = box_mean(&errors, width, height, NEAR);
    let mut sorted = errors.clone();
    let rank = ((n as f32 * share) as usize).min(n - 1);
    let (_, bound, _) = sorted.select_nth_unstable_by(rank, f32::total_cmp);
    let bound = *bound;
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
}
