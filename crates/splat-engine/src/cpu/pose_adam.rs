//! pose_adam: gradient of a view's pose -> the pose after one update.
//!
//! Knows nothing of images. The delta is left-multiplied: `exp([rho; theta]) * cam_from_world`.

use glam::DVec3;

use splat_types::transform::Rigid;

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
/// Larger than for splats: a view that sees next to nothing shall not run away on noise.
const EPS: f64 = 1e-8;

/// Adam's state of a few numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FewAdam<const N: usize> {
    first: [f64; N],
    second: [f64; N],
    age: u32,
}

/// Adam's state of one view, in the tangent space at its pose.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct PoseAdam(FewAdam<6>);

impl<const N: usize> Default for FewAdam<N> {
    fn default() -> Self {
        Self {
            first: [0.0; N],
            second: [0.0; N],
            age: 0,
        }
    }
}

impl<const N: usize> FewAdam<N> {
    /// The change for a rate of 1. `None`: the gradient is not finite, the state stays.
    pub(crate) fn direction(&mut self, gradient: [f64; N]) -> Option<[f64; N]> {
        if !gradient.iter().all(|g| g.is_finite()) {
            return None;
        }
        self.age = self.age.saturating_add(1);
        let unbias = [
            1.0 - BETA_1.powf(f64::from(self.age)),
            1.0 - BETA_2.powf(f64::from(self.age)),
        ];
        Some(std::array::from_fn(|i| {
            let g = gradient[i];
            self.first[i] = BETA_1 * self.first[i] + (1.0 - BETA_1) * g;
            self.second[i] = BETA_2 * self.second[i] + (1.0 - BETA_2) * g * g;
            -self.first[i] / unbias[0] / ((self.second[i] / unbias[1]).sqrt() + EPS)
        }))
    }
}

impl PoseAdam {
    /// `gradient` is (rho, theta), `rates` those of translation and rotation. `None`: the gradient is not finite.
    pub(crate) fn update(
        &mut self,
        pose: &Rigid,
        gradient: [f64; 6],
        rates: [f32; 2],
    ) -> Option<Rigid> {
        let direction = self.0.direction(gradient)?;
        let delta: [f64; 6] = std::array::from_fn(|i| f64::from(rates[i / 3]) * direction[i]);
        let [rho_x, rho_y, rho_z, theta_x, theta_y, theta_z] = delta;
        let step = Rigid::exp(
            DVec3::new(rho_x, rho_y, rho_z),
            DVec3::new(theta_x, theta_y, theta_z),
        );
        Some((step * *pose).renormalized())
    }
}
