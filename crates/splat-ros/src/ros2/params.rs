//! Parameters of the ROS 2 node, `ros2.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `ros2.*`: what is subscribed, and for how long the node waits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Ros2Params {
    /// Be a ROS 2 node: topics, services, parameters, lifecycle. auto is on where the source is ros2: or
    /// arguments behind --ros-args were given. Needs a build with ROS 2.
    pub enabled: Ros2Face,
    /// Map at once; false waits for the lifecycle's configure and activate.
    pub autostart: bool,
    /// Type that ros2:/TOPIC is subscribed as: sensor_msgs/Image, CompressedImage on TOPIC or TOPIC/compressed,
    /// or whichever exists.
    pub image_transport: ImageTransport,
    /// QoS that is requested from publishers of images; reliable receives only from those who offer it.
    pub reliability: Reliability,
    /// After this time without images the log and the status give the cause.
    #[schemars(range(min = 0.1, max = 3600.0), extend("unit" = "s"))]
    pub image_timeout: f64,
    /// Images wait this long for the first CameraInfo; then the camera counts as uncalibrated.
    #[schemars(range(min = 0.0, max = 3600.0), extend("unit" = "s"))]
    pub camera_info_timeout: f64,
    /// An image waits this long for odometry, or tf, of its time.
    #[schemars(range(min = 0.0, max = 10.0), extend("unit" = "s"))]
    pub odometry_timeout: f64,
    /// When stamps or /clock jump back by more than a second: the input ends and the map stays; a new map begins;
    /// images are skipped until time has caught up.
    pub on_time_jump: OnTimeJump,
}

impl Default for Ros2Params {
    fn default() -> Self {
        Self {
            enabled: Ros2Face::Auto,
            autostart: true,
            image_transport: ImageTransport::Auto,
            reliability: Reliability::BestEffort,
            image_timeout: 3.0,
            camera_info_timeout: 2.0,
            odometry_timeout: 0.1,
            on_time_jump: OnTimeJump::End,
        }
    }
}

/// Whether the process is a ROS 2 node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Ros2Face {
    /// Where images come from ROS 2 or arguments behind `--ros-args` were given.
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// Type of the image topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ImageTransport {
    /// By the types of the topics that exist.
    Auto,
    /// `sensor_msgs/Image`.
    Raw,
    /// `sensor_msgs/CompressedImage`.
    Compressed,
}

/// QoS requested from publishers of images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reliability {
    BestEffort,
    Reliable,
}

/// What happens when images come with stamps, or `/clock` with a time, well before the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnTimeJump {
    /// The input ends there: the map of before is finished and written.
    End,
    /// The map is discarded and a new one begins.
    Reset,
    /// Images are skipped until their time has caught up.
    Ignore,
}
