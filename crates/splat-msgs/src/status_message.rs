//! The message that says how the mapper is doing.

use serde::{Deserialize, Serialize};

use crate::ros::{Header, Message, header_def, separator, time_def};

/// `splat_mapper_msgs/msg/MapperStatus`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MapperStatus {
    pub header: Header,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub state: u8,
    pub reason: String,
    pub frames_received: u64,
    pub frames_dropped: u64,
    pub frames_undecodable: u64,
    pub frames_out_of_order: u64,
    pub frames_tracked: u64,
    pub frames_lost: u64,
    pub keyframes_selected: u32,
    pub keyframes_registered: u32,
    pub submaps: u32,
    pub splats: u32,
    pub steps: u64,
    pub steps_per_s: f32,
    pub frame_to_pose_p50_ms: f32,
    pub frame_to_pose_p95_ms: f32,
    pub keyframe_to_pose_p50_ms: f32,
    pub keyframe_to_pose_p95_ms: f32,
    pub rss_mib: f32,
    pub gpu_mib: f32,
    pub frames_queued: u32,
    pub batches_queued: u32,
    pub snapshots_queued: u32,
    pub scale_source: u8,
    pub metres_per_unit: f64,
    pub scale_std: f64,
    pub warnings: Vec<String>,
}

impl Message for MapperStatus {
    const TYPE_NAME: &'static str = "splat_mapper_msgs/msg/MapperStatus";
    const DEFINITION: &'static str =
        concat!(include_str!("../msgs/msg/MapperStatus.msg"), header_def!());
}
