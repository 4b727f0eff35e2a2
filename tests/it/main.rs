//! All integration tests in one binary: one link of the dependencies.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod bags;
mod hostile_bags;
mod lenses;
mod scenes;
mod sources;
