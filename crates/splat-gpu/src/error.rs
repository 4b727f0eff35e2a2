//! Why a GPU cannot be opened, or did not do its work.

/// Why there is no GPU to work with, or why it does not do.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    #[error(
        "no GPU adapter answers{}: install a Vulkan driver (Debian: apt-get install mesa-vulkan-drivers), or use --backend cpu",
        if *any_kind { "" } else { " that is hardware" }
    )]
    NoAdapter { any_kind: bool },
    #[error("adapter {adapter:?} gives no device: {reason}; use --backend cpu")]
    NoDevice { adapter: String, reason: String },
    #[error("shader {name:?} does not compile on adapter {adapter:?}: {reason}; use --backend cpu")]
    Shader {
        name: &'static str,
        adapter: String,
        reason: String,
    },
    #[error(
        "{needed} bytes for {what} are more than the {limit} that adapter {adapter:?} allows at once; ask for less, or use --backend cpu"
    )]
    TooLarge {
        what: &'static str,
        needed: u64,
        limit: u64,
        adapter: String,
    },
    #[error("adapter {adapter:?} did not finish within {secs} s; use --backend cpu")]
    Hangs { adapter: String, secs: u64 },
    #[error("adapter {adapter:?} gave up: {reason}; use --backend cpu")]
    GaveUp { adapter: String, reason: String },
}
