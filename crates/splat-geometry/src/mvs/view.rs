//! What stereo is given of a view, what matching makes of it, and depth before anything has confirmed it.

use std::sync::Arc;

use crate::mvs::gpu_types::SWEEP_WINDOW;
use crate::mvs::luma::Grey;
use crate::mvs::params::MvsParams;
use splat_types::camera::Intrinsics;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Two matching windows; smaller images hold no depth worth having.
pub(crate) const MIN_SIDE_PX: usize = 2 * SWEEP_WINDOW as usize;

/// An image and where it was taken from.
#[derive(Debug, Clone)]
pub struct MvsView {
    pub image: Arc<RgbImage>,
    /// May be stated for another size of the same image.
    pub intrinsics: Intrinsics,
    pub submap_from_cam: Rigid,
}

/// Depth of one view before any other view has confirmed it. Not to be shown or mapped.
#[derive(Debug, Clone)]
pub struct RawDepth {
    /// Of the depth map, not of the image that it was made from.
    pub intrinsics: Intrinsics,
    /// z-depth; 0 = no value.
    pub depth: Vec<f32>,
    /// ZNCC of the depth's plane, 0 to 1.
    pub score: Vec<f32>,
    /// How far the best plane stands out from the second best, 0 to 1.
    pub margin: Vec<f32>,
}

impl RawDepth {
    pub(crate) fn empty(intrinsics: Intrinsics) -> Self {
        let n = intrinsics.width_px as usize * intrinsics.height_px as usize;
        Self {
            intrinsics,
            depth: vec![0.0; n],
            score: vec![0.0; n],
            margin: vec![0.0; n],
        }
    }
}

/// What matching needs of a view: grey, at the size of the depth map. Images are shared, since a sweep on another thread reads
/// them while the pose is revised.
#[derive(Debug, Clone)]
pub(crate) struct Prepared {
    pub(crate) grey: Arc<Grey>,
    /// The same image at up to twice the size, for what is narrower than a window.
    pub(crate) fine: Arc<Grey>,
    pub(crate) intrinsics: Intrinsics,
    pub(crate) submap_from_cam: Rigid,
}

impl Prepared {
    pub(crate) fn new(view: &MvsView, params: &MvsParams) -> Self {
        let grey = Grey::of_image(&view.image, params);
        let fine = grey.finer(&view.image);
        let intrinsics = view
            .intrinsics
            .resized(grey.width as u32, grey.height as u32);
        Self {
            grey: Arc::new(grey),
            fine: Arc::new(fine),
            intrinsics,
            submap_from_cam: view.submap_from_cam,
        }
    }

    pub(crate) fn is_usable(&self) -> bool {
        let unit = (self.submap_from_cam.rotation.length_squared() - 1.0).abs() < 1e-3;
        self.submap_from_cam.is_finite()
            && unit
            && self.intrinsics.is_plausible()
            && self.grey.width >= MIN_SIDE_PX
            && self.grey.height >= MIN_SIDE_PX
    }
}

pub(crate) fn prepared(views: &[&MvsView], params: &MvsParams) -> Vec<Prepared> {
    let views = views.iter();
    views.map(|view| Prepared::new(view, params)).collect()
}
