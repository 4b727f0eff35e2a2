//! Posed images -> depth maps: plane sweep, semi-global matching, checks between views.

pub mod gpu_types;

pub mod kernels;

mod luma_map;

pub mod neighbours;

pub mod params;

mod luma;

mod planes;

mod sgm;

pub mod view;

mod warp;

mod zncc;

mod depth_edges;

mod guided_filter;

pub mod consistency;

mod sweep;

mod exposure;

pub mod stereo;

pub mod gpu;

mod backend;

pub mod depth_stream;
