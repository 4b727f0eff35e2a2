//! ROS 2: the process as a node, and pictures from its topics.
//!
//! `names` knows arguments and topic names; what speaks to ROS 2 is in builds with the feature `ros2` only.

#[cfg(feature = "ros2")]
mod beside;
#[cfg(feature = "ros2")]
pub mod link;
pub mod names;
#[cfg(feature = "ros2")]
mod pictures;
#[cfg(feature = "ros2")]
pub mod spin;
#[cfg(feature = "ros2")]
pub mod subscriber;
#[cfg(feature = "ros2")]
pub mod watch;
