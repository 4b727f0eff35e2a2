//! Why a message cannot go out.

use std::path::PathBuf;

use splat_msgs::ros::CdrError;

#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    #[error("parameter publish.{name} = {found:?} is of no use, expected {expected}")]
    Param {
        name: &'static str,
        found: String,
        expected: String,
    },
    #[error("parameter publish.zenoh_config: {reason}: {}", path.display())]
    Config { reason: String, path: PathBuf },
    #[error(
        "cannot open zenoh on {endpoints}: {reason}; check publish.zenoh_listen and publish.zenoh_connect"
    )]
    Open { endpoints: String, reason: String },
    #[error("cannot declare {key:?} on zenoh: {reason}")]
    Declare { key: String, reason: String },
    #[error("cannot send {key:?} over zenoh: {reason}")]
    Send { key: String, reason: String },
    #[cfg(feature = "ros2")]
    #[error("cannot send {topic:?} over ROS 2: {reason}")]
    Ros2 { topic: &'static str, reason: String },
    #[cfg(feature = "foxglove")]
    #[error(
        "cannot serve Foxglove on {address}: {reason}; publish.foxglove takes an address and a port that is free"
    )]
    Foxglove { address: String, reason: String },
    #[error("cannot record what goes out: {reason}: {}", path.display())]
    Record { reason: String, path: PathBuf },
    #[error(transparent)]
    Encode(#[from] CdrError),
    #[error(
        "zenoh did not close within {waited_secs} s, most likely over a stalled peer; its threads are left behind"
    )]
    Close { waited_secs: f64 },
}
