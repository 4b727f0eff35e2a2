//! What goes from the reading to the writing thread of a recorder, and what can go wrong.

use std::path::PathBuf;
use std::sync::atomic::AtomicU64;

use splat_msgs::ros::{CameraInfo, CompressedImage, Header, Image};
use splat_types::time::Stamp;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error(
        "a file of that name is there; name another one, or remove it: {}",
        path.display()
    )]
    Exists { path: PathBuf },
    #[error(
        "cannot write the recording: {reason}; what was written before can be read: {}",
        path.display()
    )]
    Write { reason: String, path: PathBuf },
}

/// An image as a message.
#[derive(Debug)]
pub(crate) enum Body {
    Jpeg(Vec<u8>),
    Raw(Image),
}

#[derive(Debug)]
pub(crate) struct RecordedImage {
    pub(crate) stamp: Stamp,
    pub(crate) body: Body,
    pub(crate) info: Option<CameraInfo>,
}

/// What the writing thread reports.
#[derive(Debug, Default)]
pub(crate) struct Written {
    pub(crate) n_bytes: AtomicU64,
    pub(crate) n_files: AtomicU64,
}

impl RecordedImage {
    /// The messages that carry it, under this frame's name.
    pub(crate) fn messages(
        self,
        frame_id: &str,
    ) -> (Result<CompressedImage, Image>, Option<CameraInfo>) {
        let header = Header {
            stamp: self.stamp.into(),
            frame_id: frame_id.to_owned(),
        };
        let info = self.info.map(|info| CameraInfo {
            header: header.clone(),
            ..info
        });
        let rgb_image = match self.body {
            Body::Jpeg(data) => Ok(CompressedImage {
                header,
                format: "jpeg".to_owned(),
                data,
            }),
            Body::Raw(image) => Err(Image { header, ..image }),
        };
        (rgb_image, info)
    }
}
