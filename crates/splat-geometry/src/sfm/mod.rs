//! Keyframes -> poses, intrinsics and landmarks, one submap per connected part.

pub mod params;

mod limits;

mod undistorted;

mod feature_depths;

mod finder;

mod reconstruction;

mod metric_submap;

mod odometry;

mod gyroscope;

mod overlap;

mod landmarks;

mod adjust;

pub mod global_adjustment;

mod pairwise;

mod merge_submaps;

mod join_submaps;

mod close_loops;

mod register;

mod initialize;

mod calibrate;

pub mod updates;

mod depth_schedule;

mod dense_depth;

mod undistorted_views;

pub mod estimator;

pub mod known_poses;
