//! A keyframe's image and depth -> what is trained on.

use std::sync::Arc;

use splat_geometry::answer::View;
use splat_image::undistort::Undistorter;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::frame::Keyframe;
use splat_types::image::RgbImage;

/// The keyframe's image at most `max_side` pixels long, as the view's pinhole sees it, and that pinhole.
pub(crate) fn training_image(
    keyframe: &Keyframe,
    view: &View,
    max_side: u32,
) -> (Arc<RgbImage>, Intrinsics) {
    let full = &keyframe.frame.image;
    let image = if full.width_px.max(full.height_px) <= max_side {
        Arc::clone(full)
    } else {
        Arc::new(full.shrunk(max_side))
    };
    let size = (image.width_px, image.height_px);
    let pinhole = view.intrinsics.resized(size.0, size.1);
    let lens = view.lens.map(|lens| lens.resized(size.0, size.1));
    let rectifier = lens.and_then(|lens| Undistorter::onto(&pinhole, &lens));
    let straight = match rectifier {
        Some(rectifier) => Arc::new(rectifier.rectify(Arc::unwrap_or_clone(image))),
        None => image,
    };
    (straight, pinhole)
}

/// The same depth in another unit.
pub(crate) fn rescaled(depth: &DepthMap, factor: f64) -> DepthMap {
    let mut depth = depth.clone();
    depth.scale(factor);
    depth
}
