//! A view to train on: an image, its camera, and what is known of it.

use std::sync::Arc;

use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Splats closer than this to a camera are not drawn unless an engine is given a farther plane, world units; the map's unit is about
/// the median scene depth.
pub const NEAR: f32 = 0.01;

/// Pixels that the window of SSIM reaches to each side.
pub(crate) const SSIM_REACH: u32 = 5;

/// An image to train on, or an unloaded one, which no step may have. Index in the engine = order of
/// [`ViewStore::add_view`](crate::traits::ViewStore::add_view). Without lens distortion.
#[derive(Debug, Clone)]
pub struct TrainingView {
    /// 8-bit RGB, compared as stored.
    pub image: Arc<RgbImage>,
    /// Of the image, of the same size.
    pub intrinsics: Intrinsics,
    /// Pose that training starts from.
    pub cam_from_world: Rigid,
    /// z-depth in world units; guides the depth loss where confidence > 0. May be smaller than the image.
    pub depth: Option<Arc<DepthMap>>,
    /// Weight of each pixel in all losses, row by row, 255 = all; what moves in the scene gets less. `None`: all count.
    pub mask: Option<Arc<[u8]>>,
}

/// A point seen in two views, in pixels of their training images (pixel centres at +0.5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// x, y in the view that holds the correspondence.
    pub own_px: [f32; 2],
    /// Index of the other view.
    pub other_view_ix: u32,
    /// x, y in the other view.
    pub other_px: [f32; 2],
    /// Against the view's other correspondences; at most 0: it has no say.
    pub weight: f32,
}

impl TrainingView {
    /// A photo and its camera, without depth, every pixel counting in full.
    pub fn new(image: Arc<RgbImage>, intrinsics: Intrinsics, cam_from_world: Rigid) -> Self {
        Self {
            image,
            intrinsics,
            cam_from_world,
            depth: None,
            mask: None,
        }
    }

    /// Our own mistake when it fails.
    pub(crate) fn assert_consistent(&self) {
        let (image, intrinsics) = (&self.image, &self.intrinsics);
        let size = (image.width_px, image.height_px);
        assert_eq!(
            size,
            (intrinsics.width_px, intrinsics.height_px),
            "a view's intrinsics are those of its image"
        );
        let n_pixels = size.0 as usize * size.1 as usize;
        assert!(
            image.is_unloaded() || image.pixels.len() == 3 * n_pixels,
            "an image is as large as it says, or its pixels are elsewhere"
        );
        let is_fit = self.mask.as_ref().is_none_or(|mask| mask.len() == n_pixels);
        assert!(is_fit, "a mask has one byte for each of {n_pixels} pixels");
    }
}
