//! Splats of the map: ids, motions with cameras, and regions on disk.

pub mod transform;

mod ids;

pub(crate) mod region_codec;

pub mod regions;

pub mod seeds;

pub(crate) mod store;

pub(crate) mod aside;

mod guesses;
