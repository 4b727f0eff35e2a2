//! Where an algorithm runs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What computes: a GPU by wgpu, or the CPU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Backend {
    /// Whichever is faster on this machine.
    Auto,
    /// A GPU: Vulkan, Metal or DirectX.
    Wgpu,
    /// The CPU.
    Cpu,
}
