//! Parameters of foundation models, `onnx.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which focal length is used where a frame has a calibration and a model predicts one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum IntrinsicsFrom {
    /// The camera's where it is calibrated, else the model's.
    Auto,
    /// Always the model's.
    Model,
    /// The camera's, or an error.
    Camera,
}

/// Parameters `onnx.*`: execution, windows and expected errors of a network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OnnxParams {
    /// Execution providers of the network of geometry onnx:FILE: auto, or names of tensorrt, cuda, cpu separated
    /// by commas, tried in that order; auto tries all three.
    pub providers: String,
    /// Threads of the network on the CPU; 0 takes as many as there are cores, up to 4.
    #[schemars(range(min = 0, max = 256))]
    pub threads: usize,
    /// Keyframes of one inference; 0 takes as many as fit into free memory, up to the model's own limit.
    #[schemars(range(min = 0, max = 256))]
    pub window: usize,
    /// Keyframes that neighbouring windows share where a batch needs several; a shorter window shares all but
    /// one.
    #[schemars(range(min = 1, max = 16))]
    pub window_overlap: usize,
    /// Focal length: the camera's where it is calibrated, else the model's; always the model's; the camera's or
    /// an error.
    pub intrinsics: IntrinsicsFrom,
    /// Expected error of the model's rotations; the optimiser may move them this far.
    #[schemars(range(min = 0.0, max = 90.0), extend("unit" = "deg"))]
    pub rotation_error_deg: f64,
    /// Expected error of the model's positions, share of the median depth.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub translation_error: f64,
}

impl Default for OnnxParams {
    fn default() -> Self {
        Self {
            providers: "auto".to_owned(),
            threads: 0,
            window: 0,
            window_overlap: 2,
            intrinsics: IntrinsicsFrom::Auto,
            rotation_error_deg: 0.5,
            translation_error: 0.01,
        }
    }
}
