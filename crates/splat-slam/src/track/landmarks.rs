//! Keyframes that the map has registered -> landmarks to track by, in each keyframe's own frame, so that they move with it.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use glam::{DVec2, DVec3};

use crate::track::observation::{Observation, UndistortedObservation};
use crate::track::params::TrackParams;
use crate::working_camera::WorkingCamera;
use splat_geometry::answer::SeenLandmark;
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::covariance::Covariance;
use splat_types::depth::DepthMap;
use splat_types::frame::Keyframe;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Relative difference of neighbouring depths from which a corner may lie on either side of an edge.
const MAX_DEPTH_STEP: f32 = 0.08;
/// Landmarks of a keyframe that are asked whether a camera sees it.
const N_ASKED: usize = 24;
/// Landmarks seen at a larger angle, or so many times nearer or farther, look otherwise.
const MIN_ANGLE_COSINE: f64 = 0.6;
const MAX_ZOOM: f64 = 2.5;

/// Landmarks are those of a camera whose pixels are off by less than this share of the longer side.
pub(crate) const ALIKE: f64 = 3e-4;

/// What the map says of one of its keyframes.
#[derive(Debug, Clone)]
pub struct KeyframeView {
    pub keyframe: Arc<Keyframe>,
    pub world_from_cam: Rigid,
    pub intrinsics: Intrinsics,
    /// Of the keyframe's image, where that is no pinhole's.
    pub lens: Option<CameraModel>,
    /// In the map's unit.
    pub depth: Arc<DepthMap>,
    pub landmarks: TriangulatedLandmarks,
    /// Of its pose, where known.
    pub covariance: Option<Covariance>,
}

/// Landmarks that the geometry model has triangulated, where a keyframe shows them.
#[derive(Debug, Clone)]
pub struct TriangulatedLandmarks {
    pub seen: Arc<[SeenLandmark]>,
    /// Units of the map in one of their depths.
    pub unit: f64,
}

impl TriangulatedLandmarks {
    pub fn none() -> Self {
        Self {
            seen: Arc::new([]),
            unit: 1.0,
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Landmark {
    pub(crate) point_in_cam: DVec3,
    pub(crate) bits: [u64; 4],
    pub(crate) level: f32,
}

/// A keyframe with landmarks; some 80 KiB with 600 corners.
#[derive(Debug)]
pub(crate) struct StoredKeyframe {
    pub(crate) id: u32,
    pub(crate) seen: Arc<Observation>,
    pub(crate) world_from_cam: Rigid,
    pub(crate) camera: WorkingCamera,
    pub(crate) covariance: Option<Covariance>,
    pub(crate) landmarks: Vec<Landmark>,
    /// How often the present unit of its depths goes into that of its first ones.
    pub(crate) unit: f64,
    pub(crate) depth: Weak<DepthMap>,
    /// Corner number and depth of the landmarks.
    pub(crate) depths: Vec<(u32, f32)>,
}

/// All keyframes that can be tracked by.
#[derive(Debug, Default)]
pub(crate) struct Landmarks {
    pub(crate) held: BTreeMap<u32, StoredKeyframe>,
    /// Those that the map has no place for, such as those of a submap that is parked: they may come back with it, and their
    /// images need not be there by then.
    aside: BTreeMap<u32, StoredKeyframe>,
    /// Of keyframes of the map whose depth is still to come; in order.
    bare: Vec<Stamp>,
    /// Depth at which no corner lies. Corners take most of the time of a frame to find: they are not looked for again until there is
    /// other depth.
    barren: BTreeMap<u32, Weak<DepthMap>>,
}

/// Which frames have landmarks on both sides.
#[derive(Debug)]
pub(crate) struct Reach {
    held: Vec<Stamp>,
    bare: Vec<Stamp>,
}

impl Reach {
    /// Whether a frame lies between two keyframes with landmarks, or before the first, and none beside it is still to get
    /// its own: farther ones, carried that far, let wrong poses through.
    pub(crate) fn has(&self, stamp: Stamp) -> bool {
        let next = self.held.partition_point(|held| *held < stamp);
        let Some(after) = self.held.get(next) else {
            return false;
        };
        let next_bare = self.bare.partition_point(|bare| *bare < stamp);
        let (before, bare_before) = (
            next.checked_sub(1).map(|ix| self.held[ix]),
            next_bare.checked_sub(1).map(|ix| self.bare[ix]),
        );
        let is_bare_after = self.bare.get(next_bare).is_some_and(|bare| bare < after);
        *after == stamp || (!is_bare_after && bare_before <= before)
    }
}

impl Landmarks {
    /// Takes over what the map says; `seen_before` has what was kept of frames by their number.
    pub(crate) fn update(
        &mut self,
        views: &[KeyframeView],
        seen_before: &dyn Fn(u64) -> Option<Arc<Observation>>,
        params: &TrackParams,
    ) {
        let ids: BTreeMap<u32, &KeyframeView> = views.iter().map(|v| (v.keyframe.id, v)).collect();
        let (held, gone) = std::mem::take(&mut self.held)
            .into_iter()
            .partition(|(id, _)| ids.contains_key(id));
        self.held = held;
        self.aside.extend::<BTreeMap<u32, StoredKeyframe>>(gone);
        self.bare.clear();
        self.barren.retain(|id, _| ids.contains_key(id));
        for (id, view) in ids {
            let held = self.held.remove(&id).or_else(|| self.aside.remove(&id));
            let seen = match &held {
                Some(held) => Arc::clone(&held.seen),
                None if view.depth.width_px == 0 => {
                    self.bare.push(view.keyframe.frame.stamp);
                    continue;
                }
                None if self.is_barren(id, &view.depth) => continue,
                None => seen_before(view.keyframe.frame.seq)
                    .unwrap_or_else(|| Arc::new(Observation::of(&view.keyframe.frame, params))),
            };
            match StoredKeyframe::new(view, seen, held, params) {
                Some(held) => {
                    self.barren.remove(&id);
                    self.held.insert(id, held);
                }
                None => {
                    self.barren.insert(id, Arc::downgrade(&view.depth));
                }
            }
        }
        while self.held.len() > params.max_keyframes {
            self.drop_one();
        }
        while self.held.len() + self.aside.len() > params.max_keyframes {
            self.aside.pop_first();
        }
        self.bare.sort_unstable();
    }

    fn is_barren(&self, id: u32, depth: &Arc<DepthMap>) -> bool {
        let known = self.barren.get(&id);
        known.is_some_and(|known| std::ptr::eq(known.as_ptr(), Arc::as_ptr(depth)))
    }

    pub(crate) fn reach(&self) -> Reach {
        let mut held: Vec<Stamp> = self.held.values().map(|held| held.seen.stamp).collect();
        held.sort_unstable();
        Reach {
            held,
            bare: self.bare.clone(),
        }
    }

    /// The last keyframes, which are in use, stay; of the others the one that is nearest to the one before it goes.
    fn drop_one(&mut self) {
        let ids: Vec<u32> = self.held.keys().copied().collect();
        let free = &ids[..(ids.len() * 3 / 4).max(1)];
        let gap = |pair: &[u32]| {
            let (a, b) = (&self.held[&pair[0]], &self.held[&pair[1]]);
            let away = (a.world_from_cam.translation - b.world_from_cam.translation).length();
            let depth = a.median_depth().max(1e-9);
            (
                away / depth + a.world_from_cam.angle_to(&b.world_from_cam),
                pair[1],
            )
        };
        let nearest = free.windows(2).map(gap).min_by(|a, b| a.0.total_cmp(&b.0));
        let id = nearest.map_or(ids[0], |(_, id)| id);
        self.held.remove(&id);
    }

    /// Those that a camera sees most of, best first: (keyframe, landmarks that may be in the image).
    pub(crate) fn visible(
        &self,
        cam_from_world: &Rigid,
        camera: &Intrinsics,
        n: usize,
    ) -> Vec<(&StoredKeyframe, usize)> {
        let mut ranked: Vec<(&StoredKeyframe, usize)> = self
            .held
            .values()
            .map(|held| (held, held.n_visible(cam_from_world, camera)))
            .filter(|(_, n_visible)| *n_visible > 0)
            .collect();
        // Of equals the newest.
        ranked.sort_by(|a, b| b.1.cmp(&a.1).then(b.0.id.cmp(&a.0.id)));
        ranked.truncate(n);
        ranked
    }
}

impl StoredKeyframe {
    /// `None` where the view has no depth and had none before.
    fn new(
        view: &KeyframeView,
        seen: Arc<Observation>,
        before: Option<Self>,
        params: &TrackParams,
    ) -> Option<Self> {
        let camera = WorkingCamera::of(&view.intrinsics, view.lens.as_ref(), seen.working_px)?;
        let mut held = Self {
            id: view.keyframe.id,
            seen,
            world_from_cam: view.world_from_cam,
            camera,
            covariance: view.covariance,
            landmarks: Vec::new(),
            unit: before.as_ref().map_or(1.0, |before| before.unit),
            depth: Arc::downgrade(&view.depth),
            depths: Vec::new(),
        };
        if let Some(before) = before {
            let is_alike = before.camera.is_alike(&camera, ALIKE);
            if (is_alike && before.depth.ptr_eq(&held.depth)) || view.depth.width_px == 0 {
                // Adjustment refines all focal lengths a little each time.
                held.camera = before.camera;
                (held.landmarks, held.depths) = (before.landmarks, before.depths);
                return view.world_from_cam.is_finite().then_some(held);
            }
            held.find(&view.depth, params.max_landmarks);
            held.unit *= ratio(&before.depths, &held.depths);
        } else {
            held.find(&view.depth, params.max_landmarks);
        }
        let is_usable = !held.landmarks.is_empty() && view.world_from_cam.is_finite();
        is_usable.then_some(held)
    }

    /// Corners with a depth become landmarks; of too many evenly chosen ones.
    fn find(&mut self, depth: &DepthMap, max_landmarks: usize) {
        let undistorted = UndistortedObservation::of(&self.seen, self.camera);
        let pinhole = &self.camera.pinhole;
        let to_depth = DVec2::new(
            f64::from(depth.width_px) / f64::from(pinhole.width_px),
            f64::from(depth.height_px) / f64::from(pinhole.height_px),
        );
        let depth_at = |i: usize| {
            let at = undistorted.pixels[i] * to_depth;
            Some((i as u32, surface_depth(depth, at)?))
        };
        let all: Vec<(u32, f32)> = (0..self.seen.len()).filter_map(depth_at).collect();
        let n = all.len().min(max_landmarks);
        self.depths = (0..n).map(|k| all[k * all.len() / n]).collect();
        let landmark = |&(i, z): &(u32, f32)| Landmark {
            point_in_cam: pinhole.ray_in_cam(undistorted.pixels[i as usize]) * f64::from(z),
            bits: self.seen.bits[i as usize],
            level: self.seen.levels[i as usize],
        };
        self.landmarks = self.depths.iter().map(landmark).collect();
    }

    pub(crate) fn median_depth(&self) -> f64 {
        let mut depths: Vec<f32> = self.depths.iter().map(|(_, z)| *z).collect();
        if depths.is_empty() {
            return 1.0;
        }
        let middle = depths.len() / 2;
        f64::from(*depths.select_nth_unstable_by(middle, f32::total_cmp).1)
    }

    /// Estimate from some landmarks spread over all.
    fn n_visible(&self, cam_from_world: &Rigid, camera: &Intrinsics) -> usize {
        let cam_from_key = *cam_from_world * self.world_from_cam;
        let stride = self.landmarks.len().div_ceil(N_ASKED).max(1);
        let asked = self.landmarks.iter().step_by(stride);
        let n = asked
            .filter(|landmark| shown(landmark, &cam_from_key, camera).is_some())
            .count();
        (n * stride).min(self.landmarks.len())
    }
}

/// Where a camera shows a landmark of a keyframe and at which level; `None` outside the image, or where it is seen
/// from too far aside or at too different a size.
pub(crate) fn shown(
    landmark: &Landmark,
    cam_from_key: &Rigid,
    camera: &Intrinsics,
) -> Option<(DVec2, f32)> {
    let p = cam_from_key.transform_point(landmark.point_in_cam);
    let at = camera.project(p)?;
    let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height) {
        return None;
    }
    let (before, after) = (landmark.point_in_cam.length(), p.length());
    let zoom = before / after;
    // The ray from the keyframe, in the camera's axes.
    let cosine = (cam_from_key.rotation * landmark.point_in_cam).dot(p) / (before * after);
    let is_alike = cosine >= MIN_ANGLE_COSINE && (1.0 / MAX_ZOOM..=MAX_ZOOM).contains(&zoom);
    is_alike.then_some((at, landmark.level * zoom as f32))
}

/// Depth of a pixel of the depth map, centres at +0.5: linear in its inverse between the four nearest, which planes are.
/// `None` at edges and beside pixels without one.
fn surface_depth(depth: &DepthMap, at: DVec2) -> Option<f32> {
    let corner = at - 0.5;
    let (width, height) = (f64::from(depth.width_px), f64::from(depth.height_px));
    // Not a number fails, too.
    let is_inside = corner.x >= 0.0 && corner.y >= 0.0 && at.x < width - 0.5 && at.y < height - 0.5;
    if !is_inside {
        return None;
    }
    let (x, y) = (corner.x as usize, corner.y as usize);
    let (u, v) = (corner.x.fract() as f32, corner.y.fract() as f32);
    let row = depth.width_px as usize;
    let nearest = [
        y * row + x,
        y * row + x + 1,
        (y + 1) * row + x,
        (y + 1) * row + x + 1,
    ];
    let mut inverse = 0.0;
    let (mut low, mut high) = (f32::INFINITY, 0.0_f32);
    let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
    for (pixel, weight) in nearest.into_iter().zip(weights) {
        let (z, _) = depth.verified(pixel)?;
        inverse += weight / z;
        (low, high) = (low.min(z), high.max(z));
    }
    (high <= low * (1.0 + MAX_DEPTH_STEP) && inverse > 0.0).then_some(1.0 / inverse)
}

/// Median ratio of depths (second over first) of the corners that both have.
fn ratio(first: &[(u32, f32)], second: &[(u32, f32)]) -> f64 {
    let known: BTreeMap<u32, f32> = first.iter().copied().collect();
    let mut ratios: Vec<f64> = second
        .iter()
        .filter_map(|(i, z)| Some(f64::from(*z) / f64::from(*known.get(i)?)))
        .collect();
    if ratios.is_empty() {
        return 1.0;
    }
    let middle = ratios.len() / 2;
    *ratios.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slope(width_px: u32, height_px: u32) -> DepthMap {
        // A plane: linear in inverse depth.
        let n = (width_px * height_px) as usize;
        let depth = |i: usize| 1.0 / (0.2 + 0.002 * (i % width_px as usize) as f32);
        DepthMap {
            width_px,
            height_px,
            depth: (0..n).map(depth).collect(),
            confidence: vec![1.0; n],
        }
    }

    #[test]
    fn depth_between_pixels_is_that_of_the_plane_through_them() {
        let depth = slope(40, 30);
        let found = surface_depth(&depth, DVec2::new(12.8, 9.3)).unwrap();
        assert!((1.0 / found - (0.2 + 0.002 * 12.3)).abs() < 1e-6);
        for outside in [DVec2::new(0.2, 5.0), DVec2::new(39.8, 5.0), DVec2::NAN] {
            assert_eq!(surface_depth(&depth, outside), None);
        }
    }

    #[test]
    fn edges_and_holes_give_no_landmark() {
        let mut depth = slope(40, 30);
        depth.depth[5 * 40 + 10] *= 1.3;
        assert_eq!(surface_depth(&depth, DVec2::new(10.9, 5.9)), None);
        depth.confidence[20 * 40 + 20] = 0.0;
        assert_eq!(surface_depth(&depth, DVec2::new(20.2, 20.2)), None);
        assert!(surface_depth(&depth, DVec2::new(30.0, 20.2)).is_some());
        assert_eq!(surface_depth(&DepthMap::none(), DVec2::ONE), None);
    }

    #[test]
    fn a_new_unit_is_given_by_the_corners_that_both_have() {
        let first: Vec<(u32, f32)> = (0..9).map(|i| (i, 2.0)).collect();
        let mut second: Vec<(u32, f32)> = (4..20).map(|i| (i, 3.0)).collect();
        second[0].1 = 90.0;
        assert!((ratio(&first, &second) - 1.5).abs() < 1e-6);
        assert_eq!(ratio(&first, &[]), 1.0);
    }
}
