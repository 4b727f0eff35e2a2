//! All integration tests in one binary: one link of the dependencies.
#![allow(unreachable_pub, reason = "nothing outside uses a test binary; pub says what other modules may use")]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod backends;
mod engine;
mod gradients;
mod hostile_splats;
mod reference;
mod render;
mod scenes;
