//! Parameters of what is known in metres, `scale.*`.

use serde::Deserialize;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Known {
    Auto,
    Off,
    Odometry,
    Depth,
    Height,
    Baseline,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScaleParams {
    pub known: Known,
    pub odometry_error: f64,
    pub camera_height: f64,
    pub baseline: f64,
    pub baseline_from: f64,
    pub baseline_to: f64,
}

impl ScaleParams {
    /// (seconds from, seconds to, metres), if one was measured.
    pub fn baseline_secs(&self) -> Option<(f64, f64, f64)> {
        (self.baseline > 0.0).then_some((self.baseline_from, self.baseline_to, self.baseline))
    }
}
