//! The engine on the CPU: rayon over tiles and splats, SIMD where the processor has it.
//!
//! [`engine`] is what callers use. The stages of a step are open to this project's benches alone, and may change at any time.

mod lanes;

mod pose_adam;

mod exposure;

#[doc(hidden)]
pub mod project;

#[doc(hidden)]
pub mod bin;

mod ssim;

mod tile_splat;

#[doc(hidden)]
pub mod raster;

mod view;

#[doc(hidden)]
pub mod loss_buffers;

mod loss_depth;

#[doc(hidden)]
pub mod loss;

#[doc(hidden)]
pub mod raster_backward;

#[doc(hidden)]
pub mod project_backward;

mod pass;

mod screen_gradients;

mod moments;

mod adam_sh;

mod adam;

mod adam_unseen;

mod mcmc;

pub mod engine;

mod roles;
