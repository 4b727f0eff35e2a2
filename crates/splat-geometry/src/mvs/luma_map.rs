//! Luma of a source image by luma of the reference image.

/// `luma of the source = gain * luma of the reference + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LumaFit {
    pub(crate) gain: f32,
    pub(crate) offset: f32,
}

impl LumaFit {
    pub(crate) const SAME: Self = Self {
        gain: 1.0,
        offset: 0.0,
    };

    pub(crate) fn of_source(self, luma: f32) -> f32 {
        self.gain * luma + self.offset
    }
}
