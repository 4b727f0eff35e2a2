//! What the geometry model learns later -> poses that move, components that join or take over.

use std::collections::BTreeMap;

use crate::geometry::{GeometryBatch, PoseError, Revision, View};
use crate::map::align::Carry;
use crate::map::{SplatMap, align, keyframes};
use crate::pose::Rigid;

/// A component of at least this many keyframes, and this many times as large as the map's, takes the map's place.
const MIN_TAKEOVER: usize = 8;
const TAKEOVER_RATIO: usize = 2;
/// A revision that moves a camera by less, as a share of the scene's depth or in radians, is left to the optimiser.
const MIN_REVISION: f64 = 5e-4;

impl SplatMap {
    /// Cameras that the model moved: their refined poses and the splats seeded from them move along.
    pub(super) fn revise(&mut self, geometry: &GeometryBatch) {
        if geometry.revised.is_empty() {
            return;
        }
        let map_poses = self.engine.poses();
        let map_from_model = self.map_from_model(&map_poses);
        let mut motions = BTreeMap::new();
        let mut joined = Vec::new();
        for revision in &geometry.revised {
            let Revision {
                keyframe_id: id,
                component,
                batch_from_cam: model_from_cam,
                intrinsics,
            } = revision;
            if let Some(view) = self.keyframes.foreign.get_mut(id) {
                if Some(*component) == self.component {
                    joined.push((view.component, *id, *model_from_cam));
                } else {
                    (view.component, view.batch_from_cam) = (*component, *model_from_cam);
                }
                view.intrinsics = *intrinsics;
                continue;
            }
            let Some(placed) = self.keyframes.placed.get_mut(id) else {
                continue;
            };
            let image = &placed.image;
            let intrinsics = intrinsics.resized(image.width_px, image.height_px);
            if intrinsics != placed.intrinsics {
                placed.intrinsics = intrinsics;
                self.engine.set_intrinsics(placed.view_ix, &intrinsics);
            }
            let model_motion = *model_from_cam * placed.model_from_cam.inverse();
            placed.model_from_cam = *model_from_cam;
            let angle = model_motion.angle_to(&Rigid::IDENTITY);
            let old = map_poses[placed.view_ix].inverse();
            let new = map_from_model.transform_pose(model_from_cam);
            let moved = (new.translation - old.translation).length() / f64::from(self.scene_depth);
            if angle.max(moved) > MIN_REVISION {
                motions.insert(*id, new * old.inverse());
                self.engine.set_pose(placed.view_ix, new.inverse());
            }
        }
        if !motions.is_empty() {
            let mut splats = self.engine.splats();
            let carries: BTreeMap<u32, Carry> = motions
                .into_iter()
                .map(|(id, motion)| (id, Carry::new(motion, splats.sh_degree)))
                .collect();
            for i in 0..splats.len() {
                if let Some(carry) = carries.get(&splats.anchors[i]) {
                    carry.carry(&mut splats, i);
                }
            }
            self.engine.overwrite(&splats);
            self.epoch += 1;
        }
        self.join(&joined);
    }

    /// Views of another component whose poses the model has linked to ours: (old component, id, pose in our frame).
    fn join(&mut self, joined: &[(u32, u32, Rigid)]) {
        let mut pairs: BTreeMap<u32, Vec<(Rigid, Rigid)>> = BTreeMap::new();
        for (component, id, pose) in joined {
            if let Some(view) = self.keyframes.foreign.get(id) {
                let pair = (*pose, view.batch_from_cam);
                pairs.entry(*component).or_default().push(pair);
            }
        }
        let mut views = Vec::new();
        for (component, id, pose) in joined {
            let factor = pairs
                .get(component)
                .and_then(|pairs| align::align(pairs))
                .map_or(1.0, |similarity| similarity.scale);
            if let Some(view) = self.keyframes.foreign.remove(id) {
                views.push(View {
                    depth: keyframes::rescaled(&view.depth, factor),
                    component: self.component.unwrap_or(view.component),
                    batch_from_cam: *pose,
                    ..view
                });
            }
        }
        self.place(views, PoseError::default());
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
