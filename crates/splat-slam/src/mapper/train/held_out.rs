//! Views that were kept out of optimisation -> where their images fit best.

use crate::mapper::params::{HeldOutLoss, MapperParams};
use crate::mapper::parts::Parts;
use crate::mapper::train::schedule::{self, End};
use crate::mapper::train::strong_gradients;
use splat_engine::error::EngineError;
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{PoseMode, StepSettings};

/// Share of the rate at the last step (3R-GS).
const FINAL_RATE: f32 = 0.01;

/// Moves one view, alone and with the splats frozen, to where its image fits best (`eval.pose_*`).
pub(crate) fn refine_view(map: &mut Parts<'_>, id: u32) -> Result<(), EngineError> {
    let Some(registered) = map.keyframes.registered().get(&id) else {
        return Ok(());
    };
    let view_ix = registered.view_ix;
    let held_out = map.params.held_out.clone();
    let is_masked = held_out.pose_loss == HeldOutLoss::MaskedL1;
    if is_masked {
        let mask = strong_gradients::mask(&registered.image);
        map.engine.set_mask(view_ix, mask)?;
    }
    for step in 0..held_out.pose_steps {
        let done = step as f32 / held_out.pose_steps as f32;
        let mut settings = pose_only(
            map.params,
            map.keyframes.scene_depth(),
            map.keyframes.pose_error(),
            held_out.pose_rate * FINAL_RATE.powf(done),
        );
        if is_masked {
            settings.ssim_weight = 0.0;
        }
        map.engine.step(view_ix, &settings)?;
    }
    if is_masked {
        map.engine.set_mask(view_ix, None)?;
    }
    Ok(())
}

/// A step that moves nothing but the camera, at a rate in radians and shares of the scene's depth.
pub(crate) fn pose_only(
    params: &MapperParams,
    scene_depth: f32,
    pose_error: [f32; 2],
    rate: f32,
) -> StepSettings {
    StepSettings {
        train_splats: false,
        pose: PoseMode::Direct,
        lr_pose_rotation: rate,
        lr_pose_translation: rate * scene_depth,
        lr_focal: 0.0,
        weights: LossWeights::default(),
        epipolar_weight: 0.0,
        noise: 0.0,
        ..schedule::settings(params, scene_depth, pose_error, End::Nears(1.0), 0)
    }
}

/// The other cameras may have moved together since these were registered among them.
pub(crate) fn register_held_out(map: &mut Parts<'_>) -> Result<(), EngineError> {
    let world_from_submap = {
        let map_poses = map.engine.poses()?;
        map.keyframes.world_from_submap(&map_poses)
    };
    for registered in map
        .keyframes
        .registered()
        .values()
        .filter(|p| p.is_held_out)
    {
        let world_from_cam = world_from_submap.transform_pose(&registered.submap_from_cam);
        map.engine
            .set_pose(registered.view_ix, world_from_cam.inverse())?;
    }
    Ok(())
}
