//! Views of a window with their matches, and what the corrections of their poses share.

use glam::{DVec2, DVec3};

use crate::answer::View;
use crate::stats::median;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Reprojection error up to which a triangulated point is one, in pixels of an image of 640.
pub(crate) const MAX_POINT_ERROR_PX: f64 = 3.0;

/// A view as the methods see it: pixels and lens of the working image.
#[derive(Debug, Clone)]
pub struct WindowView {
    pub cam_from_submap: Rigid,
    pub lens: Intrinsics,
    /// Its pose is given.
    pub is_held: bool,
    pub pixels: Vec<DVec2>,
}

/// Matches between two views, `first < second`, as (feature of first, feature of second).
#[derive(Debug, Clone)]
pub struct Pair {
    pub first: usize,
    pub second: usize,
    pub features: Vec<(u32, u32)>,
}

/// Views with all that was matched between them.
#[derive(Debug, Clone, Default)]
pub struct Matched {
    pub views: Vec<WindowView>,
    pub pairs: Vec<Pair>,
}

/// What is known beforehand of a window.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct InitialPoses {
    /// So many of the first views are held where they are.
    pub n_held: usize,
    /// The focal length is measured and stays.
    pub is_calibrated: bool,
}

/// What a correction did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Refined {
    pub n_pairs: usize,
    pub n_matches: usize,
    /// Median symmetric epipolar distance in pixels of the working image; `None` without matches.
    pub before_px: Option<f64>,
    pub after_px: Option<f64>,
    /// Factor on each view's depth; 1 where nothing was learnt.
    pub depth_factors: Vec<f64>,
    /// Why something was left as it was, one plain sentence.
    pub note: Option<String>,
}

pub(crate) fn write_back(views: &mut [View], matched: &Matched) {
    for (view, aligned_view) in views.iter_mut().zip(&matched.views) {
        if aligned_view.is_held {
            continue;
        }
        view.submap_from_cam = aligned_view.cam_from_submap.inverse();
        let (w, h) = (view.intrinsics.width_px, view.intrinsics.height_px);
        let lens = aligned_view.lens.resized(w, h);
        if lens.is_plausible() {
            view.intrinsics = lens;
        }
    }
}

/// The length that counts as 1: the median depth.
pub(crate) fn unit(views: &[View]) -> f64 {
    let medians = views.iter().filter_map(|v| v.depth.median().map(f64::from));
    median(&mut medians.collect::<Vec<_>>()).unwrap_or(1.0)
}

pub(crate) fn longest_px(matched: &Matched) -> f64 {
    let sides = matched
        .views
        .iter()
        .map(|s| s.lens.width_px.max(s.lens.height_px));
    f64::from(sides.max().unwrap_or(1))
}

pub(crate) fn depth_at(depth: &DepthMap, lens: &Intrinsics, pixel: DVec2) -> Option<f64> {
    let (w, h) = (f64::from(lens.width_px), f64::from(lens.height_px));
    let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h;
    if !is_inside {
        return None;
    }
    let x = (pixel.x / w * f64::from(depth.width_px)) as usize;
    let y = (pixel.y / h * f64::from(depth.height_px)) as usize;
    let found = depth.verified(y * depth.width_px as usize + x)?;
    Some(f64::from(found.0))
}

/// Mean distance of the cameras from their mean.
pub(crate) fn camera_spread(cam_from_submap: &[Rigid]) -> f64 {
    let centres: Vec<DVec3> = cam_from_submap
        .iter()
        .map(|pose| pose.inverse().translation)
        .collect();
    let n = centres.len().max(1) as f64;
    let mean = centres.iter().sum::<DVec3>() / n;
    centres.iter().map(|c| c.distance(mean)).sum::<f64>() / n
}
