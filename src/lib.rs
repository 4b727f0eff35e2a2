//! splat-mapper: camera frames in, refined poses and a 3D Gaussian splat map out.
//!
//! Modules stand in layer order, which is the order in which data flows: a module uses only
//! modules above it (`tests/it/layers.rs` checks). One direction:
//! `Frame -> Batch -> GeometryBatch -> SplatMap -> Arc<Snapshot> -> publishers`.

pub mod clock;

pub mod config;

pub mod pose;

pub mod camera;

pub mod queue;

pub mod atomic;

pub mod frame;

pub mod libraries;

pub mod memory;

pub mod onnx;

pub mod ros;

pub mod source;

pub mod select;

pub mod gpu;

pub mod geometry;

pub mod track;

pub mod splat;

pub mod map;

pub mod publish;

pub mod export;

pub mod eval;

pub mod node;

pub mod cli;
