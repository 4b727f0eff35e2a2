//! Parameters of features.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Detector and descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FeatureKind {
    Auto,
    Sift,
    Orb,
    Xfeat,
}

/// What the extractor needs of `sfm.*`.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureParams {
    pub kind: FeatureKind,
    /// ONNX file of XFeat; may be empty for the other kinds.
    pub xfeat_model: String,
    /// Per image.
    pub max_features: usize,
    /// px. Longer side of the image that features are found on.
    pub max_side: u32,
}
