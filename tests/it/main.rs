//! All integration tests in one binary: one link of the dependencies.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod eval;
mod html;
mod render;
mod report;
mod scenes;
mod trajectory;
