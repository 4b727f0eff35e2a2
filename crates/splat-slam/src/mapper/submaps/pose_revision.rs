//! What geometry has learnt of one keyframe -> its camera and depth, and how its splats move.

use std::sync::Arc;

use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::keyframes::training_image::rescaled;
use splat_geometry::answer::PoseUpdate;
use splat_types::transform::{Rigid, Similarity};

/// A revision that moves a camera by less, as a share of the scene's depth or in radians, is left to the optimiser.
const MIN_REVISION: f64 = 5e-4;

/// What a revision has changed; the engine does not have it yet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Revision {
    pub(crate) has_new_intrinsics: bool,
    /// `None`: it moves by next to nothing and stays.
    pub(crate) motion: Option<CameraMotion>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraMotion {
    pub(crate) world_from_cam: Rigid,
    pub(crate) has_new_depth: bool,
    /// Of the splats that were seeded from it.
    pub(crate) of_splats: Similarity,
}

/// Revises a keyframe of the store that stood at `old`; `unit`: lengths of the geometry are so many times as long in
/// the world since. `None`: it is not registered.
pub(crate) fn revise(
    update: &PoseUpdate,
    old: &Rigid,
    (world_from_submap, unit): (&Similarity, f64),
    keyframes: &mut KeyframeStore,
) -> Option<Revision> {
    let scene_depth = keyframes.scene_depth();
    let registered = keyframes.get_mut(update.keyframe_id)?;
    let image = &registered.image;
    let intrinsics = update.intrinsics.resized(image.width_px, image.height_px);
    let has_new_intrinsics = intrinsics != registered.intrinsics;
    registered.intrinsics = intrinsics;
    let model_motion = update.submap_from_cam * registered.submap_from_cam.inverse();
    registered.submap_from_cam = update.submap_from_cam;
    let new = world_from_submap.transform_pose(&update.submap_from_cam);
    let moved = (new.translation - old.translation).length() / f64::from(scene_depth);
    let scale = update.depth_factor * unit;
    let turned = model_motion.angle_to(&Rigid::IDENTITY);
    if turned.max(moved).max(scale.ln().abs()) <= MIN_REVISION {
        return Some(Revision {
            has_new_intrinsics,
            motion: None,
        });
    }
    let is_rescaled = (scale - 1.0).abs() > f64::EPSILON;
    if is_rescaled {
        let depth = Arc::new(rescaled(&registered.depth, scale));
        registered.depth_fit.median = depth.median();
        registered.landmarks.unit *= scale;
        registered.depth_fit.log_metres = None;
        registered.depth = depth;
    }
    let resized = Similarity {
        scale,
        ..Similarity::IDENTITY
    };
    Some(Revision {
        has_new_intrinsics,
        motion: Some(CameraMotion {
            world_from_cam: new,
            has_new_depth: is_rescaled && registered.depth.width_px > 0,
            of_splats: Similarity::from(new) * resized * old.inverse().into(),
        }),
    })
}
