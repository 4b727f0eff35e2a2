//! A map of an earlier run, and what geometry says of this one -> one map.
//!
//! The saved map is there from the start. Keyframes of this run are looked for among its landmarks, without a hint; where
//! several agree on how this run's geometry lies in the map, it is laid over it. Until then it waits beside the map as a
//! component of its own.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::clock::Stopwatch;
use crate::config::track::TrackParams;
use crate::frame::{Batch, DepthMap, Frame, Keyframe, RgbImage};
use crate::geometry::{GeometryBatch, Health, View};
use crate::map::SplatMap;
use crate::map::checkpoint::Checkpoint;
use crate::map::depth_scale;
use crate::map::keyframes::Placed;
use crate::map::laid_over::{Sight, lay_over};
use crate::map::resting::Home;
use crate::map::saved_view::{Content, SavedView};
use crate::map::snapshot::{KeyframePose, Scale, ScaleSource};
use crate::pose::Similarity;
use crate::splat::{Splats, TrainingView};
use crate::track::Tracker;

/// The saved map's own component: no model gives this number.
const SAVED: u32 = u32::MAX;
/// Frames of this run that are known in the map; more say nothing new.
const MAX_SIGHTS: usize = 48;

/// The earlier run.
#[derive(Debug)]
pub(super) struct Past {
    pub(super) map_id: [u8; 16],
    pub(super) scale: Scale,
    pub(super) steps: u64,
    /// The first id that this run gives.
    pub(super) first_id: u32,
    /// What there was when this run began: no share of the cap is kept from it.
    pub(super) n_splats: usize,
    /// `None`: enough is known, or there is nothing to recognise.
    tracker: Option<Tracker>,
    /// Keyframes of this run that were looked for.
    n_asked: usize,
    sights: BTreeMap<u32, Sight>,
    is_joined: bool,
}

/// How a run that goes on from a map stands to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Continued {
    /// Of the saved map.
    pub keyframes: usize,
    /// Keyframes of this run that were looked for in it, and found.
    pub asked: usize,
    pub found: usize,
    pub is_joined: bool,
}

impl SplatMap {
    /// Goes on from a map of an earlier run. This one must be empty.
    pub fn continued(mut self, saved: Checkpoint, track: &TrackParams) -> Result<Self, String> {
        assert!(
            self.keyframes.placed.is_empty(),
            "a map goes on from one other"
        );
        let tracker = if saved.landmarks.is_empty() {
            None
        } else {
            let track = TrackParams {
                max_waiting: 1,
                ..track.clone()
            };
            Some(Tracker::in_saved(&saved.landmarks, &track)?)
        };
        let snapshot = &saved.snapshot;
        let last_id = snapshot.poses.iter().map(|pose| pose.keyframe_id).max();
        let first_id = match last_id {
            Some(id) => id.checked_add(1).ok_or("its keyframes leave no ids")?,
            None => 0,
        };
        self.scale = snapshot.scale;
        (self.epoch, self.revision) = (snapshot.epoch, snapshot.revision);
        self.component = Some(SAVED);
        let splats = in_degree(&snapshot.splats, self.params.sh_degree);
        self.past = Some(Past {
            map_id: snapshot.map_id,
            scale: snapshot.scale,
            steps: saved.steps,
            first_id,
            n_splats: splats.len(),
            tracker,
            n_asked: 0,
            sights: BTreeMap::new(),
            is_joined: false,
        });
        let mut views: BTreeMap<u32, SavedView> = saved
            .views
            .into_iter()
            .map(|v| (v.keyframe_id, v))
            .collect();
        for pose in &snapshot.poses {
            self.take_saved(pose, views.remove(&pose.keyframe_id));
        }
        self.take_splats(&splats, &saved.ages);
        // The newest first: they are the likeliest to be seen again.
        let ids: Vec<u32> = self.keyframes.placed.keys().rev().copied().collect();
        for id in ids.into_iter().take(self.max_here()) {
            self.come(id);
        }
        self.choose_trainable();
        self.set_gauge();
        Ok(self)
    }

    /// `None`: it goes on from nothing.
    pub fn continuation(&self) -> Option<Continued> {
        let past = self.past.as_ref()?;
        let placed = self.keyframes.placed.values();
        Some(Continued {
            keyframes: placed.filter(|p| p.home.is_past).count(),
            asked: past.n_asked,
            found: past.sights.len(),
            is_joined: past.is_joined,
        })
    }

    /// Those of this run, of poses in order of id: stamps of a saved map are another recording's.
    pub fn own<'a>(&self, poses: &'a [KeyframePose]) -> &'a [KeyframePose] {
        let first_id = self.first_id();
        &poses[poses.partition_point(|pose| pose.keyframe_id < first_id)..]
    }

    /// As long as this run has no place in the saved map, that stays as it is.
    pub(super) fn waits_for_place(&self) -> bool {
        self.past.as_ref().is_some_and(|past| !past.is_joined)
    }

    /// The first id that keyframes of this run have.
    pub fn first_id(&self) -> u32 {
        self.past.as_ref().map_or(0, |past| past.first_id)
    }

    /// A keyframe without its picture; that comes when there is room.
    fn take_saved(&mut self, pose: &KeyframePose, view: Option<SavedView>) {
        let k = pose.intrinsics;
        let image = Arc::new(RgbImage::hollow(k.width_px, k.height_px));
        let every = self.params.holdout;
        let is_held_out = view.as_ref().map_or_else(
            || every > 0 && pose.keyframe_id % every == every / 2,
            |view| view.is_held_out,
        );
        let view_ix = self.engine.add_view(TrainingView {
            image: Arc::clone(&image),
            intrinsics: k,
            cam_from_map: pose.map_from_cam.inverse(),
            depth: None,
            mask: None,
        });
        let packed = view.map(|view| view.content);
        // What is on disk takes no memory; where that fails, it stays as it came.
        let copy = match packed {
            Some(Content::Packed(bytes)) => Some(match self.spilled(&bytes) {
                Some(slot) => Content::OnDisk(Arc::new(slot)),
                None => Content::Packed(bytes),
            }),
            other => other,
        };
        let frame = Frame {
            seq: u64::MAX - u64::from(pose.keyframe_id),
            stamp: pose.stamp,
            image: Arc::clone(&image),
            intrinsics: None,
            truth: None,
            odometry: None,
            truth_depth: None,
            is_held_out,
        };
        let keyframe = Keyframe {
            id: pose.keyframe_id,
            frame,
            age: Stopwatch::start(),
        };
        let placed = Placed {
            keyframe: Arc::new(keyframe),
            view_ix,
            model_from_cam: pose.map_from_cam,
            image,
            intrinsics: k,
            lens: None,
            depth: Arc::new(DepthMap::none()),
            median_depth: None,
            depth_factor: 1.0,
            n_depth_looks: u8::MAX,
            ratios: Some([None; 2]),
            health: Health::default(),
            is_held_out,
            home: Home {
                copy,
                is_past: true,
                ..Home::default()
            },
        };
        self.keyframes.placed.insert(pose.keyframe_id, placed);
    }

    /// As many as the budget has room for, those near the newest keyframes; the others go to disk.
    fn take_splats(&mut self, splats: &Splats, ages: &[u16]) {
        self.measure_depths(splats);
        self.measure_scene();
        let away = self.distances();
        self.engine.append(splats);
        self.number_splats();
        if !ages.is_empty() {
            self.engine.set_ages(0, ages);
        }
        let n_over = self.engine.n_splats().saturating_sub(self.most_splats());
        if n_over > 0 {
            self.evict_far(n_over, -1.0, &away);
        }
        let n_over = self.engine.n_splats().saturating_sub(self.most_splats());
        if n_over > 0 {
            tracing::warn!("{n_over} splats of the saved map have no room and are left out");
            let n = self.engine.n_splats();
            let keep: Vec<bool> = (0..n).map(|ix| ix < n - n_over).collect();
            self.retain(&keep);
        }
    }

    /// Depths of what was seeded from each keyframe, in the middle: saved maps need no pictures to tell it.
    fn measure_depths(&mut self, splats: &Splats) {
        let map_poses = self.engine.poses();
        let mut depths: BTreeMap<u32, Vec<f32>> = BTreeMap::new();
        for (mean, anchor) in splats.means.iter().zip(&splats.anchors) {
            if let Some(placed) = self.keyframes.placed.get(anchor) {
                let at = glam::DVec3::from(mean.map(f64::from));
                let in_cam = map_poses[placed.view_ix].transform_point(at);
                depths.entry(*anchor).or_default().push(in_cam.z as f32);
            }
        }
        for (anchor, mut depths) in depths {
            depths.retain(|z| *z > 0.0);
            depths.sort_by(f32::total_cmp);
            if let Some(placed) = self.keyframes.placed.get_mut(&anchor) {
                placed.median_depth = depths.get(depths.len() / 2).copied();
            }
        }
    }

    /// Looks for keyframes of this run in the saved map, and lays this run's geometry over it once enough are found.
    pub(super) fn look_for_past(&mut self, batch: Option<&Batch>, geometry: &GeometryBatch) {
        let Some(mut past) = self.past.take() else {
            return;
        };
        for keyframe in batch.iter().flat_map(|batch| &batch.keyframes) {
            let view = geometry.views.iter().find(|v| v.keyframe_id == keyframe.id);
            let is_new = !past.sights.contains_key(&keyframe.id);
            if let Some(view) = view.filter(|_| is_new && past.sights.len() < MAX_SIGHTS) {
                past.n_asked += 1;
                if let Some(sight) = self.sight(&mut past, keyframe, view) {
                    past.sights.insert(keyframe.id, sight);
                }
            }
        }
        if past.sights.len() >= MAX_SIGHTS {
            past.tracker = None;
        }
        let views = geometry.views.iter();
        let told = views
            .map(|v| (v.keyframe_id, v.component, v.batch_from_cam))
            .chain(
                geometry
                    .revised
                    .iter()
                    .map(|r| (r.keyframe_id, r.component, r.batch_from_cam)),
            );
        for (id, component, model_from_cam) in told {
            if let Some(sight) = past.sights.get_mut(&id) {
                (sight.component, sight.model_from_cam) = (component, model_from_cam);
            }
        }
        self.past = Some(past);
    }

    /// After what is foreign was noted: this run's views, once its geometry has got its place.
    pub(super) fn join_past(&mut self) -> Vec<View> {
        let Some(past) = self.past.as_mut().filter(|past| !past.is_joined) else {
            return Vec::new();
        };
        let mut components: BTreeMap<u32, Vec<Sight>> = BTreeMap::new();
        for sight in past.sights.values() {
            components.entry(sight.component).or_default().push(*sight);
        }
        let found = components
            .into_iter()
            .filter_map(|(component, sights)| Some((component, sights.len(), lay_over(&sights)?)))
            .max_by_key(|(.., found)| found.1);
        let Some((component, n, (map_from_model, n_agreeing))) = found else {
            return Vec::new();
        };
        past.is_joined = true;
        tracing::info!(
            scale = map_from_model.scale,
            "this run lies over the saved map: {n_agreeing} of {n} keyframes found there agree"
        );
        self.take_frame(component, &map_from_model);
        let foreign = std::mem::take(&mut self.keyframes.foreign);
        let (own, rest): (BTreeMap<u32, View>, BTreeMap<u32, View>) = foreign
            .into_iter()
            .partition(|(_, view)| view.component == component);
        self.keyframes.foreign = rest;
        own.into_values().collect()
    }

    /// From now on the map is made of that component: saved keyframes stand in its frame.
    fn take_frame(&mut self, component: u32, map_from_model: &Similarity) {
        let map_poses = self.engine.poses();
        let model_from_map = map_from_model.inverse();
        for placed in self.keyframes.placed.values_mut() {
            let map_from_cam = map_poses[placed.view_ix].inverse();
            placed.model_from_cam = model_from_map.transform_pose(&map_from_cam);
        }
        self.component = Some(component);
        // A model that knows metres tells them of a map that had none.
        if self.knows_metres && self.scale.source != ScaleSource::Given {
            self.scale = Scale {
                metres_per_unit: Some(1.0 / map_from_model.scale),
                ..Scale::GIVEN
            };
        }
    }

    fn sight(&mut self, past: &mut Past, keyframe: &Keyframe, view: &View) -> Option<Sight> {
        let tracker = past.tracker.as_mut()?;
        let mut frame = keyframe.frame.clone();
        // An uncalibrated camera may be another one than the map's: what the model found of it is the better guess.
        if frame.intrinsics.is_none() && view.lens.is_none() {
            frame.intrinsics = Some(view.intrinsics);
        }
        let tracked = tracker.track(&frame);
        let map_from_cam = tracked.pose.filter(|_| tracked.is_measured())?.map_from_cam;
        let image = &keyframe.frame.image;
        let shrunk = f64::from(self.params.max_side)
            / f64::from(image.width_px.max(image.height_px)).max(1.0);
        let side = |n: u32| ((f64::from(n) * shrunk.min(1.0)).round() as u32).max(1);
        let lens = view
            .intrinsics
            .resized(side(image.width_px), side(image.height_px));
        let rendering = self.engine.render(&lens, &map_from_cam.inverse(), 0);
        let scale = depth_scale::factor(&view.depth, &rendering).map(f64::from);
        let depth = view.depth.median().map(f64::from);
        Some(Sight {
            component: view.component,
            map_from_cam,
            model_from_cam: view.batch_from_cam,
            scale,
            depth: depth.zip(scale).map(|(depth, scale)| depth * scale),
        })
    }
}

/// The same splats with as many bands of colour as this run has.
fn in_degree(splats: &Splats, sh_degree: u8) -> Splats {
    if splats.sh_degree == sh_degree {
        return splats.clone();
    }
    let mut other = Splats {
        sh: Vec::new(),
        sh_degree,
        ..splats.clone()
    };
    let stride = other.sh_stride();
    for row in splats.sh.chunks_exact(splats.sh_stride()) {
        let n = row.len().min(stride);
        other.sh.extend_from_slice(&row[..n]);
        other.sh.resize(other.sh.len() + stride - n, 0.0);
    }
    other
}
