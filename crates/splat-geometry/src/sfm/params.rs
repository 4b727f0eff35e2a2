//! Parameters of structure from motion, `sfm.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::features::params::{FeatureKind, FeatureParams};

/// Parameters `sfm.*`: features, thresholds of registration, loop closures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SfmParams {
    /// Features that images are matched by; auto is sift (docs/BENCHMARKS.md gives the reason); xfeat needs
    /// sfm.xfeat_model.
    pub features: FeatureKind,
    /// ONNX file of XFeat as docs/FORMATS.md describes it, for features xfeat.
    pub xfeat_model: String,
    /// Features per keyframe.
    #[schemars(range(min = 200, max = 20000))]
    pub max_features: usize,
    /// Longer side of the image that features are found on.
    #[schemars(range(min = 128, max = 4096), extend("unit" = "px"))]
    pub max_side: u32,
    /// Landmarks that must agree before a keyframe is registered.
    #[schemars(range(min = 8, max = 1000))]
    pub min_inliers: usize,
    /// Median triangulation angle that a first pair needs.
    #[schemars(range(min = 0.1, max = 30.0), extend("unit" = "deg"))]
    pub min_parallax_deg: f64,
    /// Reprojection error up to which a match is an inlier, at 640 px.
    #[schemars(range(min = 0.2, max = 20.0), extend("unit" = "px"))]
    pub max_error_px: f64,
    /// Focal length at the source's size where no CameraInfo exists; 0 estimates it.
    #[schemars(range(min = 0.0, max = 100000.0), extend("unit" = "px"))]
    pub focal_guess: f64,
    /// Earlier poses near a new keyframe, between adjustments of all: fixed, or with a prior that lets them move
    /// as far as their other landmarks allow (soft).
    pub local_ba_prior: LocalBaPrior,
    /// Standard deviation of a depth camera, as a share of the square of the distance: 0.0014 for structured light
    /// (Kinect), 0.003 for a stereo camera of 5 cm (RealSense).
    #[schemars(range(min = 0.00001, max = 0.1), extend("unit" = "1/m"))]
    pub depth_noise: f64,
    /// Standard deviation of the length of what odometry says, as a share of it: wheels 0.01 to 0.02, legs 0.05. It steadies the
    /// scale along the way, and joins parts of a recording that share no view. 0: odometry has no part in poses.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub odometry_noise: f64,
    /// The same of the heading, per metre of way: a car 0.1, a differential drive 1.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg/m"))]
    pub odometry_turn_noise: f64,
    /// Loop closures correct the trajectory between.
    pub loops: bool,
    /// Largest translation that a loop closure may apply, share of the trajectory between: ambiguous matches need
    /// more.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub max_loop_correction: f64,
}

impl Default for SfmParams {
    fn default() -> Self {
        Self {
            features: FeatureKind::Auto,
            xfeat_model: String::new(),
            max_features: 2000,
            max_side: 640,
            min_inliers: 30,
            min_parallax_deg: 1.5,
            max_error_px: 2.0,
            focal_guess: 0.0,
            local_ba_prior: LocalBaPrior::Soft,
            depth_noise: 0.0014,
            odometry_noise: 0.02,
            odometry_turn_noise: 1.0,
            loops: true,
            max_loop_correction: 0.05,
        }
    }
}

impl SfmParams {
    /// The part that feature extraction needs.
    pub fn features(&self) -> FeatureParams {
        FeatureParams {
            kind: self.features,
            xfeat_model: self.xfeat_model.clone(),
            max_features: self.max_features,
            max_side: self.max_side,
        }
    }
}

/// Earlier poses near a new keyframe, between adjustments of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LocalBaPrior {
    /// They do not move.
    Fixed,
    /// They move as far as their other landmarks allow.
    Soft,
}
