//! Why a source cannot be opened.

use std::path::PathBuf;

use crate::camera_error::CameraError;

#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    #[error("cannot open {what}: {reason}; {way_out}: {}", path.display())]
    Open {
        what: &'static str,
        reason: String,
        way_out: &'static str,
        path: PathBuf,
    },
    #[error(
        "{uri:?} is no source URI; expected v4l2:/dev/video0, webcam:0, mcap:PATH, images:DIR, synthetic:SCENE, ros2:/TOPIC or the path of a recording or folder"
    )]
    Uri { uri: String },
    #[error("no topic of type sensor_msgs/msg/Image or CompressedImage; found {found}; name one with --set source.image_topic=/TOPIC: {}", path.display())]
    NoImageTopic { found: String, path: PathBuf },
    #[error("{topic:?} carries {found}, expected sensor_msgs/msg/Image or CompressedImage as cdr: {}", path.display())]
    TopicType {
        topic: String,
        found: String,
        path: PathBuf,
    },
    #[error("{uri:?} is not in this build; {way_out}")]
    NotInBuild { uri: String, way_out: &'static str },
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[cfg(feature = "live-messages")]
    #[error("cannot subscribe to {topic:?}: {reason}")]
    Subscribe { topic: String, reason: String },
}
