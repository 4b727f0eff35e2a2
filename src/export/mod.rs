//! A map -> files that other programs open.

use std::path::PathBuf;

pub mod ply;

#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    #[error("cannot write the export: {reason}: {}", path.display())]
    Write { reason: String, path: PathBuf },
    #[error("cannot read the splats: {reason}: {}", path.display())]
    Read { reason: String, path: PathBuf },
    #[error("this is no 3D Gaussian splat PLY: {reason}: {}", path.display())]
    Format { reason: String, path: PathBuf },
}
