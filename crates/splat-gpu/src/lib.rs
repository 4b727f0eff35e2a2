//! Typed GPU buffers, compiled compute shaders, recorded dispatches, prefix sums and radix sort: all that this project needs
//! of wgpu. Whoever uses it owns the table of its own shaders.

pub mod error;

pub mod backend;

pub mod buffer;

mod fault;

pub mod kernel;

pub mod profile;

pub mod device;

pub mod types;

pub mod commands;
