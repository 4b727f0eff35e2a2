//! Registered keyframes with landmarks -> views with depth: chooses ranges and neighbours for the stereo.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::answer::{GeometryBatch, Observations, PoseStd, PoseUpdate, SeenLandmark, View};
use crate::mvs::depth_stream::{DepthStream, SweepJob, SweptDepth};
use crate::mvs::neighbours::depth_range;
use crate::mvs::params::MvsParams;
use crate::mvs::view::MvsView;
use crate::sfm::depth_schedule::{DepthSchedule, Due};
use crate::sfm::feature_depths::fill_measured;
use crate::sfm::updates::{SparseBatch, SparseView};
use splat_gpu::error::GpuError;
use splat_image::undistort::Undistorter;
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Images and raw depth are held of so many keyframes, about 1 MB each: matching reaches no further back.
const MAX_HELD: usize = 32;
/// Poses that moved its pixels by more since the sweep make a depth map out of date.
const MAX_DRIFT_PX: f64 = 1.0;

/// Stereo for a stream of keyframes.
#[derive(Debug)]
pub(crate) struct Densifier {
    params: MvsParams,
    /// Standard deviation of a depth sensor, in 1/m.
    depth_noise: f64,
    state: DepthStream,
    /// Of all views so far: the lens by which the image was undistorted.
    lenses: BTreeMap<u32, Option<CameraModel>>,
    /// Live: views whose poses were reported before their depth.
    schedule: DepthSchedule,
    /// The view whose sweep is on its way.
    at_work: Option<SparseView>,
}

/// What there is to do for the depth of reported views.
#[derive(Debug)]
pub(crate) enum NextDepth {
    /// The view's depth is known as it stands.
    Known(Box<View>),
    Sweep(Box<SweepJob>),
}

impl Densifier {
    pub(crate) fn new(params: &MvsParams, depth_noise: f64) -> Result<Self, GpuError> {
        Ok(Self {
            params: params.clone(),
            depth_noise,
            state: DepthStream::new(params.clone(), MAX_HELD)?,
            lenses: BTreeMap::new(),
            schedule: DepthSchedule::new(MAX_HELD),
            at_work: None,
        })
    }

    /// `image_of` gives the image of a keyframe.
    pub(crate) fn densify(
        &mut self,
        sparse: &SparseBatch,
        image_of: &dyn Fn(u32) -> Option<Arc<RgbImage>>,
    ) -> GeometryBatch {
        self.take_in(sparse, image_of);
        for view in &sparse.views {
            self.sweep(view);
        }
        let views = sparse.views.iter().map(|view| self.view(view)).collect();
        reported(sparse, views)
    }

    /// The poses of a batch; its depth comes by `next`.
    pub(crate) fn poses(
        &mut self,
        sparse: &SparseBatch,
        image_of: &dyn Fn(u32) -> Option<Arc<RgbImage>>,
    ) -> GeometryBatch {
        self.take_in(sparse, image_of);
        for revision in &sparse.revised {
            let at_work = self.at_work.iter_mut();
            for view in at_work.filter(|view| view.keyframe_id == revision.keyframe_id) {
                move_to(view, revision);
            }
        }
        for view in &sparse.views {
            self.schedule.note_reported(view.keyframe_id);
        }
        let without_depth = |view| registered(view, DepthMap::none());
        reported(sparse, sparse.views.iter().map(without_depth).collect())
    }

    /// Depth of one more view of those whose poses were reported. `view_of` gives a view as it is known by now. `None`: there is
    /// nothing to do, or the sweep of another is on its way.
    pub(crate) fn next(
        &mut self,
        view_of: &dyn Fn(u32) -> Option<SparseView>,
    ) -> Option<NextDepth> {
        if self.at_work.is_some() {
            return None;
        }
        while let Some(due) = self.schedule.next() {
            let (id, is_forced) = match due {
                Due::Match(id) => {
                    self.schedule.note_matched(id);
                    (id, true)
                }
                Due::Verify(id) => {
                    self.schedule.note_verified(id);
                    (id, false)
                }
            };
            let Some(view) = view_of(id).filter(|_| self.state.holds(id)) else {
                continue;
            };
            return Some(match self.sweep_of(&view, is_forced) {
                Some(job) => {
                    self.at_work = Some(view);
                    NextDepth::Sweep(Box::new(job))
                }
                None => NextDepth::Known(Box::new(self.view(&view))),
            });
        }
        None
    }

    /// Keyframes whose poses were reported and whose depth was never looked for.
    pub(crate) fn unmatched(&self) -> Vec<u32> {
        self.schedule.unmatched().collect()
    }

    /// A sweep has come back.
    pub(crate) fn take(&mut self, swept: SweptDepth) -> Option<View> {
        self.state.take(swept);
        let view = self.at_work.take()?;
        Some(self.view(&view))
    }

    fn take_in(&mut self, sparse: &SparseBatch, image_of: &dyn Fn(u32) -> Option<Arc<RgbImage>>) {
        for revision in &sparse.revised {
            let id = revision.keyframe_id;
            self.revise(id, revision.intrinsics, revision.submap_from_cam);
        }
        // All images first: the views of one batch are each other's best sources.
        for view in &sparse.views {
            self.hold(view, image_of);
        }
    }

    /// Whether its image is still there to be matched again.
    pub(crate) fn holds(&self, keyframe_id: u32) -> bool {
        self.state.holds(keyframe_id)
    }

    fn hold(&mut self, view: &SparseView, image_of: &dyn Fn(u32) -> Option<Arc<RgbImage>>) {
        let (id, submap_from_cam) = (view.keyframe_id, view.submap_from_cam);
        match self.lenses.get(&id) {
            // Let go long ago.
            Some(_) if !self.state.holds(id) => (),
            Some(lens) if *lens == view.lens => {
                self.revise(id, view.intrinsics, submap_from_cam);
            }
            _ => {
                let Some(image) = image_of(id).and_then(|image| undistorted(image, view)) else {
                    return;
                };
                let rgb_image = MvsView {
                    image,
                    intrinsics: view.intrinsics,
                    submap_from_cam,
                };
                self.state.add(id, &rgb_image, 1.0, 2.0, &[]);
                self.lenses.insert(id, view.lens);
                if let Some(second) = &view.second {
                    self.state.pair(id, second);
                }
            }
        }
    }

    fn revise(&mut self, id: u32, intrinsics: Intrinsics, submap_from_cam: Rigid) {
        if self.state.holds(id) {
            self.state.revise(id, intrinsics, submap_from_cam);
        }
    }

    fn sweep(&mut self, view: &SparseView) {
        if let Some(job) = self.sweep_of(view, false) {
            self.state.take(job.run());
        }
    }

    /// For a new view, for one swept before when it had too few sources or its camera has moved, and where it `is_forced`.
    fn sweep_of(&mut self, view: &SparseView, is_forced: bool) -> Option<SweepJob> {
        let id = view.keyframe_id;
        let neighbours: Vec<u32> = view
            .neighbours
            .iter()
            .map(|n| n.keyframe_id)
            .filter(|n| self.state.holds(*n))
            .collect();
        let n_own = usize::from(self.state.is_pair(id));
        let n_sources = (n_own + neighbours.len()).min(self.params.source_views);
        let is_current = !is_forced
            && self.state.n_sources(id) >= n_sources
            && self
                .state
                .drift_px(id)
                .is_none_or(|drift| drift <= MAX_DRIFT_PX);
        let cam_from_submap = view.submap_from_cam.inverse();
        let depths: Vec<f64> = view
            .landmarks
            .iter()
            .map(|l| cam_from_submap.transform_point(l.point_in_submap).z)
            .collect();
        let (near, far) = depth_range(&depths).filter(|_| !is_current && n_sources > 0)?;
        self.state.sweep_job(id, near, far, &neighbours)
    }

    fn view(&self, view: &SparseView) -> View {
        let matched = self.state.depth_of(view.keyframe_id);
        registered(view, self.with_measured(matched, view))
    }

    /// What was matched and confirmed by other views, and what was measured where nothing was: a depth camera is surer of itself, but
    /// matched depth lies exactly where the images have it (kitchen7s_rgbd, live: 24.7 dB so, 23.8 the other way round).
    fn with_measured(&self, matched: Option<DepthMap>, view: &SparseView) -> DepthMap {
        let mut map = matched.unwrap_or_else(DepthMap::none);
        if let Some(measured) = &view.measured {
            fill_measured(&mut map, measured, self.depth_noise);
        }
        map
    }
}

fn reported(sparse: &SparseBatch, views: Vec<View>) -> GeometryBatch {
    GeometryBatch {
        pose_error: PoseStd::default(),
        batch_id: sparse.batch_id,
        views,
        revised: sparse.revised.clone(),
        is_loop: sparse.is_loop,
        observations: sparse.views.iter().map(observations).collect(),
        metric: sparse.metric,
        note: sparse.note.clone(),
        ..GeometryBatch::default()
    }
}

/// Its landmarks stay where they are before the camera.
fn move_to(view: &mut SparseView, revision: &PoseUpdate) {
    let old = view.submap_from_cam.inverse();
    for landmark in &mut view.landmarks {
        let in_cam = old.transform_point(landmark.point_in_submap) * revision.depth_factor;
        landmark.point_in_submap = revision.submap_from_cam.transform_point(in_cam);
    }
    view.submap = revision.submap;
    view.intrinsics = revision.intrinsics;
    view.submap_from_cam = revision.submap_from_cam;
}

fn registered(view: &SparseView, depth: DepthMap) -> View {
    View {
        keyframe_id: view.keyframe_id,
        submap: view.submap,
        intrinsics: view.intrinsics,
        lens: view.lens,
        submap_from_cam: view.submap_from_cam,
        depth,
        health: view.health,
    }
}

/// The image as the view's pinhole sees it.
fn undistorted(image: Arc<RgbImage>, view: &SparseView) -> Option<Arc<RgbImage>> {
    let Some(lens) = &view.lens else {
        return Some(image);
    };
    let rectifier = Undistorter::onto(&view.intrinsics, lens)?;
    Some(Arc::new(rectifier.rectify((*image).clone())))
}

fn observations(view: &SparseView) -> Observations {
    let cam_from_submap = view.submap_from_cam.inverse();
    let seen = view.landmarks.iter().map(|landmark| SeenLandmark {
        id: landmark.landmark,
        pixel: landmark.pixel.as_vec2().to_array(),
        depth: cam_from_submap.transform_point(landmark.point_in_submap).z as f32,
    });
    Observations {
        keyframe_id: view.keyframe_id,
        landmarks: seen.collect(),
    }
}
