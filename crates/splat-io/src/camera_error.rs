//! Why a camera cannot be opened or read.

use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    #[error("no camera is there; splat-mapper doctor lists those that are: {}", path.display())]
    Absent { path: PathBuf },
    #[error(
        "the camera is in use by another program; end it (fuser -v {} names it): {}",
        path.display(), path.display()
    )]
    Busy { path: PathBuf },
    #[error(
        "no permission to open the camera; sudo usermod -aG video $USER, then log in again; in a container, pass it on with --device: {}",
        path.display()
    )]
    Permission { path: PathBuf },
    #[error("not a camera: {reason}; splat-mapper doctor lists the cameras: {}", path.display())]
    NotCamera { reason: String, path: PathBuf },
    #[error(
        "the camera has none of the formats {wanted}, but {found}; change source.camera.formats: {}",
        path.display()
    )]
    Format {
        wanted: String,
        found: String,
        path: PathBuf,
    },
    #[error(
        "the camera refused every format: {refusals}; splat-mapper doctor lists what it offers, choose with source.camera.formats, width, height: {}",
        path.display()
    )]
    Refused { refusals: String, path: PathBuf },
    #[error("the camera is gone ({reason}): {}", path.display())]
    Gone { reason: String, path: PathBuf },
    #[error("cannot {what}: {reason}: {}", path.display())]
    Io {
        what: &'static str,
        reason: String,
        path: PathBuf,
    },
}
