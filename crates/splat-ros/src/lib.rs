//! A map and its poses -> messages over zenoh, MCAP and ROS 2; services answered.

pub mod error;

pub mod plan;

pub mod transport;

pub mod shared_volume;

pub mod obstacles;

pub mod distances;

pub mod box_services;

pub mod latched;

pub mod params;

pub mod navigation;

#[cfg(feature = "foxglove")]
mod foxglove_transport;

mod mcap_transport;

pub mod slew;

pub mod status;

pub mod odometry;

pub mod pose_messages;

pub mod render_view;

pub mod service_server;

#[cfg(any(feature = "ros2", feature = "zenoh"))]
mod live_images;

#[cfg(feature = "zenoh")]
pub mod zenoh;

pub mod publisher;

pub mod reports;

pub mod submap_stream;

pub mod map_stream;

pub mod grid_stream;

pub mod pose_stream;

pub mod status_stream;

pub mod output;

pub mod ros2;
