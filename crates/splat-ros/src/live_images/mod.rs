//! Images that come live over ROS 2 or zenoh, with calibration, transforms, odometry, depth and a second camera beside them -> frames.

pub(crate) mod companions;

pub(crate) mod assembler;
