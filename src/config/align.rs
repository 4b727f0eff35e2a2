//! Parameters of what corrects and joins the windows of a foundation model, `align.*`.

use serde::Deserialize;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AlignMethod {
    Off,
    Epipolar,
    Bundle,
    Both,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JoinBy {
    Points,
    Poses,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AlignParams {
    pub method: AlignMethod,
    pub steps: usize,
    pub max_pair_deg: f64,
    pub max_matches: usize,
    pub principal_point: bool,
    pub depth_error: f64,
    pub join: JoinBy,
    pub history: usize,
    pub whole: usize,
    pub loops: bool,
    pub max_drift: f64,
    pub min_inliers: f64,
    pub max_scale_jump: f64,
    pub max_turn_deg: f64,
}
