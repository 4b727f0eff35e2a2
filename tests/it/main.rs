//! All integration tests in one binary: one link of the dependencies.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod eval;
mod formats;
mod layers;
mod publish;
mod report;
mod scenes;
mod sfm;
mod sfm_measure;
mod shaders;
