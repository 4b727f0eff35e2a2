//! The SLAM core: frames in, keyframes, poses and a map of splats out. No threads, no files, no clock of its own.

pub mod select;

pub mod working_camera;

pub mod visual_odometry;

pub mod track;

pub mod mapper;

pub mod slam;
