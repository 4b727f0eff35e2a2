//! Parameters of the ROS 2 node: what it hears of the world, and whether it is one.

use serde::Deserialize;

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ros2Params {
    pub enabled: Ros2Face,
    pub autostart: bool,
    pub image_transport: ImageTransport,
    pub reliability: Reliability,
    pub silence_secs: f64,
    pub calibration_secs: f64,
    pub odometry_secs: f64,
    pub on_time_jump: OnTimeJump,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ros2Face {
    /// Where pictures come from ROS 2 or arguments behind `--ros-args` were given.
    Auto,
    On,
    Off,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageTransport {
    /// By the types of the topics that are there.
    Auto,
    Raw,
    Compressed,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    BestEffort,
    Reliable,
}

/// What happens when pictures come with stamps, or `/clock` with a time, well before the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnTimeJump {
    /// The input ends there: the map of before is finished and written.
    End,
    /// The map is thrown away and a new one begins.
    Reset,
    /// Pictures are left out until their time has caught up.
    Ignore,
}
