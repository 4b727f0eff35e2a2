//! Shaders and what the host must know of them. Speaks to no device: this build maps on the CPU, and the shaders
//! are kept valid by `tests/it/shaders.rs` against the table in `kernel`.

pub mod kernel;
pub mod types;
