//! Recorded poses -> the geometry of keyframes, with noise added where a test asks for it.

pub mod noise;

pub mod params;

pub mod model;
