//! One view's loss and its gradient: what every backend can determine without an update, for tests and diagnosis.

use splat_types::rendering::Rendering;

/// One view's loss and its gradient. Arrays have the shape of those in [`Splats`](splat_types::splats::splats::Splats), with
/// respect to the numbers before activation; 0 where a splat is not visible. `docs/GRADIENTS.md`, sections 5 to 8. Many fields:
/// an array for each of `Splats`, and each number that a reference states.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    /// d loss / d mean, per world unit.
    pub means: Vec<[f32; 3]>,
    /// d loss / d log-scale.
    pub log_scales: Vec<[f32; 3]>,
    /// d loss / d quaternion w, x, y, z as stored, through its normalisation.
    pub quats: Vec<[f32; 4]>,
    /// d loss / d opacity logit.
    pub opacity_logits: Vec<f32>,
    /// d loss / d SH coefficient.
    pub sh: Vec<f32>,
    /// d loss / d (rho, theta) at 0 of `exp([rho; theta]) * cam_from_world`.
    pub pose: [f64; 6],
    /// d loss / d log gain and offset of r, g, b.
    pub exposure: [[f64; 3]; 2],
    /// d loss / d logarithm of the factor on all focal lengths.
    pub log_focal: f64,
    /// Photometric, depth and regularisers, weighted.
    pub loss: f64,
    /// Mean absolute difference of the colours, 0 to 1, weighted by the view's mask.
    pub l1: f64,
    /// Mean SSIM (Wang et al. 2004), 1 is best.
    pub ssim: f64,
    /// Depth loss before its weight.
    pub depth: f64,
    /// The image that the loss was taken of, without exposure.
    pub rendering: Rendering,
    /// Indices of the visible splats, ascending.
    pub visible: Vec<u32>,
}
