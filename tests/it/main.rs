//! All integration tests in one binary: one link of the dependencies.
#![allow(unreachable_pub, reason = "nothing outside uses a test binary; pub says what other modules may use")]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod eval;
mod formats;
mod gradients;
mod hostile_splats;
mod layers;
mod over_zenoh;
mod publish;
mod reference;
mod render;
mod report;
mod scenes;
mod sfm;
mod sfm_measure;
mod shaders;
mod synthetic;
