//! Geometry of keyframes -> one map of splats and poses that grows, is optimised and can be copied.

pub mod metric_scale_params;

pub mod pages;

pub mod params;

pub mod budgets;

pub(crate) mod cameras;

pub mod keyframes;

mod inertial_scale;

mod metric_scale;

mod depth_scale;

pub mod splats;

pub mod map_file;

pub(crate) mod parts;

pub mod train;

pub mod submaps;

mod last_good;

pub mod mapper;
