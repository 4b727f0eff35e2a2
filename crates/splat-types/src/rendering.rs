//! What rendering the map from one camera gives.

use crate::image::RgbImage;

/// A rendered view, row by row. `depth` is the expected depth of what was hit, 0 where alpha is 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    pub width_px: u32,
    pub height_px: u32,
    /// r g b per pixel, linear in the stored colour, not clamped above.
    pub rgb: Vec<f32>,
    pub alpha: Vec<f32>,
    pub depth: Vec<f32>,
}

impl Rendering {
    /// Colours as a screen shows them: clamped, rounded to 8 bits.
    pub fn to_rgb(&self) -> RgbImage {
        let shown = |value: &f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
        RgbImage {
            width_px: self.width_px,
            height_px: self.height_px,
            pixels: self.rgb.iter().map(shown).collect(),
        }
    }

    /// Peak signal-to-noise ratio in dB over all pixels and channels, colours clamped and not rounded; infinite for equal
    /// images, NaN where a colour is. Panics unless the photo has the rendering's size.
    pub fn psnr(&self, photo: &RgbImage) -> f64 {
        assert_eq!(
            (self.rgb.len(), self.width_px),
            (photo.pixels.len(), photo.width_px),
            "a rendering is compared with a photo of its size"
        );
        let shown = self.rgb.iter().map(|&v| f64::from(v).clamp(0.0, 1.0));
        let wanted = photo.pixels.iter().map(|&v| f64::from(v) / 255.0);
        let squares = shown.zip(wanted).map(|(a, b)| (a - b).powi(2));
        let mean_square = squares.sum::<f64>() / self.rgb.len() as f64;
        -10.0 * mean_square.log10()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn psnr(rgb: &[f32], pixels: &[u8]) -> f64 {
        let (width_px, height_px) = (rgb.len() as u32 / 3, 1);
        let rendering = Rendering {
            width_px,
            height_px,
            rgb: rgb.to_vec(),
            alpha: Vec::new(),
            depth: Vec::new(),
        };
        rendering.psnr(&RgbImage {
            width_px,
            height_px,
            pixels: pixels.to_vec(),
        })
    }

    #[test]
    fn psnr_of_a_known_error_is_as_by_hand() {
        let photo = [0, 51, 102, 153, 204, 255];
        let off_by_a_tenth = psnr(&[0.1, 0.3, 0.3, 0.7, 0.7, 0.9], &photo);
        assert!((off_by_a_tenth - 20.0).abs() < 1e-5, "f32 inputs");
        let one_wrong = psnr(&[1.0, 0.2, 0.4, 0.6, 0.8, 1.0], &photo);
        assert!((one_wrong - 10.0 * 6_f64.log10()).abs() < 1e-5);
    }

    #[test]
    fn values_outside_the_screen_count_as_clamped() {
        assert_eq!(psnr(&[-3.0, 7.0, 1.0], &[0, 255, 255]), f64::INFINITY);
        let broken = psnr(&[f32::NAN, 1.0, 1.0], &[0, 255, 255]);
        assert!(broken.is_nan(), "a broken rendering must not look good");
    }
}
