//! Parameters of foundation models, `onnx.*`.

use serde::Deserialize;

/// Whose focal length counts where a frame has a calibration and a model predicts one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum IntrinsicsFrom {
    Auto,
    Model,
    Camera,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnnxParams {
    pub providers: String,
    pub threads: usize,
    pub window: usize,
    pub window_overlap: usize,
    pub intrinsics: IntrinsicsFrom,
    pub rotation_error_deg: f64,
    pub translation_error: f64,
}
