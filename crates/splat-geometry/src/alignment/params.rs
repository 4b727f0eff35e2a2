//! Parameters of the alignment of the windows of a foundation model, `align.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `align.*`: correction of poses within a window, registration of windows, loop closures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AlignParams {
    /// Correction of the poses of a network by matches: least epipolar error (VGGT-X), bundle adjustment with the
    /// network's depth, or one after the other; off leaves depth and confidence unchanged too.
    pub method: AlignMethod,
    /// Updates of the epipolar method.
    #[schemars(range(min = 1, max = 10000))]
    pub steps: usize,
    /// Views that are rotated further apart are matched only where they see the same surface.
    #[schemars(range(min = 1.0, max = 180.0), extend("unit" = "deg"))]
    pub max_pair_deg: f64,
    /// Matches per pair of views.
    #[schemars(range(min = 64, max = 65535))]
    pub max_matches: usize,
    /// The epipolar method moves the principal point of uncalibrated cameras too.
    pub principal_point: bool,
    /// Relative error that the network's depth is expected to have.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub depth_error: f64,
    /// What registers a window to the map: the surfaces that the shared keyframes saw (points), or their poses
    /// and the ratio of their depths (poses).
    pub registration: Registration,
    /// Earlier keyframes that stay fixed while those of a registered window are corrected once more; 0 = no such
    /// correction.
    #[schemars(range(min = 0, max = 64))]
    pub fixed_keyframes: usize,
    /// The newest keyframes of a submap that are adjusted together whenever it has grown by a third, and at the
    /// end; 0 = only windows are corrected.
    #[schemars(range(min = 0, max = 20000))]
    pub global_ba_keyframes: usize,
    /// Loop closures correct the trajectory between and merge submaps; not with method off.
    pub loops: bool,
    /// Largest translation that a loop closure may apply, share of the trajectory between: ambiguous matches need
    /// more.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub max_loop_correction: f64,
    /// Share of the shared surface that must agree with the map's, else a new submap begins.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_inliers: f64,
    /// Ratio of the scales of neighbouring windows from which a window is not registered.
    #[schemars(range(min = 1.0, max = 100.0))]
    pub max_scale_jump: f64,
    /// Angle between the shared keyframes' orientations from which a window is not registered.
    #[schemars(range(min = 0.1, max = 180.0), extend("unit" = "deg"))]
    pub max_rotation_deg: f64,
}

impl Default for AlignParams {
    fn default() -> Self {
        Self {
            method: AlignMethod::Bundle,
            steps: 300,
            max_pair_deg: 30.0,
            max_matches: 4096,
            principal_point: false,
            depth_error: 0.05,
            registration: Registration::Poses,
            fixed_keyframes: 6,
            global_ba_keyframes: 500,
            loops: true,
            max_loop_correction: 0.05,
            min_inliers: 0.3,
            max_scale_jump: 3.0,
            max_rotation_deg: 10.0,
        }
    }
}

/// Correction of the poses of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AlignMethod {
    /// None.
    Off,
    /// Least epipolar error (VGGT-X).
    Epipolar,
    /// Bundle adjustment with the network's depth.
    Bundle,
    /// One after the other.
    Both,
}

/// What registers a window to the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Registration {
    /// Surfaces that the shared keyframes saw.
    Points,
    /// Poses of the shared keyframes and the ratio of their depths.
    Poses,
}
