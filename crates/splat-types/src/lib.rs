//! Plain data that crosses the crates of splat-mapper: time, rigid transforms, camera models, images, depth maps, splats,
//! snapshots of a map, poses of tracked frames. No algorithms, no threads, no files.
//!
//! A transform is named `target_from_source`; products read off: `world_from_cam * cam_from_key`. Cameras look along +z, x right,
//! y down. `docs/GLOSSARY.md` of the project lists the coordinate frames.

pub mod camera;

pub mod time;

pub mod covariance;

pub mod depth;

pub mod image;

pub mod transform;

pub mod pages;

pub mod map_frame;

pub mod inertial;

pub mod frame;

pub mod correction;

pub mod rendering;

pub mod tracking;

pub mod load_shed;

pub mod sparse_point;

pub mod splats;

pub mod snapshot;
