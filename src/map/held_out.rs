//! Views that were kept out of optimisation -> where their pictures fit best, and what the map shows there.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::frame::RgbImage;
use crate::geometry::Health;
use crate::map::SplatMap;
use crate::map::schedule::Phase;
use crate::pose::Rigid;
use crate::splat::{PoseStep, Rendering, StepSettings};

/// Steps that refine the pose of one held-out view, and the share of the rate at the last (3R-GS: 100 steps, to 1 %).
const STEPS: u32 = 100;
const FINAL_RATE: f32 = 0.01;
/// First rate, radians and share of the scene's depth: in all, a pose can move by 22 times as much.
const RATE: f32 = 3e-3;

impl SplatMap {
    /// Moves each held-out view, alone and with the splats frozen, to where its picture fits best.
    pub fn refine_held_out(&mut self) {
        self.note_loss();
        self.place_held_out();
        for id in self.held_out() {
            let was_here = self.is_here(id);
            if !self.visit(id) {
                continue;
            }
            let view_ix = self.keyframes.placed[&id].view_ix;
            for step in 0..STEPS {
                let rate = RATE * FINAL_RATE.powf(step as f32 / STEPS as f32);
                let settings = self.pose_only(rate);
                self.engine.step(view_ix, &settings);
            }
            if !was_here {
                self.leave(id);
            }
        }
        // These steps are no training: their losses must not enter the curve.
        self.engine.take_stats();
    }

    /// A step that moves nothing but the camera, at a rate in radians and shares of the scene's depth.
    pub(super) fn pose_only(&self, rate: f32) -> StepSettings {
        StepSettings {
            train_splats: false,
            pose: PoseStep::Direct,
            lr_pose_rotation: rate,
            lr_pose_translation: rate * self.scene_depth,
            lr_focal: 0.0,
            depth_weight: 0.0,
            epipolar_weight: 0.0,
            opacity_reg: 0.0,
            scale_reg: 0.0,
            noise: 0.0,
            ..self.step_settings(Phase::Final(1.0))
        }
    }

    /// How far the geometry can trust the pose of each keyframe of this run; lengths in the map's unit.
    pub fn health(&mut self) -> Vec<(u32, Stamp, Health)> {
        let map_poses = self.engine.poses();
        let scale = self.map_from_model(&map_poses).scale;
        let placed = self.keyframes.placed.iter();
        placed
            .filter(|(_, placed)| !placed.home.is_past)
            .map(|(id, placed)| {
                (
                    *id,
                    placed.keyframe.frame.stamp,
                    placed.health.rescaled(scale),
                )
            })
            .collect()
    }

    /// The map from any place; `None` while there is none.
    pub fn render(&mut self, map_from_cam: &Rigid, intrinsics: &Intrinsics) -> Option<Rendering> {
        let sh_degree = self.params.sh_degree;
        (self.engine.n_splats() > 0).then(|| {
            self.engine
                .render(intrinsics, &map_from_cam.inverse(), sh_degree)
        })
    }

    /// What the map shows from a keyframe, beside the picture that was taken there.
    pub fn render_keyframe(&mut self, keyframe_id: u32) -> Option<(Rendering, Arc<RgbImage>)> {
        let was_here = self.is_here(keyframe_id);
        if !self.visit(keyframe_id) {
            return None;
        }
        let image = Arc::clone(&self.keyframes.placed.get(&keyframe_id)?.image);
        let (intrinsics, cam_from_map) = self.camera(keyframe_id)?;
        let sh_degree = self.params.sh_degree;
        let rendering = self.engine.render(&intrinsics, &cam_from_map, sh_degree);
        if !was_here {
            self.leave(keyframe_id);
        }
        Some((rendering, image))
    }

    /// Those that show nothing that is on disk.
    fn held_out(&self) -> Vec<u32> {
        let placed = self.keyframes.placed.iter();
        let held_out = placed.filter(|(_, p)| p.is_held_out && !p.home.rests);
        held_out.map(|(id, _)| *id).collect()
    }

    fn is_here(&self, keyframe_id: u32) -> bool {
        let placed = self.keyframes.placed.get(&keyframe_id);
        placed.is_some_and(|p| p.home.is_here)
    }

    /// The other cameras may have moved together since these were placed among them.
    fn place_held_out(&mut self) {
        let map_from_model = {
            let map_poses = self.engine.poses();
            self.map_from_model(&map_poses)
        };
        for placed in self.keyframes.placed.values().filter(|p| p.is_held_out) {
            let map_from_cam = map_from_model.transform_pose(&placed.model_from_cam);
            self.engine.set_pose(placed.view_ix, map_from_cam.inverse());
        }
    }
}
