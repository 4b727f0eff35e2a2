//! The engine on a GPU: the stages of the CPU engine as compute shaders, one submission a step.
//!
//! [`engine`] is what callers use, [`gradients`] is for tests. The tables of shaders and their structs are open to this
//! project's tests alone, and may change at any time.

#[doc(hidden)]
pub mod kernels;

mod memory;

#[doc(hidden)]
pub mod types;

mod frame;

mod mcmc;

mod views;

mod passes;

pub mod engine;

pub mod gradients;

mod capacity;

mod roles;

mod step_queue;
