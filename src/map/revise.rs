//! What the geometry model learns later -> poses that move, components that join or take over.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;

use crate::geometry::{GeometryBatch, PoseError, Revision, View};
use crate::map::align::Carry;
use crate::map::correction::{Correction, Reason};
use crate::map::{SplatMap, align, keyframes};
use crate::pose::{Rigid, Similarity};

/// A component of at least this many keyframes, and this many times as large as the map's, takes the map's place.
const MIN_TAKEOVER: usize = 8;
const TAKEOVER_RATIO: usize = 2;
/// A revision that moves a camera by less, as a share of the scene's depth or in radians, is left to the optimiser.
const MIN_REVISION: f64 = 5e-4;
/// One that moves any by more than this is a correction of the map: clients drop what they have.
const CORRECTION: f64 = 0.02;

/// How the splats of each keyframe move, and where its camera was.
type Motions = BTreeMap<u32, (Similarity, DVec3)>;

impl SplatMap {
    /// Cameras that the model moved: their refined poses and the splats seeded from them move along.
    pub(super) fn revise(&mut self, geometry: &GeometryBatch) {
        if geometry.revised.is_empty() {
            return;
        }
        let map_poses = self.engine.poses();
        let old_unit = self.map_from_model(&map_poses).scale;
        let map_from_model = self.follow(&geometry.revised, &map_poses);
        let unit = map_from_model.scale / old_unit;
        let (mut motions, mut joined) = (Motions::new(), Vec::new());
        for revision in &geometry.revised {
            let id = revision.keyframe_id;
            if let Some(view) = self.keyframes.foreign.get_mut(&id) {
                view.component = revision.component;
                view.batch_from_cam = revision.batch_from_cam;
                view.intrinsics = revision.intrinsics;
                view.depth.scale(revision.depth_factor);
            } else if let Some(placed) = self.keyframes.placed.get(&id) {
                let old = map_poses[placed.view_ix].inverse();
                let motion = self.revise_placed(revision, &old, (&map_from_model, unit));
                motions.extend(motion.map(|motion| (id, (motion, old.translation))));
            }
        }
        if !motions.is_empty() {
            self.unsettle();
        }
        self.carry(&motions);
        let own = self.component;
        let ids = self.keyframes.foreign.iter();
        let ids: Vec<u32> = ids
            .filter(|(_, view)| Some(view.component) == own)
            .map(|(id, _)| *id)
            .collect();
        joined.extend(
            ids.iter()
                .filter_map(|id| self.keyframes.foreign.remove(id)),
        );
        let is_merge = !joined.is_empty();
        self.tell(&motions, is_merge);
        self.place(joined, PoseError::default());
    }

    /// Where the model's frame lies in the map. When all that the map is made of has gone over to another component,
    /// so does the map, and stays where it is.
    fn follow(&mut self, revised: &[Revision], map_poses: &[Rigid]) -> Similarity {
        let placed = &self.keyframes.placed;
        let of_map = |r: &&Revision| placed.contains_key(&r.keyframe_id);
        let gone = revised.iter().filter(of_map);
        let gone: Vec<&Revision> = gone
            .filter(|r| Some(r.component) != self.component)
            .collect();
        let Some(first) = gone.first() else {
            return self.map_from_model(map_poses);
        };
        let pair = |r: &&Revision| {
            let view_ix = placed[&r.keyframe_id].view_ix;
            (map_poses[view_ix].inverse(), r.batch_from_cam)
        };
        let pairs: Vec<(Rigid, Rigid)> = gone.iter().map(pair).collect();
        self.component = Some(first.component);
        align::align(&pairs).unwrap_or(Similarity::IDENTITY)
    }

    /// Moves one camera; what its splats move by, unless that is next to nothing.
    fn revise_placed(
        &mut self,
        revision: &Revision,
        old: &Rigid,
        (map_from_model, unit): (&Similarity, f64),
    ) -> Option<Similarity> {
        let placed = self.keyframes.placed.get_mut(&revision.keyframe_id)?;
        let image = &placed.image;
        let intrinsics = revision.intrinsics.resized(image.width_px, image.height_px);
        if intrinsics != placed.intrinsics {
            placed.intrinsics = intrinsics;
            self.engine.set_intrinsics(placed.view_ix, &intrinsics);
        }
        let model_motion = revision.batch_from_cam * placed.model_from_cam.inverse();
        placed.model_from_cam = revision.batch_from_cam;
        let new = map_from_model.transform_pose(&revision.batch_from_cam);
        let moved = (new.translation - old.translation).length() / f64::from(self.scene_depth);
        let scale = revision.depth_factor * unit;
        let turned = model_motion.angle_to(&Rigid::IDENTITY);
        if turned.max(moved).max(scale.ln().abs()) <= MIN_REVISION {
            return None;
        }
        if (scale - 1.0).abs() > f64::EPSILON {
            let depth = Arc::new(keyframes::rescaled(&placed.depth, scale));
            placed.median_depth = depth.median();
            placed.ratios = None;
            placed.depth = Arc::clone(&depth);
            if depth.width_px > 0 {
                self.engine.set_depth(placed.view_ix, Some(depth));
            }
        }
        self.engine.set_pose(placed.view_ix, new.inverse());
        let resized = Similarity {
            scale,
            ..Similarity::IDENTITY
        };
        Some(Similarity::from(new) * resized * old.inverse().into())
    }

    /// Splats go with the keyframe that they were seeded from.
    fn carry(&mut self, motions: &Motions) {
        if motions.is_empty() {
            return;
        }
        let mut splats = self.engine.splats();
        let carries: BTreeMap<u32, Carry> = motions
            .iter()
            .map(|(id, (motion, _))| (*id, Carry::new(*motion, splats.sh_degree)))
            .collect();
        for i in 0..splats.len() {
            if let Some(carry) = carries.get(&splats.anchors[i]) {
                carry.carry(&mut splats, i);
            }
        }
        self.engine.overwrite(&splats);
    }

    /// A new epoch where old splats have moved by more than the optimiser moves them, and word of it.
    fn tell(&mut self, motions: &Motions, is_merge: bool) {
        let (mut shift, mut turn): (f64, f64) = (0.0, 0.0);
        for (motion, centre) in motions.values() {
            shift = shift.max(motion.transform_point(*centre).distance(*centre));
            turn = turn.max(motion.angle());
        }
        let is_moved = shift > CORRECTION * f64::from(self.scene_depth) || turn > CORRECTION;
        if is_moved {
            self.epoch += 1;
        }
        if is_moved || is_merge {
            let newest = self.keyframes.placed.keys().next_back();
            let motion = newest.and_then(|id| motions.get(id)).map(|m| m.0);
            self.note_correction(Correction {
                epoch: self.epoch,
                revision: self.revision + 1,
                new_map_from_old_map: motion.unwrap_or(Similarity::IDENTITY),
                shift,
                turn,
                reason: if is_merge {
                    Reason::Merge
                } else {
                    Reason::Loop
                },
            });
        }
    }

    /// When another component has grown far beyond the map's, the map starts again from it.
    pub(super) fn take_over(&mut self) -> Vec<View> {
        let own = self.keyframes.placed.len();
        let largest = self
            .keyframes
            .foreign_counts()
            .into_iter()
            .max_by_key(|(_, n)| *n);
        let Some((component, n)) =
            largest.filter(|(_, n)| *n >= MIN_TAKEOVER && *n >= TAKEOVER_RATIO * own.max(1))
        else {
            return Vec::new();
        };
        tracing::warn!(
            "component {component} with {n} keyframes takes the place of the map of {own}"
        );
        self.retain(&vec![false; self.engine.n_splats()]);
        let old_component = self.component.unwrap_or_default();
        for (id, placed) in std::mem::take(&mut self.keyframes.placed) {
            let view = View {
                keyframe_id: id,
                component: old_component,
                intrinsics: placed.intrinsics,
                lens: placed.lens,
                batch_from_cam: placed.model_from_cam,
                depth: (*placed.depth).clone(),
                health: placed.health,
            };
            self.keyframes.foreign.insert(id, view);
            self.keyframes.waiting.insert(id, placed.keyframe);
        }
        self.trainable.clear();
        self.gauge = None;
        self.schedule.restart_round();
        self.component = Some(component);
        self.epoch += 1;
        let ids: Vec<u32> = self
            .keyframes
            .foreign
            .values()
            .filter(|v| v.component == component)
            .map(|v| v.keyframe_id)
            .collect();
        ids.into_iter()
            .filter_map(|id| self.keyframes.foreign.remove(&id))
            .collect()
    }
}
