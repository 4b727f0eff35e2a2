//! Views that were kept out of optimisation -> where their images fit best.

use crate::mapper::params::MapperParams;
use crate::mapper::parts::Parts;
use crate::mapper::train::schedule::{self, End};
use splat_engine::error::EngineError;
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{PoseMode, StepSettings};

/// Steps that refine the pose of one held-out view, and the share of the rate at the last. 3R-GS makes 100, to 1 %; half of
/// them end within 0.03 dB.
const STEPS: u32 = 50;
const FINAL_RATE: f32 = 0.01;
/// First rate, radians and share of the scene's depth: in all, a pose can move by 11 times as much.
const RATE: f32 = 3e-3;

/// Moves one view, alone and with the splats frozen, to where its image fits best.
pub(crate) fn refine_view(map: &mut Parts<'_>, view_ix: usize) -> Result<(), EngineError> {
    for step in 0..STEPS {
        let rate = RATE * FINAL_RATE.powf(step as f32 / STEPS as f32);
        let settings = pose_only(
            map.params,
            map.keyframes.scene_depth(),
            map.keyframes.pose_error(),
            rate,
        );
        map.engine.step(view_ix, &settings)?;
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
