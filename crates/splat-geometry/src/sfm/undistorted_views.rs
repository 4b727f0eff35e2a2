//! Images of an uncalibrated camera whose lens bends -> the pinhole that they are undistorted to, for stereo and map.
//!
//! An image is made once; what adjustments change of the lens afterwards goes into the pinhole's focal length, until
//! the straight image would be visibly wrong.

use glam::DVec2;

use crate::sfm::reconstruction::{Reconstruction, SfmView, distorted};
use crate::sfm::undistorted::Undistorted;
use splat_image::undistort::Undistorter;
use splat_types::camera::CameraModel;

/// Error of the straight images in a corner, in pixels of the working image, from which on they are made again.
const MAX_OFF_PX: f64 = 1.0;

/// Whether the lens has moved so far since the matches were verified that others would be. Says so once for each lens.
pub(crate) fn links_are_stale(scene: &mut Reconstruction, max_error_px: f64) -> bool {
    let now = scene
        .views
        .iter()
        .find(|s| !s.is_calibrated)
        .map(|s| s.lens);
    let Some(now) = now else { return false };
    let was = distorted(&now, scene.linked_with);
    let is_stale = off_px(&was, &distorted(&now, scene.radial)) > max_error_px;
    if is_stale {
        scene.linked_with = scene.radial;
    }
    is_stale
}

/// Chooses pinholes anew where the lens has moved too far. True: images reported of earlier are out of date.
pub(crate) fn undistort_images(scene: &mut Reconstruction) -> bool {
    let bends = |s: &&SfmView| !s.is_calibrated && s.registered.is_some();
    let Some(now) = scene.views.iter().find(bends).map(|s| s.lens) else {
        return false;
    };
    let (old_radial, then) = scene.undistorted.made_with.unwrap_or((0.0, now));
    let off_px = off_px(
        &distorted(&then, old_radial),
        &distorted(&now, scene.radial),
    );
    let is_stale = off_px > MAX_OFF_PX;
    if is_stale {
        tracing::debug!(scene.radial, off_px, "images are undistorted anew");
        scene.undistorted = Undistorted {
            made_with: (scene.radial != 0.0).then_some((scene.radial, now)),
            ..Undistorted::default()
        };
    }
    let Some((radial, then)) = scene.undistorted.made_with else {
        return is_stale;
    };
    for view in scene.views.iter().filter(bends) {
        let (width, height) = {
            let image = &view.keyframe.frame.image;
            (image.width_px, image.height_px)
        };
        if scene.undistorted.pinholes.contains_key(&(width, height)) {
            continue;
        }
        let pinhole = view.lens.refocused(then.fx / now.fx);
        let lens = distorted(&pinhole.resized(width, height), radial);
        if let Some(undistorted) = Undistorter::new(&lens) {
            let known = &mut scene.undistorted.pinholes;
            known.insert((width, height), (lens, undistorted.pinhole));
        }
    }
    is_stale
}

/// How far an image that was undistorted for one lens is off under another, where it is worst. A common change of
/// the focal length is no error.
fn off_px(was: &CameraModel, now: &CameraModel) -> f64 {
    let off = |share: f64| {
        let centre = DVec2::new(now.intrinsics.cx, now.intrinsics.cy);
        let ray = |lens: &CameraModel| lens.ray_in_cam(centre * share).map(|ray| ray.truncate());
        let refocused = ray(was)? * (was.intrinsics.fx / now.intrinsics.fx);
        Some(refocused.distance(ray(now)?) * now.intrinsics.fx)
    };
    // From the corner inwards: beyond its fold a lens says nothing.
    [0.0, 0.25, 0.5]
        .into_iter()
        .filter_map(off)
        .fold(0.0, f64::max)
}
