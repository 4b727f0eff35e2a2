//! The planes of a sweep, parallel to the reference image.

/// Planes evenly spaced in inverse depth; plane 0 is the far one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Planes {
    pub(crate) inverse_near: f64,
    pub(crate) inverse_far: f64,
    pub(crate) n: usize,
}

impl Planes {
    pub(crate) fn inverse_depth(&self, plane: f64) -> f64 {
        self.inverse_far + (self.inverse_near - self.inverse_far) * plane / (self.n - 1) as f64
    }

    /// Depth of a fractional plane number; negative = no plane = 0.
    pub(crate) fn depth(&self, plane: f32) -> f32 {
        if plane < 0.0 {
            0.0
        } else {
            (1.0 / self.inverse_depth(f64::from(plane))) as f32
        }
    }
}
