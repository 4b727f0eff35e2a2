//! Parameters of evaluation, `eval.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `eval.*`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EvalParams {
    /// ONNX file of an LPIPS network (docs/FORMATS.md), for quality.lpips_holdout; empty leaves it null.
    pub lpips_model: String,
}
