//! splat-mapper: camera frames in, refined poses and a 3D Gaussian splat map out.
//!
//! The node: threads, queues, files and the command line around the crates below `crates/`. Modules stand in layer order:
//! a module uses only modules above it.

pub mod eval;

pub mod machine;

pub mod doctor;

pub mod report;

pub mod params;

pub mod formats;

pub mod node;

pub mod view;

pub mod compare;

pub mod cli;
