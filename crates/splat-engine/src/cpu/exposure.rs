//! exposure: gradient of a view's gain and offset -> their values after one update.
//!
//! Only the loss knows them: a rendered colour c is compared as `exp(gain) c + offset`. Brighter splats and darker
//! views look the same, so a pull towards 0 keeps the views' mean where it is. Equations: docs/GRADIENTS.md, exposure.

use crate::cpu::pose_adam::FewAdam;

/// Share of itself, times the rate, that each number loses in an update. Apart from the moments (Loshchilov, Hutter
/// 2019), so that it does not depend on the scale of the loss: a gain of 0.1 comes to rest where its mean gradient is
/// 1 % of its RMS, which biases nothing, while along the common gain the mean gradient is 0 and the pull wins.
const PULL: f64 = 0.1;
/// Twentyfold, and the whole range of colour: beyond is no exposure but a broken image.
const MAX_ABS: [f64; 2] = [3.0, 1.0];

/// Log gain of r, g, b, then their offsets.
pub(crate) type Exposure = [[f32; 3]; 2];

/// Adam's state of one view.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct ExposureAdam(FewAdam<6>);

impl ExposureAdam {
    /// `None`: the gradient is not finite.
    pub(crate) fn update(
        &mut self,
        exposure: Exposure,
        gradient: [[f64; 3]; 2],
        rate: f32,
    ) -> Option<Exposure> {
        let gradient = std::array::from_fn(|i| gradient[i / 3][i % 3]);
        let direction = self.0.direction(gradient)?;
        let mut moved = exposure;
        for (i, value) in moved.as_flattened_mut().iter_mut().enumerate() {
            let max_abs = MAX_ABS[i / 3];
            let old = f64::from(*value);
            let new = old - f64::from(rate) * (PULL * old - direction[i]);
            *value = new.max(-max_abs).min(max_abs) as f32;
        }
        Some(moved)
    }
}
