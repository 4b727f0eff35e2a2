//! What the geometry model learns later -> poses that move, submaps that join or take over.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::splats::transform::transform_seeded;
use crate::mapper::submaps::parked::Parked;
use crate::mapper::submaps::pose_revision::revise;
use crate::mapper::submaps::registry::Submaps;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_geometry::answer::{GeometryBatch, PoseUpdate, View};
use splat_geometry::similarity;
use splat_types::correction::{MapCorrection, Reason};
use splat_types::transform::{Rigid, Similarity};

/// A revision that moves any by more than this is a correction of the map: clients drop what they have.
const CORRECTION: f64 = 0.02;

/// How the splats of each keyframe move, and where its camera was.
type Motions = BTreeMap<u32, (Similarity, DVec3)>;

/// What follows from updates: views of submaps that joined, one that was parked and joined, in the map's world, and whether
/// splats moved.
#[derive(Debug, Default)]
pub(crate) struct MapUpdate {
    pub(crate) joined: Vec<View>,
    pub(crate) unparked: Option<Parked>,
    pub(crate) has_moved: bool,
}

impl Submaps {
    /// Cameras that the model moved: their refined poses and the splats seeded from them move along.
    pub(crate) fn apply_updates(
        &mut self,
        geometry: &GeometryBatch,
        keyframes: &mut KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<MapUpdate, EngineError> {
        if geometry.revised.is_empty() {
            return Ok(MapUpdate::default());
        }
        let map_poses = engine.poses()?;
        let old_unit = keyframes.world_from_submap(&map_poses).scale;
        let world_from_submap = self.follow(&geometry.revised, &map_poses, keyframes);
        let unit = world_from_submap.scale / old_unit;
        let mut motions = Motions::new();
        for revision in &geometry.revised {
            let id = revision.keyframe_id;
            if let Some(view) = self.detached.get_mut(&id) {
                let view = Arc::make_mut(view);
                view.submap = revision.submap;
                view.submap_from_cam = revision.submap_from_cam;
                view.intrinsics = revision.intrinsics;
                view.depth.scale(revision.depth_factor);
            } else if let Some(registered) = keyframes.registered().get(&id) {
                let old = map_poses[registered.view_ix].inverse();
                let frame = (&world_from_submap, unit);
                let motion = update_registered(revision, &old, frame, keyframes, engine)?;
                motions.extend(motion.map(|motion| (id, (motion, old.translation))));
            }
        }
        if !motions.is_empty() {
            let motions = motions.iter().map(|(id, (motion, _))| (*id, *motion));
            transform_seeded(&motions.collect(), engine)?;
        }
        self.parked.apply_updates(&geometry.revised);
        let unparked = self.take_parked().map(|mut parked| {
            parked.carry(&(world_from_submap * parked.world_from_submap().inverse()));
            parked
        });
        let joined = self.take_detached();
        // So much that is new goes out as a whole.
        self.epoch += u32::from(unparked.is_some());
        let is_merge = !joined.is_empty() || unparked.is_some();
        self.report_motions(&motions, &map_poses, is_merge, keyframes);
        Ok(MapUpdate {
            has_moved: !motions.is_empty() || unparked.is_some(),
            joined,
            unparked,
        })
    }

    /// Where the model's frame lies in the map. When all that the map is made of has gone over to another submap,
    /// so does the map, and stays where it is.
    fn follow(
        &mut self,
        revised: &[PoseUpdate],
        map_poses: &[Rigid],
        keyframes: &KeyframeStore,
    ) -> Similarity {
        let registered = keyframes.registered();
        let of_map = |r: &&PoseUpdate| registered.contains_key(&r.keyframe_id);
        let gone = revised.iter().filter(of_map);
        let gone: Vec<&PoseUpdate> = gone.filter(|r| Some(r.submap) != self.active).collect();
        let Some(first) = gone.first() else {
            return keyframes.world_from_submap(map_poses);
        };
        let pair = |r: &&PoseUpdate| {
            let view_ix = registered[&r.keyframe_id].view_ix;
            (map_poses[view_ix].inverse(), r.submap_from_cam)
        };
        let pairs: Vec<(Rigid, Rigid)> = gone.iter().map(pair).collect();
        self.active = Some(first.submap);
        similarity::of_poses(&pairs).unwrap_or(Similarity::IDENTITY)
    }

    /// Starts an epoch if splats moved by more than the optimiser moves them; reports the correction.
    fn report_motions(
        &mut self,
        motions: &Motions,
        old_poses: &[Rigid],
        is_merge: bool,
        keyframes: &KeyframeStore,
    ) {
        let (mut shift, mut turn): (f64, f64) = (0.0, 0.0);
        for (motion, centre) in motions.values() {
            shift = shift.max(motion.transform_point(*centre).distance(*centre));
            turn = turn.max(motion.angle());
        }
        let scene_depth = keyframes.scene_depth();
        let is_moved = shift > CORRECTION * f64::from(scene_depth) || turn > CORRECTION;
        if is_moved {
            self.epoch += 1;
        }
        if !is_moved && !is_merge {
            return;
        }
        let reason = if is_merge {
            Reason::Merge
        } else {
            Reason::Loop
        };
        let mut correction = MapCorrection::identity(reason);
        if !motions.is_empty() {
            // (new, old) of all keyframes: those that stayed hold the fit where they are.
            let pair = |(id, registered): (&u32, &RegisteredKeyframe)| {
                let old = old_poses[registered.view_ix].inverse();
                let new = motions.get(id).map_or(old, |m| m.0.transform_pose(&old));
                (new, old)
            };
            let pairs: Vec<(Rigid, Rigid)> = keyframes.registered().iter().map(pair).collect();
            correction.new_world_from_old_world =
                similarity::of_poses(&pairs).unwrap_or(Similarity::IDENTITY);
            if let Some((new, old)) = pairs.last() {
                correction.translation = new.translation.distance(old.translation);
                correction.rotation_rad = new.angle_to(old);
            }
        }
        self.report_correction(correction);
    }
}

/// Moves one camera; what its splats move by, unless that is next to nothing.
fn update_registered(
    update: &PoseUpdate,
    old: &Rigid,
    frame: (&Similarity, f64),
    keyframes: &mut KeyframeStore,
    engine: &mut dyn Engine,
) -> Result<Option<Similarity>, EngineError> {
    let Some(revision) = revise(update, old, frame, keyframes) else {
        return Ok(None);
    };
    let Some(registered) = keyframes.registered().get(&update.keyframe_id) else {
        return Ok(None);
    };
    let view_ix = registered.view_ix;
    if revision.has_new_intrinsics {
        engine.set_intrinsics(view_ix, &registered.intrinsics)?;
    }
    let Some(motion) = revision.motion else {
        return Ok(None);
    };
    if motion.has_new_depth {
        engine.set_depth(view_ix, Some(Arc::clone(&registered.depth)))?;
    }
    engine.set_pose(view_ix, motion.world_from_cam.inverse())?;
    Ok(Some(motion.of_splats))
}
