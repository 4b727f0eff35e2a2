//! Parameters of what goes out.

use serde::Deserialize;

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishParams {
    pub zenoh: bool,
    pub zenoh_listen: String,
    pub zenoh_connect: String,
    pub zenoh_config: String,
    pub scouting: bool,
    pub domain_id: u32,
    pub namespace: String,
    pub record: String,
    pub chunk_bytes: usize,
    pub full_secs: f64,
    pub delta_share: f64,
    pub cloud_points: usize,
    pub map_frame: String,
    pub odom_frame: String,
    pub base_frame: String,
    pub splat_frame: String,
    pub camera_frame: String,
    pub tf: TfMode,
    pub tf_tolerance: f64,
    pub slew_speed: f64,
    pub slew_turn_deg: f64,
    pub mount: String,
    pub folder: String,
    pub linger_secs: f64,
}

/// Which transforms the node broadcasts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TfMode {
    /// `Odom` where the input brings odometry, else `Full`.
    Auto,
    Odom,
    Full,
    Off,
}
