//! Why an engine cannot answer.

use splat_gpu::error::GpuError;

/// A call that failed. What was asked for was not done, and nothing is returned in its place.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
    /// Every later call returns it: what the device held is gone.
    #[error("adapter {adapter:?} is lost: {reason}")]
    DeviceLost {
        /// Name of the adapter, as its driver gives it.
        adapter: String,
        /// What the driver reported.
        reason: String,
    },
    /// Nothing was changed.
    #[error("{needed} bytes for {what} are more than the {limit} that the adapter allows at once")]
    OutOfMemory {
        /// Label of the buffer that was asked for.
        what: &'static str,
        /// Bytes of the buffer that was asked for.
        needed: u64,
        /// Largest buffer that the adapter allows, in bytes.
        limit: u64,
    },
}

impl From<GpuError> for EngineError {
    fn from(error: GpuError) -> Self {
        match error {
            GpuError::TooLarge {
                what,
                needed,
                limit,
                ..
            } => Self::OutOfMemory {
                what,
                needed,
                limit,
            },
            GpuError::GaveUp { adapter, reason } => Self::DeviceLost { adapter, reason },
            GpuError::NoDevice { ref adapter, .. }
            | GpuError::Shader { ref adapter, .. }
            | GpuError::Hangs { ref adapter, .. } => Self::DeviceLost {
                adapter: adapter.clone(),
                reason: error.to_string(),
            },
            GpuError::NoAdapter { .. } => Self::DeviceLost {
                adapter: "none".to_owned(),
                reason: error.to_string(),
            },
        }
    }
}
