//! All integration tests in one binary: one link of the dependencies.
#![allow(unreachable_pub, reason = "nothing outside uses a test binary; pub says what other modules may use")]
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

mod bags;
mod declared_lengths;
mod hostile_bags;
mod lenses;
mod opening;
mod pictures;
mod scenes;
mod sources;
mod topics;
