//! Parameters of the tracker, `track.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When tracked frames are refined by the splats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Photometric {
    /// Never.
    Off,
    /// Live, while the engine is idle.
    Idle,
    /// Each frame of `localise`, too.
    Always,
}

/// Parameters `track.*`: landmarks, thresholds and memory of the tracker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrackParams {
    /// A pose for every frame, by the landmarks of the newest keyframes.
    pub enabled: bool,
    /// Corners are followed from frame to frame, which gives poses before there is a map and ahead of its newest keyframe.
    pub odometry: bool,
    /// Longer side of the image that frames are tracked on.
    #[schemars(range(min = 64, max = 1024), extend("unit" = "px"))]
    pub max_side: u32,
    /// Corners of a frame.
    #[schemars(range(min = 50, max = 5000))]
    pub max_features: usize,
    /// Landmarks of a keyframe.
    #[schemars(range(min = 50, max = 5000))]
    pub max_landmarks: usize,
    /// Keyframes to track by; beyond it those closest to another are removed. Some 80 KiB each.
    #[schemars(range(min = 2, max = 100000))]
    pub max_keyframes: usize,
    /// Landmarks that must agree on a pose.
    #[schemars(range(min = 8, max = 1000))]
    pub min_inliers: usize,
    /// The same without a motion prior.
    #[schemars(range(min = 8, max = 1000))]
    pub relocalise_inliers: usize,
    /// Keyframes that a frame is compared with while lost.
    #[schemars(range(min = 1, max = 1000))]
    pub relocalise_keyframes: usize,
    /// The tracker is lost after this time without a pose; until then the motion is extrapolated.
    #[schemars(range(min = 0.0, max = 60.0), extend("unit" = "s"))]
    pub lost_secs: f64,
    /// Relative error that the landmarks' depths are expected to have.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub depth_error: f64,
    /// Frames kept for a second attempt once the map has reached them. Some 35 KiB each.
    #[schemars(range(min = 1, max = 100000))]
    pub max_deferred_frames: usize,
    /// When tracked frames are refined by the splats: never; live while the engine is idle; always: each frame of
    /// localise too, some 0.2 s each on a CPU.
    pub photometric: Photometric,
}

impl Default for TrackParams {
    fn default() -> Self {
        Self {
            enabled: true,
            odometry: true,
            max_side: 320,
            max_features: 600,
            max_landmarks: 500,
            max_keyframes: 400,
            min_inliers: 24,
            relocalise_inliers: 30,
            relocalise_keyframes: 12,
            lost_secs: 0.4,
            depth_error: 0.02,
            max_deferred_frames: 600,
            photometric: Photometric::Idle,
        }
    }
}
