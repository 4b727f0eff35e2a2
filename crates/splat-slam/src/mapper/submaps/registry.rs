//! Which submaps of the geometry there are, which one the map is made of, and what moved it as a whole.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::submaps::parked_submaps::ParkedSubmaps;
use crate::mapper::submaps::pose_anchor::PoseAnchor;
use crate::mapper::submaps::prior_map::{PriorMap, ResumeReport};
use splat_geometry::answer::View;
use splat_types::correction::MapCorrection;
use splat_types::transform::{Rigid, Similarity};

/// Frames of the geometry, and their relation to the world frame. Many methods: which submap is the map, what moved it and what
/// waits beside it belong together, and each step of a batch asks for another part of it.
#[derive(Debug, Default)]
pub(crate) struct Submaps {
    /// The model's submap that the map is made of.
    pub(super) active: Option<u32>,
    /// Views that the model registered in a submap that has no known relation to the map; of keyframes of a parked submap
    /// what the model has said of them since.
    pub(super) detached: BTreeMap<u32, Arc<View>>,
    /// Submaps that were the map before and have no known relation to the one that is.
    pub(super) parked: ParkedSubmaps,
    pub(super) anchor: PoseAnchor,
    /// The map that this one goes on from.
    pub(super) prior: Option<PriorMap>,
    /// Not yet asked for.
    pub(super) correction: Option<MapCorrection>,
    pub(super) epoch: u32,
    pub(super) revision: u32,
}

/// What of the submaps belongs to a state of the map.
#[derive(Debug, Clone, Default)]
pub(crate) struct SubmapState {
    active: Option<u32>,
    detached: BTreeMap<u32, Arc<View>>,
    parked: ParkedSubmaps,
    correction: Option<MapCorrection>,
    is_joined: bool,
}

impl SubmapState {
    pub(crate) fn active(&self) -> Option<u32> {
        self.active
    }

    pub(crate) fn parked(&self) -> &ParkedSubmaps {
        &self.parked
    }

    /// Number of keyframes per submap that has never been the map.
    pub(crate) fn detached_counts(&self) -> BTreeMap<u32, usize> {
        counts(&self.detached, &self.parked)
    }
}

impl Submaps {
    pub(crate) fn anchor(&mut self) -> &mut PoseAnchor {
        &mut self.anchor
    }

    pub(crate) fn n_put_back(&self) -> u64 {
        self.anchor.n_put_back()
    }

    pub(crate) fn prior(&self) -> Option<&PriorMap> {
        self.prior.as_ref()
    }

    pub(crate) fn prior_mut(&mut self) -> Option<&mut PriorMap> {
        self.prior.as_mut()
    }

    /// The map goes on from an earlier one, whose keyframes are a submap of their own.
    pub(crate) fn resume(&mut self, prior: PriorMap, submap: u32, (epoch, revision): (u32, u32)) {
        (self.epoch, self.revision) = (epoch, revision);
        self.active = Some(submap);
        self.prior = Some(prior);
    }

    pub(crate) fn epoch(&self) -> u32 {
        self.epoch
    }

    pub(crate) fn revision(&self) -> u32 {
        self.revision
    }

    pub(crate) fn next_revision(&mut self) -> u32 {
        self.revision += 1;
        self.revision
    }

    /// Corrections that nobody has taken yet become one; the next snapshot shows them.
    pub(crate) fn report_correction(&mut self, correction: MapCorrection) {
        let correction = MapCorrection {
            epoch: self.epoch,
            revision: self.revision + 1,
            ..correction
        };
        self.correction = Some(match &self.correction {
            Some(before) => correction.after(before),
            None => correction,
        });
    }

    pub(crate) fn start_epoch(&mut self, correction: MapCorrection) {
        self.epoch += 1;
        self.report_correction(correction);
    }

    pub(crate) fn take_correction(&mut self) -> Option<MapCorrection> {
        self.correction.take()
    }

    /// Views of the map's own submap; the others are kept apart.
    pub(crate) fn sort(&mut self, views: &[View], keyframes: &KeyframeStore) -> Vec<View> {
        let mut own = Vec::new();
        for view in views {
            let submap = *self.active.get_or_insert(view.submap);
            if view.submap == submap {
                self.detached.remove(&view.keyframe_id);
                own.push(view.clone());
            } else if keyframes.is_waiting(view.keyframe_id)
                || self.parked.has_keyframe(view.keyframe_id)
            {
                let view = Arc::new(view.clone());
                self.detached.insert(view.keyframe_id, view);
            }
        }
        own
    }

    /// Keyframes that were given up are in no submap.
    pub(crate) fn forget(&mut self, ids: &[u32]) {
        for id in ids {
            self.detached.remove(id);
        }
    }

    /// Number of keyframes per submap that has never been the map.
    pub(crate) fn detached_counts(&self) -> BTreeMap<u32, usize> {
        counts(&self.detached, &self.parked)
    }

    /// From now on the map is made of that submap: saved keyframes stand in its frame. Returns its views.
    pub(crate) fn take_frame(
        &mut self,
        submap: u32,
        world_from_submap: &Similarity,
        keyframes: &mut KeyframeStore,
        map_poses: &[Rigid],
    ) -> Vec<View> {
        let submap_from_world = world_from_submap.inverse();
        for registered in keyframes.values_mut() {
            let world_from_cam = map_poses[registered.view_ix].inverse();
            registered.submap_from_cam = submap_from_world.transform_pose(&world_from_cam);
        }
        self.active = Some(submap);
        self.take_detached()
    }

    /// Views of the map's own submap that were kept apart.
    pub(super) fn take_detached(&mut self) -> Vec<View> {
        let own = self.active;
        let detached = std::mem::take(&mut self.detached);
        let (own, rest): (BTreeMap<u32, Arc<View>>, BTreeMap<u32, Arc<View>>) = detached
            .into_iter()
            .partition(|(_, view)| Some(view.submap) == own);
        self.detached = rest;
        own.into_values().map(Arc::unwrap_or_clone).collect()
    }

    /// As long as this run has no place in the saved map, that stays as it is.
    pub(crate) fn waits_for_registration(&self) -> bool {
        self.prior.as_ref().is_some_and(|prior| !prior.is_joined)
    }

    /// `None`: it goes on from nothing.
    pub(crate) fn resume_report(&self, keyframes: &KeyframeStore) -> Option<ResumeReport> {
        let prior = self.prior.as_ref()?;
        let registered = keyframes.registered().values();
        Some(ResumeReport {
            keyframes: registered.filter(|p| p.home.is_prior).count(),
            asked: prior.n_asked,
            found: prior.observations.len(),
            is_joined: prior.is_joined,
        })
    }

    pub(crate) fn state(&self) -> SubmapState {
        SubmapState {
            active: self.active,
            detached: self.detached.clone(),
            parked: self.parked.clone(),
            correction: self.correction,
            is_joined: self.prior.as_ref().is_some_and(|prior| prior.is_joined),
        }
    }

    /// Goes back to an earlier state; epoch and revision go on.
    pub(crate) fn restore(&mut self, state: &SubmapState) {
        self.active = state.active;
        self.detached.clone_from(&state.detached);
        self.parked = state.parked.clone();
        self.correction = state.correction;
        if let Some(prior) = &mut self.prior {
            prior.is_joined = state.is_joined;
        }
    }

    /// Nothing of the map was ever read.
    pub(crate) fn forget_all(&mut self) {
        self.active = None;
        self.detached.clear();
        self.parked.clear();
    }
}

fn counts(detached: &BTreeMap<u32, Arc<View>>, parked: &ParkedSubmaps) -> BTreeMap<u32, usize> {
    let mut counts = BTreeMap::new();
    let never_mapped = detached.iter().filter(|(id, _)| !parked.has_keyframe(**id));
    for (_, view) in never_mapped {
        *counts.entry(view.submap).or_insert(0) += 1;
    }
    counts
}
