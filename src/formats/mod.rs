//! Files of splats that other programs read and write: SPZ, .splat, compressed PLY, glTF. Plain PLY is `splat_types::splats::ply`.
//!
//! All of them lose some digits (docs/FORMATS.md has the steps), and none keeps anchors. Axes of the map are x right, y down, z forward.

pub mod axes;

pub mod compressed_ply;

pub mod dot_splat;

pub mod glb;

pub mod mesh_glb;

pub mod spz;

pub mod file;

pub mod scene;

pub mod planner_map;
