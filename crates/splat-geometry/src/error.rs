//! Why geometry cannot be estimated, each with what mends it.

use std::path::PathBuf;

use crate::inference::OnnxError;
use splat_gpu::error::GpuError;

#[derive(Debug, thiserror::Error)]
pub enum FeaturesError {
    #[error(
        "sfm.features=xfeat needs a network; set sfm.xfeat_model to an ONNX file of XFeat (docs/FORMATS.md has the contract)"
    )]
    NoModel,
    #[error("sfm.features=xfeat: {0}")]
    Onnx(OnnxError),
    #[error("sfm.xfeat_model is no XFeat network: {reason}; docs/FORMATS.md has the contract: {}", path.display())]
    Model { reason: String, path: PathBuf },
}

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
    #[error("{n} numbers make no whole number of images of {width}x{height}")]
    Images {
        n: usize,
        width: usize,
        height: usize,
    },
    #[error("--geometry onnx (sfm needs no network): {0}")]
    Onnx(OnnxError),
}

/// The message holds it whole: as a source it would be reported twice.
impl From<OnnxError> for ModelError {
    fn from(error: OnnxError) -> Self {
        Self::Onnx(error)
    }
}

#[derive(Debug, thiserror::Error)]
pub enum GeometryError {
    #[error("{model} needs {needs} for keyframe {keyframe_id}, found none; {way_out}")]
    Missing {
        model: &'static str,
        needs: &'static str,
        keyframe_id: u32,
        way_out: &'static str,
    },
    #[error(
        "ground_truth.translation_noise_extent and ground_truth.drift_extent are shares of the distance between the outermost true positions, which this source does not know beforehand; use ground_truth.translation_noise"
    )]
    NoExtent,
    #[error(
        "mvs.backend is wgpu, so that depth is matched on a GPU, and none will do; mvs.backend=cpu needs none: {0}"
    )]
    NoGpu(#[from] GpuError),
    #[error("{name:?} is no geometry; expected sfm, known or onnx:FILE")]
    UnknownModel { name: String },
    #[error(transparent)]
    Features(#[from] FeaturesError),
    #[error(transparent)]
    Model(#[from] ModelError),
}
