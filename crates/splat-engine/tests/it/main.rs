//! Integration tests of the engine in one binary: both backends against a plain f64 reference, which is proven by differences.
#![allow(
    unreachable_pub,
    reason = "nothing outside uses a test binary; pub says what other modules may use"
)]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod appearance;
mod backends;
mod densify;
mod engine;
mod exposures;
mod gpu;
mod gpu_memory;
mod gradients;
mod hostile_splats;
mod lost_gpu;
mod mcmc;
mod paper_steps;
mod pose_network;
mod reference;
mod relocation;
mod render;
mod shared_poses;
mod steps;
