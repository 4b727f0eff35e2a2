//! One keyframe of the map: where it stands, in the model's frame and in the engine.

use std::sync::Arc;

use crate::mapper::keyframes::residency::Residency;
use splat_geometry::answer::PoseQuality;
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::frame::Keyframe;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// A keyframe with a place in the map.
#[derive(Debug, Clone)]
pub struct RegisteredKeyframe {
    pub keyframe: Arc<Keyframe>,
    /// Index in the engine.
    pub view_ix: usize,
    /// Last pose that the geometry model gave, in its own frame.
    pub submap_from_cam: Rigid,
    /// The image that is trained on, and its camera.
    pub image: Arc<RgbImage>,
    pub intrinsics: Intrinsics,
    /// Of the keyframe's own image, where that had to be undistorted.
    pub lens: Option<CameraModel>,
    /// In map units, and its median.
    pub depth: Arc<DepthMap>,
    pub median_depth: Option<f32>,
    /// What the map made of the model's depth, and how often it was asked.
    pub depth_factor: f64,
    pub n_depth_looks: u8,
    /// Logarithms of metres per unit of the model's depth, by depth images and by the floor; `None` before it was
    /// looked at.
    pub ratios: Option<[Option<f64>; 2]>,
    pub health: PoseQuality,
    /// Kept out of optimisation, measures quality.
    pub is_held_out: bool,
    pub home: Residency,
}
