//! The map.

pub mod snapshot;
