//! A rendering and a photo of the same size -> SSIM, in f64.
//!
//! Colour is the stored sRGB value / 255, as everywhere in the engine. Renderings are clamped to 0..1 as a screen would.

use rayon::prelude::*;

use splat_types::image::RgbImage;

/// Gaussian window of Wang et al. 2004, section III.B: 11 taps, sigma 1.5.
const WINDOW_TAPS: usize = 11;
const WINDOW_SIGMA: f64 = 1.5;
/// (K1 L)² and (K2 L)² with K1 = 0.01, K2 = 0.03 and L = 1 (same paper).
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Mean structural similarity: over the windows that lie wholly inside the image, then over the channels.
/// An image with a side below 11 px gets the largest odd window that fits it.
pub fn ssim(rendered: &[f32], photo: &RgbImage) -> f64 {
    assert_eq!(
        rendered.len(),
        photo.pixels.len(),
        "a rendering is compared with a photo of its size"
    );
    let (width, height) = (photo.width_px as usize, photo.height_px as usize);
    let shorter = width.min(height);
    if shorter == 0 {
        return f64::NAN;
    }
    let window = gaussian_window(WINDOW_TAPS.min(shorter - (1 - shorter % 2)));
    let per_channel = (0..3).map(|channel| channel_ssim(rendered, photo, channel, &window));
    per_channel.sum::<f64>() / 3.0
}

fn channel_ssim(rendered: &[f32], photo: &RgbImage, channel: usize, window: &[f64]) -> f64 {
    let (width, height) = (photo.width_px as usize, photo.height_px as usize);
    let (n_cols, n_rows) = (width + 1 - window.len(), height + 1 - window.len());
    // Window sums along each row of x, y, x², y², xy; the sums along columns follow below.
    let across: Vec<[f64; 5]> = (0..height)
        .into_par_iter()
        .flat_map_iter(|row| {
            let pixels: Vec<[f64; 5]> = (row * width..(row + 1) * width)
                .map(|pixel_ix| {
                    let ix = 3 * pixel_ix + channel;
                    let (x, y) = (shown(rendered[ix]), f64::from(photo.pixels[ix]) / 255.0);
                    [x, y, x * x, y * y, x * y]
                })
                .collect();
            (0..n_cols).map(move |col| weighted(window, |tap| pixels[col + tap]))
        })
        .collect();
    let rows: Vec<f64> = (0..n_rows)
        .into_par_iter()
        .map(|row| {
            (0..n_cols)
                .map(|col| similarity(weighted(window, |tap| across[(row + tap) * n_cols + col])))
                .sum()
        })
        .collect();
    // Summed in order of rows, so that the value is the same with any number of threads.
    rows.iter().sum::<f64>() / (n_rows * n_cols) as f64
}

/// Wang et al. 2004, equation 13, from the window's means of x, y, x², y², xy.
fn similarity([x, y, xx, yy, xy]: [f64; 5]) -> f64 {
    let (variance_x, variance_y, covariance) = (xx - x * x, yy - y * y, xy - x * y);
    (2.0 * x * y + C1) * (2.0 * covariance + C2)
        / ((x * x + y * y + C1) * (variance_x + variance_y + C2))
}

fn weighted(window: &[f64], value: impl Fn(usize) -> [f64; 5]) -> [f64; 5] {
    let mut sum = [0.0; 5];
    for (tap, weight) in window.iter().enumerate() {
        for (sum, value) in sum.iter_mut().zip(value(tap)) {
            *sum += weight * value;
        }
    }
    sum
}

fn gaussian_window(n_taps: usize) -> Vec<f64> {
    let centre = (n_taps / 2) as f64;
    let weights: Vec<f64> = (0..n_taps)
        .map(|tap| (-0.5 * ((tap as f64 - centre) / WINDOW_SIGMA).powi(2)).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / total).collect()
}

fn shown(value: f32) -> f64 {
    f64::from(value.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both sides sum some thousand doubles in different order.
    const ROUNDING: f64 = 1e-12;

    /// A rendering and a photo that differ, without a generator: fractions of multiples of irrational numbers.
    fn pair(width_px: u32, height_px: u32) -> (Vec<f32>, RgbImage) {
        let n = (3 * width_px * height_px) as usize;
        let noise = |ix: usize, step: f64| (ix as f64 * step).fract();
        let rendered = (0..n)
            .map(|ix| (0.7 * noise(ix, 0.618_034) + 0.5 * noise(ix / 40, 0.414_214) - 0.1) as f32)
            .collect();
        let pixels = (0..n)
            .map(|ix| (255.0 * (0.35 * noise(ix, 0.618_034) + 0.65 * noise(ix, 0.732_051))) as u8)
            .collect();
        (
            rendered,
            RgbImage {
                width_px,
                height_px,
                pixels,
            },
        )
    }

    /// Straight from the definition: a two-dimensional window at each place, one loop per sum.
    fn naive_ssim(rendered: &[f32], photo: &RgbImage, taps: usize) -> f64 {
        let (width, height) = (photo.width_px as usize, photo.height_px as usize);
        let (mut total, mut n) = (0.0, 0.0);
        let weight = |a: usize, b: usize| {
            let (a, b) = (a as f64 - (taps / 2) as f64, b as f64 - (taps / 2) as f64);
            (-(a * a + b * b) / 4.5).exp()
        };
        let norm: f64 = (0..taps * taps)
            .map(|ix| weight(ix / taps, ix % taps))
            .sum();
        for channel in 0..3 {
            for top in 0..=height - taps {
                for left in 0..=width - taps {
                    let mean = |f: &dyn Fn(f64, f64) -> f64| {
                        let mut sum = 0.0;
                        for a in 0..taps {
                            for b in 0..taps {
                                let ix = 3 * ((top + a) * width + left + b) + channel;
                                let x = f64::from(rendered[ix]).clamp(0.0, 1.0);
                                sum +=
                                    weight(a, b) / norm * f(x, f64::from(photo.pixels[ix]) / 255.0);
                            }
                        }
                        sum
                    };
                    let (mx, my) = (mean(&|x, _| x), mean(&|_, y| y));
                    let vx = mean(&|x, _| (x - mx).powi(2));
                    let vy = mean(&|_, y| (y - my).powi(2));
                    let cov = mean(&|x, y| (x - mx) * (y - my));
                    total += (2.0 * mx * my + 1e-4) * (2.0 * cov + 9e-4)
                        / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4));
                    n += 1.0;
                }
            }
        }
        total / n
    }

    #[test]
    fn ssim_agrees_with_the_definition() {
        let (rendered, photo) = pair(23, 17);
        let value = ssim(&rendered, &photo);
        let expected = naive_ssim(&rendered, &photo, 11);
        assert!((value - expected).abs() < ROUNDING, "{value} {expected}");
        assert!(
            value > 0.1 && value < 0.95,
            "the pair must be a test: {value}"
        );
    }

    #[test]
    fn small_images_get_a_smaller_window() {
        for (width, height, taps) in [(8, 20, 7), (7, 9, 7), (11, 11, 11), (1, 30, 1), (2, 2, 1)] {
            let (rendered, photo) = pair(width, height);
            let (value, expected) = (ssim(&rendered, &photo), naive_ssim(&rendered, &photo, taps));
            assert!(
                (value - expected).abs() < ROUNDING,
                "{width}x{height}: {value} {expected}"
            );
        }
        assert!(
            ssim(
                &[],
                &RgbImage {
                    width_px: 0,
                    height_px: 4,
                    pixels: vec![]
                }
            )
            .is_nan()
        );
    }

    #[test]
    fn equal_images_have_ssim_one() {
        let (_, photo) = pair(16, 16);
        let same: Vec<f32> = photo.pixels.iter().map(|&p| f32::from(p) / 255.0).collect();
        assert!(
            (ssim(&same, &photo) - 1.0).abs() < 1e-6,
            "f32 against f64 of the same bytes"
        );
    }
}
