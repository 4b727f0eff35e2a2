//! Frames -> keyframes, by image motion -> batches of keyframes.

pub(crate) mod grey;

pub mod params;

pub(crate) mod image_shift;

mod window;

pub(crate) mod optical_flow;

pub(crate) mod motion;

pub mod selector;
