//! What rendering the map from one camera gives.

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
