//! A saved map -> a map that goes on from it: keyframes, splats and what is left of them where memory is short.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::keyframes::image_codec::{Content, SavedView};
use crate::mapper::keyframes::registered::{DepthFit, RegisteredKeyframe};
use crate::mapper::keyframes::residency::Residency;
use crate::mapper::map_file::checkpoint::Checkpoint;
use crate::mapper::mapper::Mapper;
use crate::mapper::submaps::prior_map::{PriorMap, SAVED};
use crate::track::landmarks::TriangulatedLandmarks;
use crate::track::params::TrackParams;
use crate::track::tracker::Tracker;
use splat_engine::error::EngineError;
use splat_engine::view::TrainingView;
use splat_geometry::answer::PoseQuality;
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::snapshot::KeyframePose;
use splat_types::splats::splats::Splats;
use splat_types::time::Stopwatch;

/// Why a run cannot go on from a map.
#[derive(Debug, thiserror::Error)]
pub enum ContinueError {
    #[error("its landmarks cannot be used: {0}")]
    Landmarks(String),
    #[error("its keyframes leave no ids")]
    Ids,
    #[error(transparent)]
    Engine(#[from] EngineError),
}

impl Mapper {
    /// Goes on from a map of an earlier run. This one must be empty.
    pub fn resume_report(
        mut self,
        saved: Checkpoint,
        track: &TrackParams,
    ) -> Result<Self, ContinueError> {
        assert!(
            self.keyframes.registered().is_empty(),
            "a map goes on from one other"
        );
        let tracker = if saved.landmarks.is_empty() {
            None
        } else {
            let track = TrackParams {
                max_deferred_frames: 1,
                ..track.clone()
            };
            let found = Tracker::in_saved(&saved.landmarks, &track);
            Some(found.map_err(ContinueError::Landmarks)?)
        };
        let snapshot = &saved.snapshot;
        let last_id = snapshot.poses.iter().map(|pose| pose.keyframe_id).max();
        let first_id = match last_id {
            Some(id) => id.checked_add(1).ok_or(ContinueError::Ids)?,
            None => 0,
        };
        self.scale.set(snapshot.scale);
        self.map_frame = saved.map_frame;
        let splats = in_degree(&snapshot.splats, self.params.train.sh_degree);
        self.splats.set_resumed(splats.len());
        let prior = PriorMap {
            map_id: snapshot.map_id,
            scale: snapshot.scale,
            steps: saved.steps,
            first_id,
            tracker,
            n_asked: 0,
            observations: BTreeMap::new(),
            is_joined: false,
        };
        let begun = (snapshot.epoch, snapshot.revision);
        self.submaps.resume(prior, SAVED, begun);
        let mut views: BTreeMap<u32, SavedView> = saved
            .views
            .into_iter()
            .map(|v| (v.keyframe_id, v))
            .collect();
        for pose in &snapshot.poses {
            self.take_saved(pose, views.remove(&pose.keyframe_id))?;
        }
        self.take_splats(&splats, &saved.update_counts)?;
        // The newest first: they are the likeliest to be seen again.
        let ids: Vec<u32> = self.keyframes.registered().keys().rev().copied().collect();
        for id in ids
            .into_iter()
            .take(self.keyframes.max_resident(&self.params))
        {
            self.keyframes.page_in(id, &mut *self.engine)?;
        }
        self.trainer.note_trained(self.engine.poses()?.len());
        self.choose_trainable()?;
        self.set_anchor()?;
        self.keep_good()?;
        Ok(self)
    }

    /// A keyframe without its image; that comes when there is room.
    fn take_saved(
        &mut self,
        pose: &KeyframePose,
        view: Option<SavedView>,
    ) -> Result<(), EngineError> {
        let k = pose.intrinsics;
        let image = Arc::new(RgbImage::unloaded(k.width_px, k.height_px));
        let every = self.params.map.holdout;
        let is_held_out = view.as_ref().map_or_else(
            || every > 0 && pose.keyframe_id % every == every / 2,
            |view| view.is_held_out,
        );
        let view_ix = self.engine.add_view(TrainingView {
            image: Arc::clone(&image),
            intrinsics: k,
            cam_from_world: pose.world_from_cam.inverse(),
            depth: None,
            mask: None,
        })?;
        let packed = view.map(|view| view.content);
        // What is on disk takes no memory; where that fails, it stays as it came.
        let copy = match packed {
            Some(Content::Packed(bytes)) => Some(match self.paging.put(&bytes) {
                Some(page) => Content::OnDisk(Arc::from(page)),
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
            imu: None,
            sensor_depth: None,
            second: None,
            is_held_out,
        };
        let keyframe = Keyframe {
            id: pose.keyframe_id,
            frame,
            age: Stopwatch::start(),
        };
        let registered = RegisteredKeyframe {
            keyframe: Arc::new(keyframe),
            view_ix,
            submap_from_cam: pose.world_from_cam,
            image,
            intrinsics: k,
            lens: None,
            depth: Arc::new(DepthMap::none()),
            landmarks: TriangulatedLandmarks::none(),
            depth_fit: DepthFit {
                factor: 1.0,
                n_looks: u8::MAX,
                median: None,
                log_metres: Some([None; 2]),
            },
            health: PoseQuality::default(),
            is_held_out,
            home: Residency {
                copy,
                is_prior: true,
                ..Residency::default()
            },
        };
        self.keyframes.insert(pose.keyframe_id, registered);
        Ok(())
    }

    /// As many as the budget has room for, those near the newest keyframes; the others go to disk.
    fn take_splats(&mut self, splats: &Splats, update_counts: &[u16]) -> Result<(), EngineError> {
        self.measure_depths(splats)?;
        self.keyframes.measure_scene();
        self.splats.append(splats, &mut *self.engine)?;
        self.report_renumbered();
        if !update_counts.is_empty() {
            self.engine.set_update_counts(0, update_counts)?;
        }
        self.make_fit("the saved map")
    }

    /// After splats came in: those that memory has no room for go to disk, and what has none there is left out.
    pub(super) fn make_fit(&mut self, whose: &str) -> Result<(), EngineError> {
        let n_over = self.engine.len().saturating_sub(self.capacity());
        if n_over == 0 {
            return Ok(());
        }
        let away = self.keyframes.distances(&mut *self.engine)?;
        self.evict_far((n_over, -1.0), &away)?;
        let n_over = self.engine.len().saturating_sub(self.capacity());
        if n_over > 0 {
            tracing::warn!("{n_over} splats of {whose} have no room and are left out");
            let n = self.engine.len();
            let keep: Vec<bool> = (0..n).map(|ix| ix < n - n_over).collect();
            self.splats.retain(&keep, &mut *self.engine)?;
        }
        Ok(())
    }

    /// What the budgets allow in all.
    fn capacity(&mut self) -> usize {
        let keyframes = &self.keyframes;
        self.splats.capacity(&self.params, keyframes, &*self.engine)
    }

    /// Depths of what was seeded from each keyframe, in the middle: saved maps need no images to report it.
    fn measure_depths(&mut self, splats: &Splats) -> Result<(), EngineError> {
        let map_poses = self.engine.poses()?;
        let mut depths: BTreeMap<u32, Vec<f32>> = BTreeMap::new();
        for (mean, anchor) in splats.means.iter().zip(&splats.anchors) {
            if let Some(registered) = self.keyframes.registered().get(anchor) {
                let at = glam::DVec3::from(mean.map(f64::from));
                let in_cam = map_poses[registered.view_ix].transform_point(at);
                depths.entry(*anchor).or_default().push(in_cam.z as f32);
            }
        }
        for (anchor, mut depths) in depths {
            depths.retain(|z| *z > 0.0);
            depths.sort_by(f32::total_cmp);
            if let Some(registered) = self.keyframes.get_mut(anchor) {
                registered.depth_fit.median = depths.get(depths.len() / 2).copied();
            }
        }
        Ok(())
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
