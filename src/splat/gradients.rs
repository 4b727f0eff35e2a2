//! One view's loss and its gradient: what every backend can tell without an update, for tests and diagnosis.

use crate::splat::Rendering;

/// Gradient of one view's loss, for tests and diagnosis. Arrays as in `Splats`, 0 where a splat is not visible.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    pub means: Vec<[f32; 3]>,
    pub log_scales: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub opacity_logits: Vec<f32>,
    pub sh: Vec<f32>,
    /// rho, theta of `exp([rho; theta]) * cam_from_map`.
    pub pose: [f64; 6],
    /// Log gain and offset of r, g, b.
    pub exposure: [[f64; 3]; 2],
    /// Logarithm of the factor on all focal lengths.
    pub log_focal: f64,
    /// Photometric, depth and regularisers, weighted.
    pub loss: f64,
    pub l1: f64,
    pub ssim: f64,
    /// Before its weight.
    pub depth: f64,
    pub rendering: Rendering,
    /// Indices of the visible splats, ascending.
    pub visible: Vec<u32>,
}
