//! Images with a time: frames, the keyframes kept of them, and batches of keyframes.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::image::RgbImage;
use crate::time::{Stamp, Stopwatch};
use crate::transform::Rigid;

/// One image from the world, already undistorted to the pinhole `intrinsics` when the calibration is known.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Counts from 0 in the order of arrival; gaps mean dropped or undecodable frames.
    pub seq: u64,
    pub stamp: Stamp,
    pub image: Arc<RgbImage>,
    /// `None`: the camera is uncalibrated and geometry must estimate the focal length.
    pub intrinsics: Option<Intrinsics>,
    /// Ground truth where the source has it (`world_from_cam`, OpenCV axes). Only `geometry::known` and `eval` may look.
    pub truth: Option<Rigid>,
    /// `odom_from_cam` in metres, where the source has odometry: its steps are right, its places drift.
    pub odometry: Option<Rigid>,
    /// Depth in metres by something that measures it (exact in synthetic scenes), at image size or smaller.
    pub sensor_depth: Option<Arc<DepthMap>>,
    /// The source keeps it for measuring quality: it gets a place in the map, but no optimiser step learns from it.
    pub is_held_out: bool,
}

/// A frame that the map keeps. Ids count from 0 without gaps, in order of time.
#[derive(Debug, Clone)]
pub struct Keyframe {
    pub id: u32,
    pub frame: Frame,
    /// Runs since the frame was selected: latencies in reports.
    pub age: Stopwatch,
}

impl Keyframe {
    /// The same without what takes memory: the pixels, and measured depth.
    pub fn unloaded(&self) -> Self {
        let image = &self.frame.image;
        let mut unloaded = self.clone();
        unloaded.frame.image = Arc::new(RgbImage::unloaded(image.width_px, image.height_px));
        unloaded.frame.sensor_depth = None;
        unloaded
    }
}

/// Keyframes for one inference; the first `n_shared` were in the batch before.
#[derive(Debug, Clone)]
pub struct Batch {
    pub id: u32,
    pub n_shared: usize,
    pub keyframes: Vec<Arc<Keyframe>>,
}
