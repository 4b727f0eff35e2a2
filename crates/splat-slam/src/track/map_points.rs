//! What the geometry model triangulated in keyframes -> points with patches, to align frames with.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};

use glam::{DVec2, DVec3};

use crate::select::grey::GreyImage;
use crate::select::image_shift::small;
use crate::select::motion::grey_of_size;
use crate::select::optical_flow::Pyramid;
use crate::track::landmarks::{ALIKE, KeyframeView, TriangulatedLandmarks};
use crate::track::patches::{MapPoint, N_LEVELS};
use crate::visual_odometry::odometry::MAX_PX;
use crate::working_camera::WorkingCamera;
use splat_geometry::answer::SeenLandmark;
use splat_types::camera::Intrinsics;
use splat_types::covariance::Covariance;
use splat_types::transform::Rigid;

/// Points of a keyframe: some 1.7 KiB each.
const MAX_POINTS: usize = 160;
/// Cells along the longer side of an image, each of which gives its points in turn.
const N_CELLS: f64 = 16.0;
/// Keyframes with points: the newest ones.
const MAX_KEYFRAMES: usize = 120;
/// Points of a keyframe that are asked whether a camera sees it.
const N_ASKED: usize = 24;

/// A keyframe with points.
#[derive(Debug)]
pub(crate) struct PointKeyframe {
    pub(crate) id: u32,
    pub(crate) world_from_cam: Rigid,
    pub(crate) camera: WorkingCamera,
    pub(crate) covariance: Option<Covariance>,
    pub(crate) points: Vec<MapPoint>,
    /// To compare whole images by.
    pub(crate) small: GreyImage,
    source: Weak<[SeenLandmark]>,
    /// Unit of the points' depths, in that of the source.
    unit: f64,
}

/// All keyframes with points.
#[derive(Debug, Default)]
pub(crate) struct MapPoints {
    pub(crate) held: BTreeMap<u32, PointKeyframe>,
    /// The last frame that was aligned, with the points that it showed, as if it were a keyframe: the next one looks most like it.
    /// Its number is that of the keyframe that most of them are of.
    pub(crate) last: Option<PointKeyframe>,
}

impl MapPoints {
    /// Takes over what the map says.
    pub(crate) fn update(&mut self, views: &[KeyframeView]) {
        let newest = views.len().saturating_sub(MAX_KEYFRAMES);
        let mut before = std::mem::take(&mut self.held);
        for view in &views[newest..] {
            let id = view.keyframe.id;
            let kept = before.remove(&id);
            if let Some(held) = PointKeyframe::of(view, kept) {
                self.held.insert(id, held);
            }
        }
    }

    /// Keeps a frame that was aligned: its pose, and where it shows points of keyframes.
    pub(crate) fn keep_last(
        &mut self,
        (pyramid, camera): (&Pyramid, WorkingCamera),
        (reference, cam_from_world): (u32, &Rigid),
        points: impl Iterator<Item = (u32, DVec3, DVec2)>,
    ) {
        let patch = |(id, point_in_world, pixel): (u32, DVec3, DVec2)| {
            let point_in_cam = cam_from_world.transform_point(point_in_world);
            MapPoint::new(id, (pixel, point_in_cam), (pyramid, &camera))
        };
        self.last = Some(PointKeyframe {
            id: reference,
            world_from_cam: cam_from_world.inverse(),
            camera,
            covariance: None,
            points: points.filter_map(patch).collect(),
            small: small(pyramid.coarsest()),
            source: Weak::<[SeenLandmark; 0]>::new(),
            unit: 1.0,
        });
    }

    /// Those of whose points a camera sees most, best first.
    pub(crate) fn visible(
        &self,
        cam_from_world: &Rigid,
        camera: &Intrinsics,
        n: usize,
    ) -> Vec<&PointKeyframe> {
        let n_visible = |held: &PointKeyframe| held.n_visible(cam_from_world, camera);
        let ranked = self.held.values().map(|held| (held, n_visible(held)));
        let mut ranked: Vec<_> = ranked.filter(|(_, n_visible)| *n_visible > 0).collect();
        // Of equals the newest.
        ranked.sort_by(|a, b| b.1.cmp(&a.1).then(b.0.id.cmp(&a.0.id)));
        ranked.into_iter().take(n).map(|(held, _)| held).collect()
    }
}

impl PointKeyframe {
    fn of(view: &KeyframeView, kept: Option<Self>) -> Option<Self> {
        let landmarks = &view.landmarks;
        if landmarks.seen.is_empty() || !view.world_from_cam.is_finite() {
            return None;
        }
        let mut held = match kept {
            Some(mut kept) => {
                if !std::ptr::addr_eq(kept.source.as_ptr(), Arc::as_ptr(&landmarks.seen)) {
                    kept.take_depths(landmarks);
                }
                kept
            }
            None => Self::new(view)?,
        };
        held.take_camera(view);
        let ratio = landmarks.unit / held.unit;
        if ratio != 1.0 {
            held.points.iter_mut().for_each(|p| p.point_in_key *= ratio);
            held.unit = landmarks.unit;
        }
        (held.world_from_cam, held.covariance) = (view.world_from_cam, view.covariance);
        Some(held)
    }

    fn new(view: &KeyframeView) -> Option<Self> {
        let image = &view.keyframe.frame.image;
        if image.is_unloaded() {
            return None;
        }
        let frame_px = (image.width_px, image.height_px);
        let camera = WorkingCamera::of(&view.intrinsics, view.lens.as_ref(), frame_px)?;
        let grey = grey_of_size(image, MAX_PX);
        let camera = camera.resized((grey.width as u32, grey.height as u32));
        let to_working = grey.width as f64 / f64::from(image.width_px.max(1));
        let pyramid = Pyramid::without_gradients(grey, N_LEVELS - 1);
        let unit = view.landmarks.unit;
        let spread = spread_over(&view.landmarks.seen, frame_px);
        let point = |seen: &SeenLandmark| {
            let pixel = DVec2::from(seen.pixel.map(f64::from)) * to_working;
            let point_in_key = camera.pinhole.ray_in_cam(pixel) * f64::from(seen.depth) * unit;
            MapPoint::new(seen.id, (pixel, point_in_key), (&pyramid, &camera))
        };
        let points = spread.into_iter().filter_map(point).take(MAX_POINTS);
        Some(Self {
            id: view.keyframe.id,
            world_from_cam: view.world_from_cam,
            camera,
            covariance: view.covariance,
            points: points.collect(),
            small: small(pyramid.coarsest()),
            source: Arc::downgrade(&view.landmarks.seen),
            unit,
        })
    }

    /// The focal length was refined, or the lens: the points lie on other rays.
    fn take_camera(&mut self, view: &KeyframeView) {
        let pinhole = &self.camera.pinhole;
        let size = (pinhole.width_px, pinhole.height_px);
        let camera = WorkingCamera::of(&view.intrinsics, view.lens.as_ref(), size);
        let Some(camera) = camera.filter(|camera| !self.camera.is_alike(camera, ALIKE)) else {
            return;
        };
        for point in &mut self.points {
            let depth = point.point_in_key.z;
            point.point_in_key = camera.pinhole.ray_in_cam(point.pixel) * depth;
        }
        self.camera = camera;
    }

    /// The model has triangulated again: what is known keeps its patches.
    fn take_depths(&mut self, landmarks: &TriangulatedLandmarks) {
        let depths = landmarks.seen.iter().map(|seen| (seen.id, seen.depth));
        let depths: BTreeMap<u32, f32> = depths.filter(|(_, depth)| *depth > 0.0).collect();
        self.points.retain_mut(|point| {
            let Some(depth) = depths.get(&point.id) else {
                return false;
            };
            point.point_in_key *= f64::from(*depth) * landmarks.unit / point.point_in_key.z;
            true
        });
        (self.source, self.unit) = (Arc::downgrade(&landmarks.seen), landmarks.unit);
    }

    /// Estimate from some points spread over all.
    fn n_visible(&self, cam_from_world: &Rigid, camera: &Intrinsics) -> usize {
        let cam_from_key = *cam_from_world * self.world_from_cam;
        let stride = self.points.len().div_ceil(N_ASKED).max(1);
        let asked = self.points.iter().step_by(stride);
        let cameras = [&self.camera.pinhole, camera];
        let n = asked.filter(|point| point.warp(&cam_from_key, cameras).is_some());
        (n.count() * stride).min(self.points.len())
    }

    pub(crate) fn median_depth(&self) -> f64 {
        let mut depths: Vec<f64> = self.points.iter().map(|p| p.point_in_key.z).collect();
        splat_geometry::stats::median(&mut depths).unwrap_or(1.0)
    }

    pub(crate) fn point_in_world(&self, point: &MapPoint) -> DVec3 {
        self.world_from_cam.transform_point(point.point_in_key)
    }
}

/// The same, in an order in which any first part of them is spread over the image.
fn spread_over(seen: &[SeenLandmark], size_px: (u32, u32)) -> Vec<&SeenLandmark> {
    let cell_px = f64::from(size_px.0.max(size_px.1)) / N_CELLS;
    let mut cells: BTreeMap<[u32; 2], Vec<&SeenLandmark>> = BTreeMap::new();
    for landmark in seen.iter().filter(|seen| seen.depth > 0.0) {
        let cell = landmark.pixel.map(|v| (f64::from(v) / cell_px) as u32);
        cells.entry(cell).or_default().push(landmark);
    }
    let deepest = cells.values().map(Vec::len).max().unwrap_or(0);
    let rounds = (0..deepest).flat_map(|round| {
        let nth = cells
            .values()
            .filter_map(move |cell| cell.get(round).copied());
        nth.collect::<Vec<_>>()
    });
    let mut known = BTreeSet::new();
    rounds.filter(|seen| known.insert(seen.id)).collect()
}
