//! A map of an earlier run, and what geometry says of this one -> one map.
//!
//! The saved map is there from the start. Keyframes of this run are looked for among its landmarks, without a hint; where
//! several agree on how this run's geometry lies in the map, it is aligned to it. Until then it waits beside the map as a
//! submap of its own.

use std::collections::BTreeMap;

use crate::mapper::depth_scale;
use crate::mapper::parts::Parts;
use crate::mapper::submaps::prior_alignment::{PriorMatch, align_to_prior};
use crate::track::tracker::Tracker;
use splat_engine::error::EngineError;
use splat_geometry::answer::{GeometryBatch, View};
use splat_types::frame::{Batch, Keyframe};
use splat_types::snapshot::Scale;
use splat_types::transform::Similarity;

/// The saved map's own submap: no model gives this number.
pub(crate) const SAVED: u32 = u32::MAX;
/// Frames of this run that are known in the map; more say nothing new.
const MAX_OBSERVATIONS: usize = 48;

/// The earlier run.
#[derive(Debug)]
pub(crate) struct PriorMap {
    pub(crate) map_id: [u8; 16],
    pub(crate) scale: Scale,
    pub(crate) steps: u64,
    /// The first id that this run gives.
    pub(crate) first_id: u32,
    /// `None`: enough is known, or there is nothing to recognise.
    pub(crate) tracker: Option<Tracker>,
    /// Keyframes of this run that were looked for.
    pub(crate) n_asked: usize,
    pub(crate) observations: BTreeMap<u32, PriorMatch>,
    pub(crate) is_joined: bool,
}

/// How a run that goes on from a map stands to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResumeReport {
    /// Of the saved map.
    pub keyframes: usize,
    /// Keyframes of this run that were looked for in it, and found.
    pub asked: usize,
    pub found: usize,
    pub is_joined: bool,
}

impl PriorMap {
    /// Looks for keyframes of this run in the saved map.
    pub(crate) fn look_for(
        &mut self,
        map: &mut Parts<'_>,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
    ) -> Result<(), EngineError> {
        for keyframe in batch.iter().flat_map(|batch| &batch.keyframes) {
            let view = geometry.views.iter().find(|v| v.keyframe_id == keyframe.id);
            let is_new = !self.observations.contains_key(&keyframe.id);
            if let Some(view) =
                view.filter(|_| is_new && self.observations.len() < MAX_OBSERVATIONS)
            {
                self.n_asked += 1;
                if let Some(observation) = self.observation(map, keyframe, view)? {
                    self.observations.insert(keyframe.id, observation);
                }
            }
        }
        if self.observations.len() >= MAX_OBSERVATIONS {
            self.tracker = None;
        }
        let views = geometry.views.iter();
        let reported = views
            .map(|v| (v.keyframe_id, v.submap, v.submap_from_cam))
            .chain(
                geometry
                    .revised
                    .iter()
                    .map(|r| (r.keyframe_id, r.submap, r.submap_from_cam)),
            );
        for (id, submap, submap_from_cam) in reported {
            if let Some(observation) = self.observations.get_mut(&id) {
                (observation.submap, observation.submap_from_cam) = (submap, submap_from_cam);
            }
        }
        Ok(())
    }

    /// The submap of this run whose place in the saved map is known, and `world_from_submap`, the first time that it is.
    pub(crate) fn align(&mut self) -> Option<(u32, Similarity)> {
        if self.is_joined {
            return None;
        }
        let mut submaps: BTreeMap<u32, Vec<PriorMatch>> = BTreeMap::new();
        for observation in self.observations.values() {
            submaps
                .entry(observation.submap)
                .or_default()
                .push(*observation);
        }
        let found = submaps
            .into_iter()
            .filter_map(|(submap, observations)| {
                Some((submap, observations.len(), align_to_prior(&observations)?))
            })
            .max_by_key(|(.., found)| found.1);
        let (submap, n, (world_from_submap, n_inliers)) = found?;
        self.is_joined = true;
        tracing::info!(
            scale = world_from_submap.scale,
            "this run is aligned to the saved map: {n_inliers} of {n} keyframes found there agree"
        );
        Some((submap, world_from_submap))
    }

    fn observation(
        &mut self,
        map: &mut Parts<'_>,
        keyframe: &Keyframe,
        view: &View,
    ) -> Result<Option<PriorMatch>, EngineError> {
        let Some(tracker) = self.tracker.as_mut() else {
            return Ok(None);
        };
        let mut frame = keyframe.frame.clone();
        // An uncalibrated camera may be another one than the map's: what the model found of it is the better guess.
        if frame.intrinsics.is_none() && view.lens.is_none() {
            frame.intrinsics = Some(view.intrinsics);
        }
        let tracked = tracker.track(&frame);
        let Some(found) = tracked.pose.filter(|_| tracked.is_measured()) else {
            return Ok(None);
        };
        let world_from_cam = found.world_from_cam;
        let image = &keyframe.frame.image;
        let shrunk = f64::from(map.params.train.max_side)
            / f64::from(image.width_px.max(image.height_px)).max(1.0);
        let side = |n: u32| ((f64::from(n) * shrunk.min(1.0)).round() as u32).max(1);
        let lens = view
            .intrinsics
            .resized(side(image.width_px), side(image.height_px));
        let rendering = map.engine.render(&lens, &world_from_cam.inverse(), 0)?;
        let scale = depth_scale::factor(&view.depth, &rendering).map(f64::from);
        let depth = view.depth.median().map(f64::from);
        Ok(Some(PriorMatch {
            submap: view.submap,
            world_from_cam,
            submap_from_cam: view.submap_from_cam,
            scale,
            depth: depth.zip(scale).map(|(depth, scale)| depth * scale),
        }))
    }
}
