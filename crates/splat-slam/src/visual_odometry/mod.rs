//! Frames -> the camera's pose in a frame of its own, from the first parallax on, without a map.
//!
//! Corners are followed from frame to frame. Two images begin a segment; from then on the corners' points, triangulated
//! here, give each frame its pose, and a window of keyframes is adjusted. Dense depth and the map have no part in it.

mod feature_tracks;

mod two_view_start;

mod local_map;

pub mod odometry;
