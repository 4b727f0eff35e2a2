//! Parameters of evaluation, `eval.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use splat_slam::mapper::params::HeldOutParams;

/// Parameters `eval.*`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EvalParams {
    /// ONNX file of an LPIPS network (docs/FORMATS.md), for quality.lpips_holdout; empty leaves it null.
    pub lpips_model: String,
    /// Training views whose quality is measured, an even choice of all; 0 = all.
    #[schemars(range(min = 0, max = 1000000))]
    pub train_views: usize,
    /// Steps at which quality is measured on the way (report.json, quality_at), with commas between; empty = only at the end. A replay
    /// waits meanwhile; live, none is measured.
    pub at_steps: String,
    #[serde(flatten)]
    pub held_out: HeldOutParams,
}

impl Default for EvalParams {
    fn default() -> Self {
        Self {
            lpips_model: String::new(),
            train_views: 24,
            at_steps: String::new(),
            held_out: HeldOutParams::default(),
        }
    }
}
