//! The map.

pub mod checkpoint;
pub mod layout;
pub mod snapshot;
