//! Gradients of the pixels -> gradients of the 2D Gaussians. docs/GRADIENTS.md 6.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::loss::Loss;
use super::project::Projected;
use super::raster::{Raster, pixel_centre, transmittance_behind};

#[derive(Debug, Clone, Copy, Default)]
pub struct ProjectedGradient {
    pub centre_px: Vector2<f64>,
    /// Symmetric: the derivative with respect to an off-diagonal pair is spread over both.
    pub conic: Matrix2<f64>,
    pub opacity: f64,
    pub colour: Vector3<f64>,
    /// Through the depth channel only.
    pub z: f64,
}

/// One per `projected`, in its order.
pub fn raster_backward(
    projected: &[Projected],
    raster: &Raster,
    loss: &Loss,
) -> Vec<ProjectedGradient> {
    let mut gradients = vec![ProjectedGradient::default(); projected.len()];
    for (pixel, hits) in raster.hits.iter().enumerate() {
        let v_rgb = Vector3::from_column_slice(&loss.v_rgb[3 * pixel..3 * pixel + 3]);
        let v_depth_sum = loss.v_depth_sum[pixel];
        // How much the loss gains from one unit of light of this splat.
        let worth = |ix: usize| {
            projected[ix].colour.dot(&v_rgb) + projected[ix].mean_in_cam.z * v_depth_sum
        };
        let centre = pixel_centre(pixel % raster.width_px, pixel / raster.width_px);

        // alpha = 1 - T_end, so what reaches the end counts -v_alpha.
        let mut worth_behind = -transmittance_behind(hits) * loss.v_alpha[pixel];
        for hit in hits.iter().rev() {
            let splat = &projected[hit.ix];
            let gradient = &mut gradients[hit.ix];
            let weight = hit.alpha * hit.transmittance;
            gradient.colour += weight * v_rgb;
            gradient.z += weight * v_depth_sum;

            // More alpha adds this splat's light and dims all behind it.
            let v_alpha = hit.transmittance * worth(hit.ix) - worth_behind / (1.0 - hit.alpha);
            worth_behind += weight * worth(hit.ix);
            if hit.is_saturated {
                continue;
            }
            let offset = splat.centre_px - centre;
            // alpha = o exp(-sigma), sigma = offset' conic offset / 2.
            let v_sigma = -hit.alpha * v_alpha;
            gradient.opacity += hit.alpha / splat.opacity * v_alpha;
            gradient.conic += 0.5 * v_sigma * offset * offset.transpose();
            gradient.centre_px += v_sigma * splat.conic * offset;
        }
    }
    gradients
}
