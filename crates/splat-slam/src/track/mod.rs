//! Frames and the map's keyframes -> a pose for every frame, with covariance and state.

mod pose_fit;

mod motion;

pub mod params;

mod observation;

pub mod landmarks;

mod patches;

mod map_points;

mod align;

mod anchor;

mod keyframe_poses;

mod matching;

mod landmark_file;

mod odometry_link;

mod sensor_check;

mod wheel_odometry;

mod inertial_odometry;

mod map_odometry;

pub mod refinement;

pub mod history;

mod localize;

pub mod tracker;
