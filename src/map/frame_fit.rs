//! A frame that tracking has placed -> where its picture fits the splats best: photometric refinement.
//!
//! Nothing of the map moves: splats are frozen, and frames share a view of their own that no training step visits.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::frame::{Frame, RgbImage};
use crate::map::SplatMap;
use crate::pose::Rigid;
use crate::splat::TrainingView;
use crate::track::FramePlace;

/// Longer side of the picture that is compared: noise is averaged out, and a step takes milliseconds.
const SIDE_PX: u32 = 160;
const STEPS: u32 = 24;
/// First rate, radians and share of the scene's depth, and the share of it at the last step. In all, a pose can move
/// by eight times as much.
const RATE: f32 = 1e-3;
const FINAL_RATE: f32 = 0.05;
/// What fits better by less than this share of the loss is as likely worse.
const MIN_GAIN: f64 = 0.01;

/// Where a picture fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameFit {
    pub map_from_cam: Rigid,
    /// Photometric loss where it was, and where it is.
    pub losses: [f64; 2],
}

impl SplatMap {
    /// The pose near `map_from_cam` at which the map looks most like `image`; `None` where no pose is clearly better, or
    /// there is no map.
    pub fn fit_frame(
        &mut self,
        image: &RgbImage,
        intrinsics: &Intrinsics,
        map_from_cam: &Rigid,
    ) -> Option<FrameFit> {
        if self.engine.n_splats() == 0 {
            return None;
        }
        self.note_loss();
        let view_ix = self.frame_view(image, intrinsics, map_from_cam);
        // The loss of a step is that of the pose before it.
        self.fit_step(view_ix, RATE);
        let before = self.engine.take_stats();
        for step in 1..STEPS {
            let share = step as f32 / STEPS as f32;
            self.fit_step(view_ix, RATE * FINAL_RATE.powf(share));
        }
        self.engine.take_stats();
        self.fit_step(view_ix, 0.0);
        let after = self.engine.take_stats();
        let fit = FrameFit {
            map_from_cam: self.engine.poses()[view_ix].inverse(),
            losses: [before.loss, after.loss],
        };
        let is_better = before.n_steps > 0
            && after.n_steps > 0
            && after.loss < (1.0 - MIN_GAIN) * before.loss
            && fit.map_from_cam.is_finite();
        is_better.then_some(fit)
    }

    fn fit_step(&mut self, view_ix: usize, rate: f32) {
        let settings = self.pose_only(rate);
        self.engine.step(view_ix, &settings);
    }

    /// Where a tracked frame fits best, relative to the keyframe that it was tracked by; `None` where the map can say
    /// nothing better. A frame without calibration has the camera of that keyframe.
    pub fn fit_placement(&mut self, placement: &FramePlace, frame: &Frame) -> Option<Rigid> {
        let placed = self.keyframes.placed.get(&placement.keyframe_id)?;
        let intrinsics = match frame.intrinsics {
            Some(intrinsics) => intrinsics,
            // Its picture would have to be straightened first.
            None if placed.lens.is_some() => return None,
            None => placed.intrinsics,
        };
        let map_from_key = self.engine.poses()[placed.view_ix].inverse();
        let at = map_from_key * placement.key_from_cam;
        let fit = self.fit_frame(&frame.image, &intrinsics, &at)?;
        Some(map_from_key.inverse() * fit.map_from_cam)
    }

    /// The view that frames are compared in, with this one in it.
    fn frame_view(&mut self, image: &RgbImage, intrinsics: &Intrinsics, at: &Rigid) -> usize {
        let image = Arc::new(image.shrunk(SIDE_PX));
        let intrinsics = intrinsics.resized(image.width_px, image.height_px);
        let cam_from_map = at.inverse();
        if let Some(view_ix) = self.frame_view {
            self.engine.set_image(view_ix, image, &intrinsics);
            self.engine.set_pose(view_ix, cam_from_map);
            return view_ix;
        }
        let view_ix = self.engine.add_view(TrainingView {
            image,
            intrinsics,
            cam_from_map,
            depth: None,
            mask: None,
        });
        self.frame_view = Some(view_ix);
        view_ix
    }
}
