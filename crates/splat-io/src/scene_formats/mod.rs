//! Scenes of other programs: COLMAP, transforms.json.

mod binary;

mod listed;

mod colmap;

mod colmap_points;

mod ply_points;

mod image_files;

mod transforms;

pub mod scene;

pub mod written;
