//! Parameters of the tracker.

use serde::Deserialize;

/// When frames are placed where their pictures fit the splats best.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Photometric {
    Off,
    /// Live, while the engine has nothing else to do.
    Idle,
    /// Each frame of `localise`, too.
    Always,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackParams {
    pub enabled: bool,
    pub max_side: u32,
    pub max_features: usize,
    pub max_landmarks: usize,
    pub max_keyframes: usize,
    pub min_inliers: usize,
    pub relocalise_inliers: usize,
    pub relocalise_keyframes: usize,
    pub lost_secs: f64,
    pub depth_error: f64,
    pub max_waiting: usize,
    pub photometric: Photometric,
}
