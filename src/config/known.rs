//! Parameters of the noise on known poses and depth, `known.*`.

use serde::Deserialize;

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownParams {
    pub rotation_noise_deg: f64,
    pub translation_noise: f64,
    pub translation_noise_extent: f64,
    pub drift_deg: f64,
    pub drift_extent: f64,
    pub offset_deg: f64,
    pub offset_extent: f64,
    pub depth_noise: f64,
    pub windows: bool,
    pub window_scale: f64,
    pub depth_outliers: f64,
}
