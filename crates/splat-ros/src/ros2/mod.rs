//! A ROS 2 node: image topics in, messages and services out (feature `ros2`).

pub mod names;

pub mod params;

pub mod parameter_store;

#[cfg(feature = "ros2")]
pub mod error;

#[cfg(feature = "ros2")]
pub mod executor;

#[cfg(feature = "ros2")]
pub mod node;

#[cfg(feature = "ros2")]
pub mod services;

#[cfg(feature = "ros2")]
pub mod lifecycle;

#[cfg(feature = "ros2")]
pub mod parameters;

#[cfg(feature = "ros2")]
pub mod transport;

#[cfg(feature = "ros2")]
mod image_topic;

#[cfg(feature = "ros2")]
pub mod topic_watch;

#[cfg(feature = "ros2")]
pub mod subscriber;
