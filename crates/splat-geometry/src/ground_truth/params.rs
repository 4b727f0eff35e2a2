//! Parameters of the noise on ground truth poses and depth, `ground_truth.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `ground_truth.*`: noise, drift and offset that are added to recorded poses and depth. Many fields: a parameter for each kind of
/// error, switched on its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GroundTruthParams {
    /// Standard deviation about each axis, per keyframe.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg"))]
    pub rotation_noise_deg: f64,
    /// Standard deviation along each axis, share of the median depth.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub translation_noise: f64,
    /// The same as a share of the extent, the largest distance between two ground truth positions, as in eval;
    /// both add up.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub translation_noise_extent: f64,
    /// Rotation about one axis of the camera that grows evenly, the same for all.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg per 100 keyframes"))]
    pub drift_deg: f64,
    /// Translation that grows the same way, share of the extent per 100 keyframes.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub drift_extent: f64,
    /// Rotation about one axis of the camera, equal for all keyframes, as of a mount that is off.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg"))]
    pub offset_deg: f64,
    /// Translation of the same kind, share of the extent.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub offset_extent: f64,
    /// Relative standard deviation per pixel.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub depth_noise: f64,
    /// Each batch is returned as a foundation model does: in its own frame and scale, with fresh noise on
    /// orientation, position and depth, then aligned (align.*); drift_*, offset_* and *_extent do not count.
    pub windows: bool,
    /// With windows, the scale of each is drawn between this and its inverse.
    #[schemars(range(min = 1.0, max = 10.0))]
    pub window_scale: f64,
    /// With windows, share of the pixels whose depth is wrong by up to half or double.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub depth_outliers: f64,
    /// With windows, share of those whose scale is drawn between half and double instead.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub window_jumps: f64,
    /// With windows, standard deviation about each axis by which the error of a pose grows from view to view.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg"))]
    pub walk_deg: f64,
    /// The same along each axis, share of the median depth.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub walk_translation: f64,
    /// With windows, relative standard deviation of depth that is warped over the whole image, half of its variance common to a window.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub depth_warp: f64,
    /// With windows, pixels of the depth map beside a step in depth in which both sides are mixed.
    #[schemars(range(min = 0, max = 100))]
    pub edge_bleed_px: u32,
    /// With windows, relative standard deviation of the focal length, one for all views of a window; the camera counts as uncalibrated then.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub focal_error: f64,
}

impl Default for GroundTruthParams {
    fn default() -> Self {
        Self {
            rotation_noise_deg: 0.0,
            translation_noise: 0.0,
            translation_noise_extent: 0.0,
            drift_deg: 0.0,
            drift_extent: 0.0,
            offset_deg: 0.0,
            offset_extent: 0.0,
            depth_noise: 0.0,
            windows: false,
            window_scale: 1.25,
            depth_outliers: 0.0,
            window_jumps: 0.0,
            walk_deg: 0.0,
            walk_translation: 0.0,
            depth_warp: 0.0,
            edge_bleed_px: 0,
            focal_error: 0.0,
        }
    }
}
