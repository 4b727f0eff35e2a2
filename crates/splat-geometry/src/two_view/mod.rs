//! Two views of one scene: essential matrix, triangulation, focal length.

pub mod five_point;

pub mod focal;

pub mod triangulate;

pub mod epipolar;

pub mod plane;
