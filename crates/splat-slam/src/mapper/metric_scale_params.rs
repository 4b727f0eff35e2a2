//! Parameters of the scale in metres, `scale.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What gives the scale in metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MetricSource {
    /// The most certain one available.
    Auto,
    /// None: the map keeps its own unit.
    Off,
    /// Wheel odometry.
    Odometry,
    /// An IMU.
    Imu,
    /// Depth images.
    Depth,
    /// Height of the camera above the floor.
    Height,
    /// A measured distance between two positions of the camera.
    Baseline,
}

/// Parameters `scale.*`: measurements in metres and their errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ScaleParams {
    /// What gives the map its scale in metres where geometry has none: wheel odometry, an IMU, depth images, the height
    /// of the camera above the floor, a measured distance; auto takes the most certain one available.
    pub source: MetricSource,
    /// Expected relative error of the scale of odometry: worn wheels, a wrong radius.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub odometry_error: f64,
    /// Height above the floor, which the lower half of the image must show; 0 = unknown.
    #[schemars(range(min = 0.0, max = 100.0), extend("unit" = "m"))]
    pub camera_height: f64,
    /// Distance between the positions of the camera at baseline_from and baseline_to; 0 = not measured.
    #[schemars(range(min = 0.0, max = 1e6), extend("unit" = "m"))]
    pub baseline: f64,
    /// Time after the first keyframe; the keyframe nearest in time counts.
    #[schemars(range(min = 0.0, max = 1e9), extend("unit" = "s"))]
    pub baseline_from: f64,
    /// Time after the first keyframe, for the other end.
    #[schemars(range(min = 0.0, max = 1e9), extend("unit" = "s"))]
    pub baseline_to: f64,
}

impl Default for ScaleParams {
    fn default() -> Self {
        Self {
            source: MetricSource::Auto,
            odometry_error: 0.01,
            camera_height: 0.0,
            baseline: 0.0,
            baseline_from: 0.0,
            baseline_to: 0.0,
        }
    }
}

impl ScaleParams {
    /// (seconds from, seconds to, metres), if one was measured.
    pub fn baseline_secs(&self) -> Option<(f64, f64, f64)> {
        (self.baseline > 0.0).then_some((self.baseline_from, self.baseline_to, self.baseline))
    }
}
