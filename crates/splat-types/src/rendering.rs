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
}
