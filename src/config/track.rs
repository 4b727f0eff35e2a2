//! Parameters of the tracker.

use serde::Deserialize;

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
}
