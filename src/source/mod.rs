//! Frames from the world: recordings, image folders, made-up scenes.
//!
//! A source hands out decoded, undistorted frames in order of arrival and counts what it could not use.

use std::path::PathBuf;

use crate::frame::Frame;

/// What a source met so far; copied into `report.json`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceCounts {
    /// Messages or files that should have been frames.
    pub received: u64,
    pub undecodable: u64,
    /// Stamps that did not increase; such frames are left out.
    pub out_of_order: u64,
    /// The fault that ended the input early, for example a truncated recording. Frames before it stay in use.
    pub fault: Option<String>,
}

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
        "{uri:?} is no source URI; expected mcap:PATH, images:DIR, synthetic:SCENE or the path of a recording or folder"
    )]
    Uri { uri: String },
    #[error("no topic of type sensor_msgs/msg/Image or CompressedImage; found {found}; name one with --set source.image_topic=/TOPIC: {}", path.display())]
    NoImageTopic { found: String, path: PathBuf },
}

/// Hands out frames one at a time.
pub trait Source: Send {
    /// The next frame; `None` at the end of the input. A fault in the middle ends the input and stands in `counts`.
    fn next(&mut self) -> Option<Frame>;

    fn counts(&self) -> SourceCounts;

    /// Frames still to come, where the source knows (for the progress bar).
    fn len_hint(&self) -> Option<u64>;
}
