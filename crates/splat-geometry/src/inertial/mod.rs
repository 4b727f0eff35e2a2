//! Inertial measurements and poses of a camera -> gyroscope bias, metres per unit, gravity, speed, and poses where the camera sees
//! nothing.
//!
//! Conventions: samples and poses are in the camera's axes; the world is that of the poses, in any unit and at any tilt.

pub mod noise;

pub mod preintegration;

pub mod turns;

mod information;

pub mod frames;

mod place_filter;

pub mod alignment;
