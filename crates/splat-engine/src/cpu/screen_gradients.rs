//! screen gradients: d loss / d projected mean of the visible splats -> sums over steps, for densification.
//!
//! Empty, and so without cost, until the first step asks for it.

use crate::cpu::project::Projected;
use crate::cpu::project_backward::SplatGradients;
use crate::densify::ScreenGradients;
use splat_types::splats::rows::retain_rows;

impl ScreenGradients {
    /// Splats behind those that were there have none. Nothing is kept before anything was added.
    pub(crate) fn resize(&mut self, n: usize) {
        if !self.counts.is_empty() {
            self.sums.resize(n, 0.0);
            self.counts.resize(n, 0);
        }
    }

    pub(crate) fn retain(&mut self, keep: &[bool]) {
        if !self.counts.is_empty() {
            retain_rows(&mut self.sums, 1, keep);
            retain_rows(&mut self.counts, 1, keep);
        }
    }

    pub(crate) fn clear(&mut self, splat_ix: usize) {
        if !self.counts.is_empty() {
            (self.sums[splat_ix], self.counts[splat_ix]) = (0.0, 0);
        }
    }

    pub(crate) fn held_bytes(&self) -> usize {
        4 * (self.sums.capacity() + self.counts.capacity())
    }

    /// Of the `n_splats` that there are, adds what one step saw in an image of this size. Gradients that are not finite count as
    /// if they had not been seen.
    pub(crate) fn add(
        &mut self,
        n_splats: usize,
        seen: &Projected,
        gradients: &SplatGradients,
        [width_px, height_px]: [u32; 2],
    ) {
        self.sums.resize(n_splats, 0.0);
        self.counts.resize(n_splats, 0);
        let [half_width, half_height] = [width_px, height_px].map(|px| 0.5 * px as f32);
        for (v, splat) in seen.splats.iter().enumerate() {
            let [x, y] = gradients.centers[v];
            let norm = (x * half_width).hypot(y * half_height);
            if gradients.is_finite[v] && norm.is_finite() {
                self.sums[splat.splat_ix as usize] += norm;
                self.counts[splat.splat_ix as usize] += 1;
            }
        }
    }
}
