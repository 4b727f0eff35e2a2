//! Frames -> keyframes, by image motion -> batches of keyframes.

pub(crate) mod grey;

pub mod params;

mod window;

pub(crate) mod optical_flow;

pub(crate) mod motion;

pub mod selector;
