//! A submap that is mapped but not worked on: splats, views and cameras on the host, which geometry still moves.
//!
//! It has a world of its own. The engine keeps the indices of its views, without their images.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::poses::keyframe_poses;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::splats::aside::Aside;
use crate::mapper::splats::transform::{carry_all, carry_seeded};
use crate::mapper::submaps::pose_revision::revise;
use splat_geometry::answer::PoseUpdate;
use splat_geometry::similarity;
use splat_types::snapshot::Snapshot;
use splat_types::splats::splats::Splats;
use splat_types::transform::{Rigid, Similarity};

/// All that comes back to the engine when it is worked on again.
#[derive(Debug, Clone)]
pub(crate) struct Parked {
    /// Geometry's number.
    pub(crate) submap: u32,
    /// No other keyframes than its own, all registered.
    pub(crate) keyframes: KeyframeStore,
    /// By view index of the engine; those of other submaps mean nothing.
    pub(crate) cameras: Cameras,
    /// Its splats and poses as they are to be seen; a new revision for each change.
    pub(crate) snapshot: Arc<Snapshot>,
    /// One per splat of the snapshot.
    pub(crate) update_counts: Arc<Vec<u16>>,
    pub(crate) aside: Aside,
}

impl Parked {
    pub(crate) fn n_splats(&self) -> usize {
        self.snapshot.splats.len()
    }

    pub(crate) fn n_keyframes(&self) -> usize {
        self.keyframes.registered().len()
    }

    pub(crate) fn world_from_submap(&self) -> Similarity {
        self.keyframes
            .world_from_submap(&self.cameras.cam_from_maps)
    }

    pub(crate) fn is_named_in(&self, updates: &[PoseUpdate]) -> bool {
        let registered = self.keyframes.registered();
        let mut updates = updates.iter();
        updates.any(|update| registered.contains_key(&update.keyframe_id))
    }

    /// Cameras that the model moved, and the splats seeded from them. Where they have gone over to another submap, so has
    /// all of this one, and its world stays.
    pub(crate) fn apply_updates(&mut self, updates: &[PoseUpdate]) {
        let registered = self.keyframes.registered();
        let own = updates.iter();
        let own: Vec<&PoseUpdate> = own
            .filter(|update| registered.contains_key(&update.keyframe_id))
            .collect();
        let before = self.world_from_submap();
        let mut gone = own.iter().filter(|update| update.submap != self.submap);
        let pair = |update: &&&PoseUpdate| {
            let view_ix = registered[&update.keyframe_id].view_ix;
            (self.world_from_cam(view_ix), update.submap_from_cam)
        };
        let pairs: Vec<(Rigid, Rigid)> = gone.clone().map(|update| pair(&update)).collect();
        let target = gone.next().map(|update| update.submap);
        let world_from_submap = match target {
            Some(submap) => {
                self.submap = submap;
                similarity::of_poses(&pairs).unwrap_or(Similarity::IDENTITY)
            }
            None => before,
        };
        if target.is_some() {
            // Those that are not named have not moved in the world, and the frame is another.
            let new_from_old = world_from_submap.inverse() * before;
            for registered in self.keyframes.values_mut() {
                let old = registered.submap_from_cam;
                registered.submap_from_cam = new_from_old.transform_pose(&old);
            }
        }
        let unit = world_from_submap.scale / before.scale;
        let mut motions = BTreeMap::new();
        for update in own {
            let view_ix = self.keyframes.registered()[&update.keyframe_id].view_ix;
            let old = self.world_from_cam(view_ix);
            let frame = (&world_from_submap, unit);
            let revision = revise(update, &old, frame, &mut self.keyframes);
            if let Some(motion) = revision.and_then(|revision| revision.motion) {
                self.cameras.cam_from_maps[view_ix] = motion.world_from_cam.inverse();
                motions.insert(update.keyframe_id, motion.of_splats);
            }
        }
        self.keyframes.measure_scene();
        self.renew(|splats| carry_seeded(&motions, splats));
    }

    /// It lies in another world from here on.
    pub(crate) fn carry(&mut self, motion: &Similarity) {
        let views = self.keyframes.registered().values().map(|p| p.view_ix);
        for view_ix in views.collect::<Vec<usize>>() {
            let world_from_cam = self.world_from_cam(view_ix);
            self.cameras.cam_from_maps[view_ix] = motion.transform_pose(&world_from_cam).inverse();
        }
        self.keyframes.rescale(motion.scale);
        self.aside.carry(motion);
        self.renew(|splats| carry_all(*motion, splats));
    }

    /// Takes in another submap that is by now a part of this one.
    pub(crate) fn absorb(&mut self, mut other: Self) {
        other.carry(&(self.world_from_submap() * other.world_from_submap().inverse()));
        for registered in other.keyframes.registered().values() {
            let view_ix = registered.view_ix;
            let cameras = &mut self.cameras.cam_from_maps;
            if cameras.len() <= view_ix {
                cameras.resize(view_ix + 1, Rigid::IDENTITY);
            }
            cameras[view_ix] = other.cameras.cam_from_maps[view_ix];
        }
        let factor = other.cameras.focal_scale / self.cameras.focal_scale;
        other.keyframes.refocus(factor);
        self.keyframes.absorb(other.keyframes);
        self.aside.absorb(other.aside);
        let ids = self.snapshot.splat_ids.iter();
        let mut order: Vec<(u32, usize)> = ids
            .chain(&*other.snapshot.splat_ids)
            .copied()
            .zip(0..)
            .collect();
        order.sort_unstable();
        let counts = self.update_counts.iter().chain(&*other.update_counts);
        let counts: Vec<u16> = counts.copied().collect();
        self.update_counts = Arc::new(order.iter().map(|(_, ix)| counts[*ix]).collect());
        let snapshot = Arc::make_mut(&mut self.snapshot);
        // As a map of all of them would have it: the identity is that of the first keyframe.
        if first_id(&other.snapshot) < first_id(snapshot) {
            snapshot.map_id = other.snapshot.map_id;
        }
        snapshot.revision = snapshot.revision.max(other.snapshot.revision);
        snapshot.splat_ids = Arc::new(order.iter().map(|(id, _)| *id).collect());
        self.renew(|splats| {
            splats.extend(&other.snapshot.splats);
            let rows: Vec<usize> = order.iter().map(|(_, ix)| *ix).collect();
            *splats = splats.picked(&rows);
        });
    }

    /// Keeps so many splats, the most opaque.
    pub(crate) fn prune_to(&mut self, n: usize) {
        let opacities = &self.snapshot.splats.opacity_logits;
        let mut rows: Vec<usize> = (0..opacities.len()).collect();
        rows.sort_by(|a, b| opacities[*b].total_cmp(&opacities[*a]).then(a.cmp(b)));
        rows.truncate(n);
        rows.sort_unstable();
        self.update_counts = Arc::new(rows.iter().map(|ix| self.update_counts[*ix]).collect());
        let snapshot = Arc::make_mut(&mut self.snapshot);
        let ids = rows.iter().map(|ix| snapshot.splat_ids[*ix]);
        snapshot.splat_ids = Arc::new(ids.collect());
        self.renew(|splats| *splats = splats.picked(&rows));
    }

    fn world_from_cam(&self, view_ix: usize) -> Rigid {
        self.cameras.cam_from_maps[view_ix].inverse()
    }

    /// What is to be seen of it from here on.
    fn renew(&mut self, change: impl FnOnce(&mut Splats)) {
        let snapshot = Arc::make_mut(&mut self.snapshot);
        change(Arc::make_mut(&mut snapshot.splats));
        snapshot.poses = keyframe_poses(&self.keyframes, &self.cameras);
        snapshot.stamp = snapshot.poses.last().map(|p| p.stamp).unwrap_or_default();
        snapshot.revision += 1;
    }
}

fn first_id(snapshot: &Snapshot) -> Option<u32> {
    snapshot.poses.first().map(|pose| pose.keyframe_id)
}
