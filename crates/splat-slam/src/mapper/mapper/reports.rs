//! What a map says of itself: its loss curve, its budgets, the quality of its poses, its submaps, what it goes on from.

use std::sync::Arc;

use crate::mapper::budgets::Budgets;
use crate::mapper::keyframes::tracker_views::views_of;
use crate::mapper::mapper::Mapper;
use crate::mapper::submaps::prior_map::ResumeReport;
use crate::track::landmarks::KeyframeView;
use splat_geometry::answer::PoseQuality;
use splat_types::snapshot::{KeyframePose, Snapshot};
use splat_types::time::Stamp;

/// One submap in the last good state.
#[derive(Debug, Clone)]
pub struct SubmapReport {
    /// The geometry's number.
    pub id: u32,
    pub n_keyframes: usize,
    /// It is the map.
    pub is_active: bool,
    /// What it looks like in a frame of its own; `None` where it is the map, or has never been mapped.
    pub parked: Option<Arc<Snapshot>>,
}

impl Mapper {
    /// Keyframes per submap, as `submap_reports`.
    pub fn submaps(&self) -> Vec<usize> {
        let reports = self.submap_reports().into_iter();
        reports.map(|submap| submap.n_keyframes).collect()
    }

    /// The map first, then those that have no known relation to it, in order of number.
    pub fn submap_reports(&self) -> Vec<SubmapReport> {
        let Some(good) = &self.last_good else {
            return Vec::new();
        };
        let n_own = good.keyframes.registered().len();
        let map = SubmapReport {
            id: good.submaps.active().unwrap_or_default(),
            n_keyframes: n_own,
            is_active: true,
            parked: None,
        };
        let parked = good.submaps.parked().iter().map(|parked| SubmapReport {
            id: parked.submap,
            n_keyframes: parked.n_keyframes(),
            is_active: false,
            parked: Some(Arc::clone(&parked.snapshot)),
        });
        let detached = good.submaps.detached_counts().into_iter();
        let detached = detached.map(|(id, n_keyframes)| SubmapReport {
            id,
            n_keyframes,
            is_active: false,
            parked: None,
        });
        let mut others: Vec<SubmapReport> = parked.chain(detached).collect();
        others.sort_by_key(|submap| submap.id);
        let map = (n_own > 0).then_some(map);
        map.into_iter().chain(others).collect()
    }

    pub fn budgets(&self) -> Budgets {
        let registered = self.keyframes.registered().values();
        let counts = self.splats.counts();
        let peak_bytes = counts
            .peak_engine_bytes
            .max(self.engine.memory().peak_gpu_bytes);
        let (images_lost, peak_resident) = self.keyframes.counts();
        Budgets {
            max_splats: self.params.map.max_splats as u64,
            peak_splats: counts.peak_splats as u64,
            evicted_splats: counts.n_evicted,
            restored_splats: counts.n_restored,
            splats_on_disk: self.splats.n_on_disk(),
            max_gpu_mib: self.params.map.max_gpu_mib,
            peak_engine_mib: peak_bytes as f64 / f64::from(1 << 20),
            growth_refused: counts.n_refused,
            max_keyframes_in_ram: self.params.map.max_resident_keyframes as u64,
            peak_keyframes_in_ram: peak_resident as u64,
            keyframes_on_disk: registered
                .filter(|p| !p.home.is_here && p.home.copy.is_some())
                .count() as u64,
            images_lost,
        }
    }

    /// (step, mean loss since the one before).
    pub fn loss_curve(&self) -> &[(u64, f64)] {
        self.trainer.loss_curve()
    }

    /// Whether the loss has stopped falling since keyframes came or moved: further steps would heat the room.
    pub fn is_settled(&self) -> bool {
        self.trainer.has_converged()
    }

    /// Whether every keyframe has its image in memory.
    pub fn has_all_images(&self) -> bool {
        self.keyframes.has_all_images()
    }

    /// Views put back because they had jumped.
    pub fn n_put_back(&self) -> u64 {
        self.submaps.n_put_back()
    }

    /// Steps of this run and of those that it goes on from.
    pub fn n_steps_in_all(&self) -> u64 {
        let before = self.submaps.prior().map_or(0, |prior| prior.steps);
        self.trainer.n_steps() + before
    }

    /// All keyframes of the last good state, as `keyframe_views`.
    pub fn last_keyframe_views(&self) -> Vec<KeyframeView> {
        let good = self.last_good.as_ref();
        good.map_or_else(Vec::new, |good| views_of(&good.keyframes, &good.cameras))
    }

    /// How far the geometry can trust the pose of each keyframe of this run, in the last snapshot; lengths in the map's
    /// unit.
    pub fn health(&self) -> Vec<(u32, Stamp, PoseQuality)> {
        let Some(good) = &self.last_good else {
            return Vec::new();
        };
        let scale = good
            .keyframes
            .world_from_submap(&good.cameras.cam_from_maps)
            .scale;
        let registered = good.keyframes.registered().iter();
        registered
            .filter(|(_, registered)| !registered.home.is_prior)
            .map(|(id, registered)| {
                (
                    *id,
                    registered.keyframe.frame.stamp,
                    registered.health.rescaled(scale),
                )
            })
            .collect()
    }

    /// `None`: it goes on from nothing.
    pub fn continuation(&self) -> Option<ResumeReport> {
        self.submaps.resume_report(&self.keyframes)
    }

    /// Those of this run, of poses in order of id: stamps of a saved map are another recording's.
    pub fn own<'a>(&self, poses: &'a [KeyframePose]) -> &'a [KeyframePose] {
        let first_id = self.first_id();
        &poses[poses.partition_point(|pose| pose.keyframe_id < first_id)..]
    }

    /// The first id that keyframes of this run have.
    pub fn first_id(&self) -> u32 {
        self.submaps.prior().map_or(0, |prior| prior.first_id)
    }
}
