//! Frames from cameras, MCAP recordings, image folders and scenes of other programs; recordings written.

pub mod camera_error;

pub mod error;

pub mod whole_file;

pub mod latest;

pub mod queue;

mod bag_channel;

mod bag_file;

pub mod messages;

pub mod bag_writer;

pub mod calibration;

pub mod frame_source;

pub mod params;

pub mod pace;

pub mod intake;

pub mod ros_image;

mod compressed_depth;

mod small_file;

pub mod ground_truth;

mod bag;

pub mod survey;

pub mod camera_info;

pub mod depth_registration;

pub mod second_camera;

pub mod imu;

pub mod topics;

pub mod mcap;

pub mod camera;

pub mod recording;

#[cfg(any(feature = "camera-nokhwa", not(target_os = "linux")))]
pub mod webcam;

pub mod scene_formats;

pub mod images;

#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
pub mod v4l2;
