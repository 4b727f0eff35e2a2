//! What the geometry model learns later -> poses that move, submaps that join or take over.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::keyframes::training_image::rescaled;
use crate::mapper::splats::store::SplatSet;
use crate::mapper::splats::transform::transform_seeded;
use crate::mapper::submaps::registry::Submaps;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_geometry::answer::{GeometryBatch, PoseUpdate, View};
use splat_geometry::similarity;
use splat_types::correction::{MapCorrection, Reason};
use splat_types::transform::{Rigid, Similarity};

/// A submap of at least this many keyframes, and this many times as large as the map's, takes the map's place.
const MIN_TAKEOVER: usize = 8;
const TAKEOVER_RATIO: usize = 2;
/// A revision that moves a camera by less, as a share of the scene's depth or in radians, is left to the optimiser.
const MIN_REVISION: f64 = 5e-4;
/// One that moves any by more than this is a correction of the map: clients drop what they have.
const CORRECTION: f64 = 0.02;

/// How the splats of each keyframe move, and where its camera was.
type Motions = BTreeMap<u32, (Similarity, DVec3)>;

/// What follows from updates: views of submaps that joined, and whether splats moved.
#[derive(Debug, Default)]
pub(crate) struct MapUpdate {
    pub(crate) joined: Vec<View>,
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
        let (mut motions, mut joined) = (Motions::new(), Vec::new());
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
                let motion = update_registered(
                    revision,
                    &old,
                    (&world_from_submap, unit),
                    keyframes,
                    engine,
                )?;
                motions.extend(motion.map(|motion| (id, (motion, old.translation))));
            }
        }
        if !motions.is_empty() {
            let motions = motions.iter().map(|(id, (motion, _))| (*id, *motion));
            transform_seeded(&motions.collect(), engine)?;
        }
        let own = self.active;
        let ids = self.detached.iter();
        let ids: Vec<u32> = ids
            .filter(|(_, view)| Some(view.submap) == own)
            .map(|(id, _)| *id)
            .collect();
        joined.extend(
            ids.iter()
                .filter_map(|id| self.detached.remove(id))
                .map(Arc::unwrap_or_clone),
        );
        let is_merge = !joined.is_empty();
        self.report_motions(&motions, &map_poses, is_merge, keyframes);
        Ok(MapUpdate {
            has_moved: !motions.is_empty(),
            joined,
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

    /// When another submap has grown far beyond the map's, the map starts again from it: its views.
    pub(crate) fn restart_from(
        &mut self,
        keyframes: &mut KeyframeStore,
        splats: &mut SplatSet,
        engine: &mut dyn Engine,
    ) -> Result<Option<Vec<View>>, EngineError> {
        let own = keyframes.registered().len();
        let largest = self.detached_counts().into_iter().max_by_key(|(_, n)| *n);
        let Some((submap, n)) =
            largest.filter(|(_, n)| *n >= MIN_TAKEOVER && *n >= TAKEOVER_RATIO * own.max(1))
        else {
            return Ok(None);
        };
        tracing::warn!("submap {submap} with {n} keyframes takes the place of the map of {own}");
        splats.retain(&vec![false; engine.len()], engine)?;
        let old_submap = self.active.unwrap_or_default();
        for (id, registered) in keyframes.unregister_all() {
            let view = View {
                keyframe_id: id,
                submap: old_submap,
                intrinsics: registered.intrinsics,
                lens: registered.lens,
                submap_from_cam: registered.submap_from_cam,
                depth: (*registered.depth).clone(),
                health: registered.health,
            };
            self.detached.insert(id, Arc::new(view));
        }
        self.anchor.clear();
        self.active = Some(submap);
        self.epoch += 1;
        self.report_correction(MapCorrection::identity(Reason::Reset));
        let ids: Vec<u32> = self
            .detached
            .values()
            .filter(|v| v.submap == submap)
            .map(|v| v.keyframe_id)
            .collect();
        let taken = ids.into_iter().filter_map(|id| self.detached.remove(&id));
        Ok(Some(taken.map(Arc::unwrap_or_clone).collect()))
    }
}

/// Moves one camera; what its splats move by, unless that is next to nothing.
fn update_registered(
    revision: &PoseUpdate,
    old: &Rigid,
    (world_from_submap, unit): (&Similarity, f64),
    keyframes: &mut KeyframeStore,
    engine: &mut dyn Engine,
) -> Result<Option<Similarity>, EngineError> {
    let scene_depth = keyframes.scene_depth();
    let Some(registered) = keyframes.get_mut(revision.keyframe_id) else {
        return Ok(None);
    };
    let image = &registered.image;
    let intrinsics = revision.intrinsics.resized(image.width_px, image.height_px);
    if intrinsics != registered.intrinsics {
        registered.intrinsics = intrinsics;
        engine.set_intrinsics(registered.view_ix, &intrinsics)?;
    }
    let model_motion = revision.submap_from_cam * registered.submap_from_cam.inverse();
    registered.submap_from_cam = revision.submap_from_cam;
    let new = world_from_submap.transform_pose(&revision.submap_from_cam);
    let moved = (new.translation - old.translation).length() / f64::from(scene_depth);
    let scale = revision.depth_factor * unit;
    let turned = model_motion.angle_to(&Rigid::IDENTITY);
    if turned.max(moved).max(scale.ln().abs()) <= MIN_REVISION {
        return Ok(None);
    }
    if (scale - 1.0).abs() > f64::EPSILON {
        let depth = Arc::new(rescaled(&registered.depth, scale));
        registered.median_depth = depth.median();
        registered.depth_fit.log_metres = None;
        registered.depth = Arc::clone(&depth);
        if depth.width_px > 0 {
            engine.set_depth(registered.view_ix, Some(depth))?;
        }
    }
    engine.set_pose(registered.view_ix, new.inverse())?;
    let resized = Similarity {
        scale,
        ..Similarity::IDENTITY
    };
    Ok(Some(Similarity::from(new) * resized * old.inverse().into()))
}
