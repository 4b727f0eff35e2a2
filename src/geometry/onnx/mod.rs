//! A batch of keyframes -> poses, depth and confidence by a foundation model (VGGT, Depth-Anything-3) that the user
//! supplies as an ONNX file. docs/MODELS.md has the contract.

pub mod contract;
pub mod decode;
pub mod model;
pub mod sidecar;

use std::path::PathBuf;

use crate::onnx::OnnxError;

#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error("onnx.providers names {found:?}, expected auto or some of tensorrt, cuda, cpu")]
    Providers { found: String },
    #[error("there is no model; --geometry onnx:FILE names an ONNX file as docs/MODELS.md describes it: {}", .0.display())]
    NoFile(PathBuf),
    #[error("the model's description cannot be used: {reason}; scripts/export_model.py writes it beside the model, docs/MODELS.md lists its keys: {}", path.display())]
    Sidecar { reason: String, path: PathBuf },
    #[error("this network is no model for --geometry onnx: {reason}; docs/MODELS.md has the contract: {}", path.display())]
    Contract { reason: String, path: PathBuf },
    #[error("{n} numbers make no whole number of pictures of {width}x{height}")]
    Pictures {
        n: usize,
        width: usize,
        height: usize,
    },
    #[error("--geometry onnx: {0}")]
    Onnx(#[from] OnnxError),
}
