//! Verified depth of keyframes -> a volume of signed distances, and what planners take of it: an occupancy grid, distances, a mesh.
//!
//! [`volume::Volume`] takes keyframes with poses in a level frame (z up, metres) and keeps them, so that a keyframe that moves is taken out where
//! it was and put in where it is. [`grid::grid`] classifies cells above the local ground, [`distance::signed_distances`] gives each cell its way
//! to the nearest obstacle, [`field::distances`] points of space theirs, [`mesh::mesh`] the surface, [`map_file`] the files of map_server. No threads, no clock, no files: the caller has those.

pub mod error;

pub mod params;

pub mod view;

pub mod blocks;

pub mod voxels;

pub mod ground;

pub mod columns;

pub mod ellipsoids;

pub mod volume;

pub mod grid;

pub mod distance;

pub mod field;

pub mod map_file;

pub mod mesh;

pub mod mesh_colour;
