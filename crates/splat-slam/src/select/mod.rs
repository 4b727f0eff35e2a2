//! Frames -> keyframes, by image motion -> batches of keyframes.

mod grey;

pub mod params;

mod window;

mod optical_flow;

mod motion;

pub mod selector;
