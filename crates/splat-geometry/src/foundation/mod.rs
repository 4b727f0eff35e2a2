//! A 3D foundation model as an ONNX file -> poses, intrinsics and depth of a window of images.

pub mod params;

pub mod sidecar;

pub mod contract;

pub mod decode;

pub mod model;

pub mod preprocess;

mod drop_reasons;

pub mod window;

pub mod estimator;
