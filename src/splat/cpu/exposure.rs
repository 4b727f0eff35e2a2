//! exposure: gradient of a view's gain and offset -> their values after one update.
//!
//! Only the loss knows them: a rendered colour c is compared as `exp(gain) c + offset`. Brighter splats and darker
//! views look the same, so a pull towards 0 keeps the views' mean where it is. Equations: docs/GRADIENTS.md, exposure.

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
/// As for poses: a view that sees next to nothing shall not run away on noise.
const EPS: f64 = 1e-8;
/// Share of itself, times the rate, that each number loses in an update. Apart from the moments (Loshchilov, Hutter
/// 2019), so that it does not depend on the scale of the loss: a gain of 0.1 comes to rest where its mean gradient is
/// 1 % of its RMS, which biases nothing, while along the common gain the mean gradient is 0 and the pull wins.
const PULL: f64 = 0.1;
/// Twentyfold, and the whole range of colour: beyond is no exposure but a broken picture.
const MAX_ABS: [f64; 2] = [3.0, 1.0];

/// Log gain of r, g, b, then their offsets.
pub(crate) type Exposure = [[f32; 3]; 2];

/// Adam's state of one view.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct ExposureAdam {
    first: [[f64; 3]; 2],
    second: [[f64; 3]; 2],
    age: u32,
}

impl ExposureAdam {
    /// `None`: the gradient is not finite.
    pub(crate) fn update(
        &mut self,
        exposure: Exposure,
        gradient: [[f64; 3]; 2],
        rate: f32,
    ) -> Option<Exposure> {
        if !gradient.as_flattened().iter().all(|g| g.is_finite()) {
            return None;
        }
        self.age = self.age.saturating_add(1);
        let unbias = [BETA_1, BETA_2].map(|beta| 1.0 - beta.powf(f64::from(self.age)));
        let mut moved = exposure;
        for (kind, max_abs) in MAX_ABS.into_iter().enumerate() {
            for channel in 0..3 {
                let g = gradient[kind][channel];
                let (m, v) = (
                    &mut self.first[kind][channel],
                    &mut self.second[kind][channel],
                );
                *m = BETA_1 * *m + (1.0 - BETA_1) * g;
                *v = BETA_2 * *v + (1.0 - BETA_2) * g * g;
                let direction = *m / unbias[0] / ((*v / unbias[1]).sqrt() + EPS);
                let value = f64::from(exposure[kind][channel]);
                let value = value - f64::from(rate) * (direction + PULL * value);
                moved[kind][channel] = value.max(-max_abs).min(max_abs) as f32;
            }
        }
        Some(moved)
    }
}
