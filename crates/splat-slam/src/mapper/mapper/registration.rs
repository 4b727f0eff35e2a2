//! Views of the geometry model -> keyframes of the map, then splats of what they show.

use std::sync::Arc;

use crate::mapper::keyframes::registered::{DepthFit, RegisteredKeyframe};
use crate::mapper::keyframes::residency::Residency;
use crate::mapper::keyframes::training_image::{rescaled, training_image};
use crate::mapper::mapper::Mapper;
use crate::mapper::params::Start;
use crate::mapper::parts::Parts;
use crate::mapper::train::landmark_depth::landmark_depth;
use crate::track::landmarks::TriangulatedLandmarks;
use splat_engine::error::EngineError;
use splat_engine::view::TrainingView;
use splat_geometry::answer::{Observations, PoseStd, View};

/// Views that were registered in the map, and have no splats yet.
#[derive(Debug, Default)]
pub(super) struct NewViews {
    pub(super) fresh: Vec<u32>,
    /// Were there before, and have depth now that they had not.
    pub(super) deepened: Vec<u32>,
    /// `None`: there were no views.
    pub(super) world_per_unit: Option<f64>,
}

impl Mapper {
    /// Makes views of the map's own submap keyframes of it; splats are not seeded from them yet.
    pub(super) fn register(
        &mut self,
        views: Vec<View>,
        pose_error: PoseStd,
        observations: &[Observations],
    ) -> Result<NewViews, EngineError> {
        let mut new = NewViews::default();
        if views.is_empty() {
            return Ok(new);
        }
        let map_poses = self.engine.poses()?;
        let world_from_submap = self.keyframes.world_from_submap(&map_poses);
        self.keyframes.note_pose_error(
            pose_error.rotation_rad as f32,
            (pose_error.translation * world_from_submap.scale) as f32,
        );
        let is_new = |view: &&View| !self.has_keyframe(view.keyframe_id);
        self.enforce_budget(views.iter().filter(is_new).count())?;
        let max_side = self.params.train.max_side;
        new.world_per_unit = Some(world_from_submap.scale);
        for view in views {
            let given = self.keyframes.registered().get(&view.keyframe_id);
            let factor = world_from_submap.scale
                * given.map_or(1.0, |registered| registered.depth_fit.factor);
            let depth = Arc::new(rescaled(&view.depth, factor));
            let median_depth = depth.median();
            if self.has_keyframe(view.keyframe_id) {
                if self
                    .keyframes
                    .update_depth(&view, depth, max_side, &mut *self.engine)?
                {
                    new.deepened.push(view.keyframe_id);
                    let view_ix = self.keyframes.registered()[&view.keyframe_id].view_ix;
                    self.trainer.renew(view_ix);
                }
            } else if let Some(keyframe) = self.keyframes.take_waiting(view.keyframe_id) {
                let (image, intrinsics) = training_image(&keyframe, &view, max_side);
                let cam_from_world = world_from_submap
                    .transform_pose(&view.submap_from_cam)
                    .inverse();
                let view_ix = self.engine.add_view(TrainingView {
                    image: Arc::clone(&image),
                    intrinsics,
                    cam_from_world,
                    depth: Some(Arc::clone(&depth)),
                    mask: None,
                })?;
                let every = self.params.map.holdout;
                let is_held_out = keyframe.frame.is_held_out
                    || (every > 0 && view.keyframe_id % every == every / 2);
                let id = view.keyframe_id;
                self.keyframes.insert(
                    id,
                    RegisteredKeyframe {
                        keyframe,
                        view_ix,
                        submap_from_cam: view.submap_from_cam,
                        image,
                        intrinsics,
                        lens: view.lens,
                        depth,
                        landmarks: TriangulatedLandmarks::none(),
                        depth_fit: DepthFit {
                            median: median_depth,
                            ..DepthFit::default()
                        },
                        health: view.health,
                        is_held_out,
                        home: Residency::here(),
                    },
                );
                if !is_held_out {
                    self.trainer.add_trainable(view_ix);
                }
                new.fresh.push(id);
            }
        }
        self.keyframes
            .keep_landmarks(observations, world_from_submap.scale);
        self.keyframes.measure_scene();
        Ok(new)
    }

    /// Seeds splats from views that were registered.
    pub(super) fn seed(
        &mut self,
        new: &NewViews,
        observations: &[Observations],
    ) -> Result<(), EngineError> {
        let Some(world_per_unit) = new.world_per_unit else {
            return Ok(());
        };
        self.share_budget();
        self.splats.prune(&self.params, &mut *self.engine)?;
        self.bring_points(&new.fresh)?;
        self.seed_all(&new.fresh, &new.deepened)?;
        self.seed_provisional(&new.fresh, world_per_unit, observations)?;
        let (mut parts, trainer) = self.split();
        trainer.reshape_fresh(&mut parts)
    }

    fn bring_points(&mut self, fresh: &[u32]) -> Result<(), EngineError> {
        if self.params.train.start != Start::Points {
            return Ok(());
        }
        let mut parts = Parts {
            params: &self.params,
            engine: &mut *self.engine,
            keyframes: &mut self.keyframes,
            splats: &mut self.splats,
        };
        self.start_points.bring(&mut parts, fresh)?;
        self.report_renumbered();
        Ok(())
    }

    fn seed_all(&mut self, fresh: &[u32], deepened: &[u32]) -> Result<(), EngineError> {
        if !fresh.is_empty() || !deepened.is_empty() {
            self.trainer.reset_convergence();
        }
        let has_depth = |id: &&u32| self.keyframes.registered()[*id].depth.width_px > 0;
        let fresh: Vec<u32> = fresh.iter().filter(has_depth).copied().collect();
        let n = fresh.len() + deepened.len();
        // The sparse points have become splats by now; depth brings none beside them.
        let per_keyframe = match self.params.train.start {
            Start::Depth => self.params.train.seeds_per_keyframe,
            Start::Points => 0,
        };
        self.balance(n * per_keyframe)?;
        let (mut parts, trainer) = self.split();
        trainer.seed_each(&mut parts, &fresh, false)?;
        trainer.seed_each(&mut parts, deepened, true)?;
        self.report_renumbered();
        Ok(())
    }

    /// What keyframes without depth show is in the map at once, coarsely, from where their landmarks are.
    fn seed_provisional(
        &mut self,
        fresh: &[u32],
        world_per_unit: f64,
        observations: &[Observations],
    ) -> Result<(), EngineError> {
        for seen in observations
            .iter()
            .filter(|seen| fresh.contains(&seen.keyframe_id))
        {
            let (mut parts, trainer) = self.split();
            let registered = parts.keyframes.registered().get(&seen.keyframe_id);
            let Some(registered) = registered.filter(|registered| registered.depth.width_px == 0)
            else {
                continue;
            };
            let image = &registered.keyframe.frame.image;
            let size_px = [image.width_px, image.height_px];
            if let Some(depth) = landmark_depth(&seen.landmarks, size_px, world_per_unit) {
                trainer.seed_provisional(&mut parts, seen.keyframe_id, &depth)?;
            }
        }
        self.report_renumbered();
        Ok(())
    }
}
