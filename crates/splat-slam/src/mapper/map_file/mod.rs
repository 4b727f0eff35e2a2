//! The map as a file: sections with checksums.

mod framing;

pub(crate) mod sections;

pub mod checkpoint;
