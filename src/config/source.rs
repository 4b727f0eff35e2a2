//! Parameters of sources, cameras and recordings. Defaults and ranges stand in `launch/params.yaml`.

use serde::Deserialize;

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceParams {
    pub image_topic: String,
    pub camera_info_topic: String,
    pub camera_info_url: String,
    pub pose_topic: String,
    pub depth_topic: String,
    pub odometry_topic: String,
    pub names: String,
    pub held_out_names: String,
    pub pick: usize,
    pub max_side: u32,
    pub max_frames: u64,
    pub rectify: bool,
    pub rate: f64,
    pub camera: CameraParams,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraParams {
    pub formats: String,
    pub width: u32,
    pub height: u32,
    pub rate: f64,
    pub buffers: u32,
    pub exposure: f64,
    pub gain: i32,
    pub lock_focus: bool,
    pub focus: i32,
    pub controls: String,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordParams {
    pub namespace: String,
    pub frame_id: String,
    pub chunk_kib: u64,
    pub chunk_secs: f64,
    pub compression_level: u32,
    pub max_file_mib: u64,
    pub max_file_secs: f64,
    pub max_files: usize,
}
