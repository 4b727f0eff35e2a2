//! One keyframe of the map: where it stands, in the model's frame and in the engine.

use std::sync::Arc;

use crate::mapper::keyframes::residency::Residency;
use crate::mapper::keyframes::training_image::rescaled;
use crate::track::landmarks::TriangulatedLandmarks;
use splat_geometry::answer::PoseQuality;
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::frame::Keyframe;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// How the model's depth of a keyframe relates to the map and to metres.
#[derive(Debug, Clone, Copy)]
pub struct DepthFit {
    /// The map's depth over the model's, beyond the scale of the whole submap.
    pub factor: f64,
    /// How often the map was asked.
    pub n_looks: u8,
    /// Median of the depth, in map units.
    pub median: Option<f32>,
    /// Logarithms of metres per unit of the model's depth, by depth images and by the floor; `None` before it was
    /// looked at.
    pub log_metres: Option<[Option<f64>; 2]>,
}

impl Default for DepthFit {
    fn default() -> Self {
        Self {
            factor: 1.0,
            n_looks: 0,
            median: None,
            log_metres: None,
        }
    }
}

/// A keyframe that has a pose in the map.
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
    /// In map units.
    pub depth: Arc<DepthMap>,
    pub landmarks: TriangulatedLandmarks,
    pub depth_fit: DepthFit,
    pub health: PoseQuality,
    /// Kept out of optimisation, measures quality.
    pub is_held_out: bool,
    pub home: Residency,
}

impl RegisteredKeyframe {
    /// The world has another unit: lengths are so many times as long in it.
    pub(crate) fn rescale(&mut self, factor: f64) {
        self.depth = Arc::new(rescaled(&self.depth, factor));
        self.depth_fit.median = self
            .depth_fit
            .median
            .map(|d| (f64::from(d) * factor) as f32);
        self.landmarks.unit *= factor;
        if let Some(logs) = &mut self.depth_fit.log_metres {
            *logs = logs.map(|log| log.map(|log| log - factor.ln()));
        }
        self.home.rescale(factor);
    }
}
