//! Streams of keyframes -> camera poses, intrinsics and dense depth: structure from motion with multi-view stereo, windows of
//! a 3D foundation model aligned with each other, or ground truth.

pub mod answer;

pub mod ransac;

pub mod pnp;

pub mod similarity;

pub mod length_ratio;

pub mod odometry_step;

pub mod stats;

pub mod inertial;

pub mod shared_library;

pub mod inference;

pub mod error;

pub mod mvs;

pub mod model;

pub mod optim;

pub mod loop_closure;

pub mod two_view;

pub mod features;

pub mod matching;

pub mod sfm;

pub mod alignment;

pub mod foundation;

pub mod ground_truth;
