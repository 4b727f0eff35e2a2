//! splat-mapper: camera frames in, refined poses and a 3D Gaussian splat map out.
//!
//! Modules stand in layer order, which is the order in which data flows: a module uses only
//! modules above it (`tests/it/layers.rs` checks). One direction:
//! `Frame -> Batch -> GeometryBatch -> SplatMap -> Arc<Snapshot> -> publishers`.

pub mod camera;
pub mod cli;
pub mod clock;
pub mod config;
pub mod eval;
pub mod export;
pub mod frame;
pub mod geometry;
pub mod gpu;
pub mod map;
pub mod node;
pub mod pose;
pub mod publish;
pub mod queue;
pub mod ros;
pub mod select;
pub mod source;
pub mod splat;
