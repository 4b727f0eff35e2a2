//! A frame that tracking has registered -> where its image fits the splats best: photometric refinement.
//!
//! Nothing of the map moves: splats are frozen, and frames share a view of their own that no training step visits.

use std::sync::Arc;

use crate::mapper::parts::Parts;
use crate::mapper::train::held_out::pose_only;
use splat_engine::error::EngineError;
use splat_engine::view::TrainingView;
use splat_types::camera::Intrinsics;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Longer side of the image that is compared: noise is averaged out, and a step takes milliseconds.
const SIDE_PX: u32 = 160;
const STEPS: u32 = 24;
/// First rate, radians and share of the scene's depth, and the share of it at the last step. In all, a pose can move
/// by eight times as much.
const RATE: f32 = 1e-3;
const FINAL_RATE: f32 = 0.05;
/// What fits better by less than this share of the loss is as likely worse.
const MIN_GAIN: f64 = 0.01;

/// Where an image fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameFit {
    pub world_from_cam: Rigid,
    /// Photometric loss where it was, and where it is.
    pub losses: [f64; 2],
}

/// The pose near `world_from_cam` at which the map looks most like `image`; `None` where no pose is clearly better.
pub(crate) fn refine_frame(
    map: &mut Parts<'_>,
    scratch_view: &mut Option<usize>,
    image: &RgbImage,
    intrinsics: &Intrinsics,
    world_from_cam: &Rigid,
) -> Result<Option<FrameFit>, EngineError> {
    let view_ix = frame_view(map, scratch_view, image, intrinsics, world_from_cam)?;
    // The loss of a step is that of the pose before it.
    fit_step(map, view_ix, RATE)?;
    let before = map.engine.take_stats()?;
    for step in 1..STEPS {
        let share = step as f32 / STEPS as f32;
        fit_step(map, view_ix, RATE * FINAL_RATE.powf(share))?;
    }
    map.engine.take_stats()?;
    fit_step(map, view_ix, 0.0)?;
    let after = map.engine.take_stats()?;
    let fit = FrameFit {
        world_from_cam: map.engine.poses()?[view_ix].inverse(),
        losses: [before.loss, after.loss],
    };
    let is_better = before.n_steps > 0
        && after.n_steps > 0
        && after.loss < (1.0 - MIN_GAIN) * before.loss
        && fit.world_from_cam.is_finite();
    Ok(is_better.then_some(fit))
}

fn fit_step(map: &mut Parts<'_>, view_ix: usize, rate: f32) -> Result<(), EngineError> {
    let settings = pose_only(
        map.params,
        map.keyframes.scene_depth(),
        map.keyframes.pose_error(),
        rate,
    );
    map.engine.step(view_ix, &settings)
}

/// The view that frames are compared in, with this one in it.
fn frame_view(
    map: &mut Parts<'_>,
    scratch_view: &mut Option<usize>,
    image: &RgbImage,
    intrinsics: &Intrinsics,
    at: &Rigid,
) -> Result<usize, EngineError> {
    let image = Arc::new(image.shrunk(SIDE_PX));
    let intrinsics = intrinsics.resized(image.width_px, image.height_px);
    let cam_from_world = at.inverse();
    if let Some(view_ix) = *scratch_view {
        map.engine.set_image(view_ix, image, &intrinsics)?;
        map.engine.set_pose(view_ix, cam_from_world)?;
        return Ok(view_ix);
    }
    let view_ix = map.engine.add_view(TrainingView {
        image,
        intrinsics,
        cam_from_world,
        depth: None,
        mask: None,
    })?;
    *scratch_view = Some(view_ix);
    Ok(view_ix)
}
