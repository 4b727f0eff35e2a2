//! The scene -> what changed since it was last reported: new views, moved poses, why views are missing.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};

use crate::answer::{MetricUnit, PoseQuality, PoseUpdate};
use crate::optim::pose_covariance::pose_covariance;
use crate::sfm::initialize::{Start, parallax_deg};
use crate::sfm::reconstruction::{NONE, Reconstruction};
use crate::stats::median;
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::frame::SecondImage;
use splat_types::transform::Rigid;

/// Exact words of the final error for a camera at rest; other modules and users look for them.
pub const NO_PARALLAX: &str = "no parallax was seen between keyframes";
/// A pose that moved less needs no reporting: 0.05 px at 500 px focal length, and as much of the median depth.
const MOVED: f64 = 1e-4;
/// Landmarks of a view that show by how much what it sees has grown, at least and at most, and growth that is worth reporting.
const MIN_DEPTHS: usize = 8;
const MAX_DEPTHS: usize = 64;
const RESIZED: f64 = 2e-3;

/// A landmark in a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkObservation {
    pub point_in_submap: DVec3,
    /// The same number for the same point in all views.
    pub landmark: u32,
    /// In the keyframe's image, undistorted where its lens bends.
    pub pixel: DVec2,
}

/// A keyframe that sees the same landmarks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    pub keyframe_id: u32,
    pub n_shared: u32,
    /// Median angle between the two rays to a shared landmark.
    pub angle_deg: f64,
}

/// A registered keyframe without dense depth.
#[derive(Debug, Clone)]
pub struct SparseView {
    pub keyframe_id: u32,
    pub submap: u32,
    /// At the size of the keyframe's image.
    pub intrinsics: Intrinsics,
    /// As in `View`.
    pub lens: Option<CameraModel>,
    pub submap_from_cam: Rigid,
    pub health: PoseQuality,
    pub landmarks: Vec<LandmarkObservation>,
    /// What a sensor measured, in the unit of the submap, in the pixels of the keyframe's image.
    pub measured: Option<Arc<DepthMap>>,
    /// The second camera's image, where the unit of the submap is the metre.
    pub second: Option<Arc<SecondImage>>,
    /// Most useful first: many shared landmarks, seen at an angle of some degrees.
    pub neighbours: Vec<Neighbour>,
}

#[derive(Debug, Clone, Default)]
pub struct SparseBatch {
    pub batch_id: u32,
    pub views: Vec<SparseView>,
    /// Views given earlier that moved, or whose focal length did.
    pub revised: Vec<PoseUpdate>,
    /// As in `GeometryBatch`.
    pub is_loop: bool,
    pub metric: Option<MetricUnit>,
    pub note: Option<String>,
}

/// What has been reported for each keyframe.
#[derive(Debug, Default)]
pub(crate) struct Reported {
    cameras: BTreeMap<usize, PoseUpdate>,
    /// Some of the landmarks that each saw then, and their distance along its axis.
    depths: BTreeMap<usize, Vec<(u32, f64)>>,
}

impl Reported {
    /// Views of views registered since last time and of `again`, and poses that moved.
    pub(crate) fn changes(&mut self, scene: &Reconstruction, again: &[usize]) -> SparseBatch {
        let mut out = SparseBatch::default();
        for (view_ix, sfm_view) in scene.views.iter().enumerate() {
            let Some(registered) = &sfm_view.registered else {
                continue;
            };
            let keyframe_id = sfm_view.keyframe.id;
            let Some(intrinsics) = scene.intrinsics_of(keyframe_id) else {
                continue;
            };
            let here = PoseUpdate {
                keyframe_id,
                submap: registered.submap,
                intrinsics,
                submap_from_cam: registered.cam_from_world.inverse(),
                depth_factor: self.depth_factor(scene, view_ix),
            };
            let before = self.cameras.insert(view_ix, here);
            if before.is_none() || again.contains(&view_ix) {
                out.views.extend(view(scene, view_ix));
                self.depths.insert(view_ix, depths(scene, view_ix));
            }
            if let Some(before) = before {
                let (old, new) = (before.submap_from_cam, here.submap_from_cam);
                let moved = before.submap != here.submap
                    || old.angle_to(&new) > MOVED
                    || old.translation.distance(new.translation) > MOVED
                    || (before.intrinsics.fx / intrinsics.fx - 1.0).abs() > MOVED
                    || (here.depth_factor - 1.0).abs() > RESIZED;
                if moved {
                    out.revised.push(here);
                    self.depths.insert(view_ix, depths(scene, view_ix));
                } else {
                    // Small moves add up: compare with what was reported.
                    self.cameras.insert(view_ix, before);
                }
            }
        }
        out
    }
}

impl Reported {
    /// How much farther a view sees the same landmarks than when it was reported; 1 where that is within their noise.
    fn depth_factor(&self, scene: &Reconstruction, view_ix: usize) -> f64 {
        let Some(registered) = &scene.views[view_ix].registered else {
            return 1.0;
        };
        let reported = self.depths.get(&view_ix).map_or(&[][..], Vec::as_slice);
        let log = |&(landmark, then): &(u32, f64)| {
            let landmark = &scene.landmarks[landmark as usize];
            let is_seen = landmark.seen.iter().any(|at| at.0 as usize == view_ix);
            let now = registered.cam_from_world.transform_point(landmark.point).z;
            (is_seen && now > 0.0 && then > 0.0).then(|| (now / then).ln())
        };
        let mut logs: Vec<f64> = reported.iter().filter_map(log).collect();
        let is_enough = logs.len() >= MIN_DEPTHS;
        let factor = median(&mut logs).filter(|_| is_enough).unwrap_or(0.0).exp();
        if (factor - 1.0).abs() > RESIZED {
            factor
        } else {
            1.0
        }
    }
}

/// Landmarks of a view and their distance, evenly picked.
fn depths(scene: &Reconstruction, view_ix: usize) -> Vec<(u32, f64)> {
    let view = &scene.views[view_ix];
    let Some(registered) = &view.registered else {
        return Vec::new();
    };
    let seen: Vec<u32> = view
        .landmark_of
        .iter()
        .copied()
        .filter(|l| *l != NONE)
        .collect();
    let stride = seen.len().div_ceil(MAX_DEPTHS).max(1);
    let z = |l: u32| {
        registered
            .cam_from_world
            .transform_point(scene.landmarks[l as usize].point)
            .z
    };
    seen.into_iter()
        .step_by(stride)
        .map(|l| (l, z(l)))
        .collect()
}

/// One sentence on what is missing; `None` when all is registered in one frame.
pub(crate) fn note(scene: &Reconstruction, start: Option<Start>) -> Option<String> {
    let waiting: Vec<u32> = scene
        .views
        .iter()
        .filter(|s| s.registered.is_none())
        .map(|s| s.keyframe.id)
        .collect();
    if waiting.len() == scene.views.len() {
        let why = match start {
            Some(Start::NoMatches) => ": their images share too few distinct points",
            Some(Start::Unstable) => " that a scene could be built on",
            _ => "",
        };
        return Some(format!("{NO_PARALLAX}{why}"));
    }
    let n_submaps = scene.submaps.iter().filter(|c| !c.views.is_empty()).count();
    if waiting.is_empty() {
        return (n_submaps > 1)
            .then(|| format!("the keyframes form {n_submaps} parts that share too few landmarks"));
    }
    let shown: Vec<String> = waiting.iter().take(10).map(u32::to_string).collect();
    let more = if waiting.len() > 10 { ", ..." } else { "" };
    Some(format!(
        "{} of {} keyframes wait for landmarks that agree: {}{more}",
        waiting.len(),
        scene.views.len(),
        shown.join(", ")
    ))
}

/// A registered view as the scene knows it by now.
pub(crate) fn view(scene: &Reconstruction, view_ix: usize) -> Option<SparseView> {
    let view = &scene.views[view_ix];
    let registered = view.registered.as_ref()?;
    let intrinsics = scene.intrinsics_of(view.keyframe.id)?;
    // Two pinholes of one camera that differ in size, and where the image was undistorted in their view.
    let to_image = DVec2::new(intrinsics.fx / view.lens.fx, intrinsics.fy / view.lens.fy);
    let centre = DVec2::new(view.lens.cx, view.lens.cy);
    let in_image =
        |pixel: DVec2| (pixel - centre) * to_image + DVec2::new(intrinsics.cx, intrinsics.cy);
    let mut landmarks = Vec::new();
    let (mut errors, mut observations) = (Vec::new(), Vec::new());
    for (feature, &landmark) in view
        .landmark_of
        .iter()
        .enumerate()
        .filter(|(_, l)| **l != NONE)
    {
        let at = (view_ix as u32, feature as u32);
        let point_in_submap = scene.landmarks[landmark as usize].point;
        errors.extend(scene.observation(at).map(|s| s.error_px(point_in_submap)));
        observations.push((point_in_submap, scene.pixel(at)));
        landmarks.push(LandmarkObservation {
            point_in_submap,
            landmark,
            pixel: in_image(scene.pixel(at)),
        });
    }
    let health = PoseQuality {
        n_inliers: landmarks.len() as u32,
        parallax_deg: parallax_deg(scene, view_ix),
        reprojection_px: median(&mut errors).unwrap_or(0.0),
        covariance: pose_covariance(&registered.cam_from_world, &view.lens, &observations),
    };
    Some(SparseView {
        keyframe_id: view.keyframe.id,
        submap: registered.submap,
        intrinsics,
        lens: scene.undistorted_of(view).map(|s| s.0),
        submap_from_cam: registered.cam_from_world.inverse(),
        health,
        landmarks,
        measured: scene.measured_map(view_ix),
        second: scene.second_image(view_ix),
        neighbours: neighbours(scene, view_ix),
    })
}

fn neighbours(scene: &Reconstruction, view_ix: usize) -> Vec<Neighbour> {
    let Some(own) = scene.centre(view_ix) else {
        return Vec::new();
    };
    let centres: Vec<Option<DVec3>> = (0..scene.views.len()).map(|ix| scene.centre(ix)).collect();
    // Of each view, sine and cosine of the angles, up to a factor.
    let mut angles: BTreeMap<u32, Vec<[f64; 2]>> = BTreeMap::new();
    for &landmark in scene.views[view_ix]
        .landmark_of
        .iter()
        .filter(|l| **l != NONE)
    {
        let landmark = &scene.landmarks[landmark as usize];
        let a = own - landmark.point;
        for &(other, _) in landmark.seen.iter().filter(|s| s.0 as usize != view_ix) {
            let Some(centre) = centres[other as usize] else {
                continue;
            };
            let b = centre - landmark.point;
            let angle = [a.cross(b).length(), a.dot(b)];
            angles.entry(other).or_default().push(angle);
        }
    }
    let neighbour = |(other, mut angles): (u32, Vec<[f64; 2]>)| Neighbour {
        keyframe_id: scene.views[other as usize].keyframe.id,
        n_shared: angles.len() as u32,
        angle_deg: median_angle_deg(&mut angles),
    };
    // Matching wants an angle of about 6 degrees (GEOMETRY.md 3): less gives no depth, more changes the image.
    let worth = |n: &Neighbour| {
        let off = (n.angle_deg.max(0.01) / 6.0).ln();
        f64::from(n.n_shared) * (-0.5 * off * off).exp()
    };
    let mut found: Vec<Neighbour> = angles.into_iter().map(neighbour).collect();
    found.sort_by(|a, b| {
        worth(b)
            .total_cmp(&worth(a))
            .then(a.keyframe_id.cmp(&b.keyframe_id))
    });
    found
}

/// Of angles from 0 to 180 degrees, each given by its sine and cosine up to a factor; 0 of none.
fn median_angle_deg(angles: &mut [[f64; 2]]) -> f64 {
    if angles.is_empty() {
        return 0.0;
    }
    // The sine of the difference of two angles says which is larger, and takes no arctangent.
    let middle = angles.len() / 2;
    let order = |a: &[f64; 2], b: &[f64; 2]| (a[0] * b[1]).total_cmp(&(b[0] * a[1]));
    let [sine, cosine] = *angles.select_nth_unstable_by(middle, order).1;
    sine.atan2(cosine).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::median_angle_deg;

    #[test]
    fn the_middle_angle_is_found_whatever_the_lengths() {
        let mut angles: Vec<[f64; 2]> = (0..181)
            .map(|deg| {
                let (sine, cosine) = f64::from(deg * 37 % 181).to_radians().sin_cos();
                [sine, cosine].map(|v| v * f64::from(1 + deg % 7))
            })
            .collect();
        assert!((median_angle_deg(&mut angles) - 90.0).abs() < 1e-9);
        assert!((median_angle_deg(&mut [[3.0, 3.0]]) - 45.0).abs() < 1e-9);
        assert_eq!(median_angle_deg(&mut []), 0.0);
    }
}
