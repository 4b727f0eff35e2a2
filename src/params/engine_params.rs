//! Parameters of the engine, `engine.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `engine.*`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EngineParams {
    /// After the loss of the GPU: start a new engine on it, up to three times, then on the CPU; go on with the CPU at
    /// once; or end the run with an error.
    pub on_device_lost: OnDeviceLost,
}

impl Default for EngineParams {
    fn default() -> Self {
        Self {
            on_device_lost: OnDeviceLost::Restart,
        }
    }
}

/// What follows the loss of the GPU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnDeviceLost {
    /// A new engine on the same adapter; on the CPU where that fails.
    Restart,
    /// A new engine on the CPU.
    Cpu,
    /// The run ends with an error.
    Stop,
}
