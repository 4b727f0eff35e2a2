//! A rendering and a photo of the same size -> how alike their right halves are, as rendered and with the exposure that
//! fits the left halves best.
//!
//! A held-out view has no exposure of its own, since nothing was optimised on it: where cameras change theirs, its rendering
//! is compared with a photo of other brightness. NeRF-W (Martin-Brualla et al. 2021, section 4.1) fits such views on one half
//! and measures on the other.

use crate::eval::image_metrics;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;

/// Twentyfold, and the whole range of colour: what the optimiser lets exposures of views be.
const MAX_LOG_GAIN: f64 = 3.0;
const MAX_OFFSET: f64 = 1.0;
/// Colours that spread by less than half an 8-bit level say nothing of a gain.
const MIN_VARIANCE: f64 = (0.5 / 255.0) * (0.5 / 255.0);

/// A rendered colour c is shown as `gain c + offset`, for r, g, b: what the optimiser learns for a view (`train.lr_exposure`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposure {
    pub gain: [f64; 3],
    pub offset: [f64; 3],
}

/// Of the right half of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HalfScores {
    pub psnr: f64,
    pub ssim: f64,
    /// With the exposure of the left half.
    pub psnr_exposed: f64,
    pub ssim_exposed: f64,
}

impl Exposure {
    pub const IDENTITY: Self = Self {
        gain: [1.0; 3],
        offset: [0.0; 3],
    };

    pub fn apply(&self, rendering: &mut Rendering) {
        for rgb in rendering.rgb.as_chunks_mut::<3>().0 {
            for (channel, value) in rgb.iter_mut().enumerate() {
                let exposed = self.gain[channel] * f64::from(*value) + self.offset[channel];
                *value = exposed as f32;
            }
        }
    }
}

/// Panics unless the photo has the rendering's size.
pub fn half_scores(rendering: &Rendering, photo: &RgbImage) -> HalfScores {
    assert_eq!(
        (rendering.width_px, rendering.height_px),
        (photo.width_px, photo.height_px),
        "a rendering is compared with a photo of its size"
    );
    let middle = photo.width_px / 2;
    let exposure = fit(
        &columns(&rendering.rgb, photo.width_px, [0, middle]),
        &columns(&photo.pixels, photo.width_px, [0, middle]),
    );
    let right = [middle, photo.width_px];
    let photo = RgbImage {
        width_px: photo.width_px - middle,
        height_px: photo.height_px,
        pixels: columns(&photo.pixels, photo.width_px, right),
    };
    let mut shown = Rendering {
        width_px: photo.width_px,
        height_px: photo.height_px,
        rgb: columns(&rendering.rgb, rendering.width_px, right),
        alpha: Vec::new(),
        depth: Vec::new(),
    };
    let (psnr, ssim) = (shown.psnr(&photo), image_metrics::ssim(&shown.rgb, &photo));
    exposure.apply(&mut shown);
    HalfScores {
        psnr,
        ssim,
        psnr_exposed: shown.psnr(&photo),
        ssim_exposed: image_metrics::ssim(&shown.rgb, &photo),
    }
}

/// Least squares, channel by channel; the identity where that is nearer, or where the colours do not say.
pub fn fit(rendered: &[f32], photo: &[u8]) -> Exposure {
    assert_eq!(rendered.len(), photo.len(), "one colour for each");
    let mut exposure = Exposure::IDENTITY;
    for channel in 0..3 {
        let rendered = rendered.iter().skip(channel).step_by(3);
        let pairs: Vec<[f64; 2]> = rendered
            .zip(photo.iter().skip(channel).step_by(3))
            .map(|(&shown, &wanted)| [f64::from(shown), f64::from(wanted) / 255.0])
            .collect();
        if let Some([gain, offset]) = fit_channel(&pairs) {
            (exposure.gain[channel], exposure.offset[channel]) = (gain, offset);
        }
    }
    exposure
}

/// Gain and offset that take the first of each pair to the second; `None`: none is better than the identity.
fn fit_channel(pairs: &[[f64; 2]]) -> Option<[f64; 2]> {
    let mean = |value: &dyn Fn(&[f64; 2]) -> f64| {
        pairs.iter().map(value).sum::<f64>() / pairs.len() as f64
    };
    let (shown, wanted) = (mean(&|pair| pair[0]), mean(&|pair| pair[1]));
    let variance = mean(&|pair| (pair[0] - shown).powi(2));
    let covariance = mean(&|pair| (pair[0] - shown) * (pair[1] - wanted));
    let gain = covariance / variance;
    let offset = wanted - gain * shown;
    // No half, or one that is not a number, has no variance above the least.
    let is_known = variance > MIN_VARIANCE
        && gain > 0.0
        && gain.ln().abs() <= MAX_LOG_GAIN
        && offset.abs() <= MAX_OFFSET;
    if !is_known {
        return None;
    }
    // Squares are least for colours that no screen clamps.
    let error = |[gain, offset]: [f64; 2]| {
        mean(&|pair| ((gain * pair[0] + offset).clamp(0.0, 1.0) - pair[1]).powi(2))
    };
    (error([gain, offset]) < error([1.0, 0.0])).then_some([gain, offset])
}

/// Pixels of the columns from the first up to the second.
fn columns<T: Copy>(pixels: &[T], width_px: u32, [from, to]: [u32; 2]) -> Vec<T> {
    let (from, to) = (3 * from as usize, 3 * to as usize);
    let rows = pixels.chunks_exact(3 * width_px.max(1) as usize);
    rows.flat_map(|row| &row[from..to]).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of colours in f32.
    const TOLERANCE: f64 = 1e-5;

    fn noise(ix: usize, step: f64) -> f64 {
        (ix as f64 * step).fract()
    }

    /// A photo, and the rendering that this exposure turns into it exactly.
    fn exposed_pair(exposure: &Exposure, [width_px, height_px]: [u32; 2]) -> (Rendering, RgbImage) {
        let n = 3 * (width_px * height_px) as usize;
        let photo = RgbImage {
            width_px,
            height_px,
            pixels: (0..n)
                .map(|ix| (40.0 + 180.0 * noise(ix, 0.618_034)) as u8)
                .collect(),
        };
        let unexposed = |(ix, &wanted): (usize, &u8)| {
            let wanted = f64::from(wanted) / 255.0;
            ((wanted - exposure.offset[ix % 3]) / exposure.gain[ix % 3]) as f32
        };
        let rendering = Rendering {
            width_px,
            height_px,
            rgb: photo.pixels.iter().enumerate().map(unexposed).collect(),
            alpha: Vec::new(),
            depth: Vec::new(),
        };
        (rendering, photo)
    }

    fn mean_square(exposure: &Exposure, rendered: &[f32], photo: &[u8]) -> f64 {
        let squares = rendered.iter().zip(photo).enumerate().map(|(ix, (c, p))| {
            let shown = exposure.gain[ix % 3] * f64::from(*c) + exposure.offset[ix % 3];
            (shown.clamp(0.0, 1.0) - f64::from(*p) / 255.0).powi(2)
        });
        squares.sum::<f64>() / rendered.len() as f64
    }

    #[test]
    fn a_known_exposure_is_found_and_makes_the_other_half_exact() {
        let exposures = [
            ([1.0, 1.0, 1.0], [0.0, 0.0, 0.0]),
            ([0.6, 0.7, 1.3], [0.02, -0.05, 0.01]),
            ([2.5, 1.9, 0.4], [-0.2, 0.03, 0.15]),
        ];
        for (gain, offset) in exposures {
            let exact = Exposure { gain, offset };
            let (rendering, photo) = exposed_pair(&exact, [41, 17]);
            let found = fit(&rendering.rgb, &photo.pixels);
            for channel in 0..3 {
                let (gain, offset) = (found.gain[channel], found.offset[channel]);
                assert!(
                    (gain - exact.gain[channel]).abs() < TOLERANCE
                        && (offset - exact.offset[channel]).abs() < TOLERANCE,
                    "{found:?} instead of {exact:?}"
                );
            }
            let scores = half_scores(&rendering, &photo);
            assert!(
                scores.psnr_exposed > 100.0 && scores.ssim_exposed > 0.999_999,
                "{scores:?}"
            );
            if exact != Exposure::IDENTITY {
                assert!(scores.psnr < 30.0 && scores.ssim < 0.999, "{scores:?}");
            }
        }
    }

    #[test]
    fn only_the_left_half_is_fitted_and_only_the_right_half_measured() {
        let dark = Exposure {
            gain: [0.5; 3],
            offset: [0.0; 3],
        };
        let (mut rendering, photo) = exposed_pair(&dark, [40, 12]);
        // The right half is right as it is: the exposure of the left one harms it.
        for (ix, value) in rendering.rgb.iter_mut().enumerate() {
            if (ix / 3) % 40 >= 20 {
                *value = f32::from(photo.pixels[ix]) / 255.0;
            }
        }
        let scores = half_scores(&rendering, &photo);
        assert!(
            scores.psnr > 100.0 && scores.psnr_exposed < 20.0,
            "{scores:?}"
        );
    }

    #[test]
    fn the_fitted_half_never_gets_worse() {
        for seed in 0..60 {
            let step = 0.1 + 0.137 * f64::from(seed);
            let n = 3 * 24;
            // Some are clamped, some have nothing to do with the photo, some are its negative.
            let mix = f64::from(seed % 5) / 2.0 - 1.0;
            let photo: Vec<u8> = (0..n).map(|ix| (255.0 * noise(ix, step)) as u8).collect();
            let rendered: Vec<f32> = (0..n)
                .map(|ix| (mix * noise(ix, step) + 1.6 * noise(ix, 0.414_214) - 0.3) as f32)
                .collect();
            let found = fit(&rendered, &photo);
            let (fitted, plain) = (
                mean_square(&found, &rendered, &photo),
                mean_square(&Exposure::IDENTITY, &rendered, &photo),
            );
            assert!(fitted <= plain, "{seed}: {fitted} above {plain}");
        }
    }

    #[test]
    fn what_says_nothing_of_the_exposure_leaves_the_identity() {
        let photo: Vec<u8> = (0..300)
            .map(|ix| (255.0 * noise(ix, 0.618_034)) as u8)
            .collect();
        let check = |rendered: &[f32], why: &str| {
            let photo = &photo[..rendered.len()];
            assert_eq!(fit(rendered, photo), Exposure::IDENTITY, "{why}");
        };
        check(&[0.4; 300], "flat");
        check(&[f32::NAN; 300], "no number");
        check(&[], "empty");
        let negative: Vec<f32> = photo.iter().map(|p| 1.0 - f32::from(*p) / 255.0).collect();
        check(&negative, "a gain below 0");
        let faint: Vec<f32> = photo.iter().map(|p| f32::from(*p) / 255.0 / 25.0).collect();
        check(&faint, "a gain beyond the bound");
        // One column has no left half.
        let (rendering, photo) = exposed_pair(&Exposure::IDENTITY, [1, 9]);
        let scores = half_scores(&rendering, &photo);
        assert_eq!(scores.psnr, scores.psnr_exposed);
    }
}
