//! Images against the map: where they fit, and what the map shows there.

use std::sync::Arc;

use crate::mapper::mapper::Mapper;
use crate::mapper::train::grow_prune::camera;
use crate::mapper::train::held_out::{refine_view, register_held_out};
use crate::mapper::train::photometric::FrameFit;
use crate::track::refinement::FrameRef;
use splat_engine::error::EngineError;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::transform::Rigid;

impl Mapper {
    /// Moves each held-out view, alone and with the splats frozen, to where its image fits best; `goes_on` is asked before each,
    /// with how many are done and of how many.
    pub fn refine_held_out(
        &mut self,
        goes_on: &mut dyn FnMut(usize, usize) -> bool,
    ) -> Result<(), EngineError> {
        self.trainer.record_loss(&mut *self.engine)?;
        register_held_out(&mut self.split().0)?;
        let held_out = self.held_out();
        for (done, id) in held_out.iter().copied().enumerate() {
            if !goes_on(done, held_out.len()) {
                break;
            }
            let was_here = self.keyframes.is_resident(id);
            if !self.with_resident(id)? {
                continue;
            }
            refine_view(&mut self.split().0, id)?;
            if !was_here {
                self.page_out(id)?;
            }
        }
        // These steps are no training: their losses must not enter the curve.
        self.engine.take_stats()?;
        Ok(())
    }

    /// The pose near `world_from_cam` at which the map looks most like `image`; `None` where no pose is clearly better, or
    /// there is no map.
    pub fn refine_frame(
        &mut self,
        image: &RgbImage,
        intrinsics: &Intrinsics,
        world_from_cam: &Rigid,
    ) -> Result<Option<FrameFit>, EngineError> {
        if self.engine.len() == 0 {
            return Ok(None);
        }
        let (mut parts, trainer) = self.split();
        trainer.refine_frame(&mut parts, image, intrinsics, world_from_cam)
    }

    /// Where a tracked frame fits best, relative to the keyframe that it was tracked by; `None` where the map can say
    /// nothing better. A frame without calibration has the camera of that keyframe.
    pub fn fit_placement(
        &mut self,
        placement: &FrameRef,
        frame: &Frame,
    ) -> Result<Option<Rigid>, EngineError> {
        let Some(registered) = self.keyframes.registered().get(&placement.keyframe_id) else {
            return Ok(None);
        };
        let intrinsics = match frame.intrinsics {
            Some(intrinsics) => intrinsics,
            // Its image would have to be undistorted first.
            None if registered.lens.is_some() => return Ok(None),
            None => registered.intrinsics,
        };
        let world_from_key = self.engine.poses()?[registered.view_ix].inverse();
        let at = world_from_key * placement.key_from_cam;
        let fit = self.refine_frame(&frame.image, &intrinsics, &at)?;
        Ok(fit.map(|fit| world_from_key.inverse() * fit.world_from_cam))
    }

    /// The map from any place; `None` while there is none.
    pub fn render(
        &mut self,
        world_from_cam: &Rigid,
        intrinsics: &Intrinsics,
    ) -> Result<Option<Rendering>, EngineError> {
        self.engine.status()?;
        let (sh_degree, cam_from_world) = (self.params.train.sh_degree, world_from_cam.inverse());
        let engine = &mut self.engine;
        (engine.len() > 0)
            .then(|| engine.render(intrinsics, &cam_from_world, sh_degree))
            .transpose()
    }

    /// What the map shows from a keyframe, beside the image that was taken there.
    pub fn render_keyframe(
        &mut self,
        keyframe_id: u32,
    ) -> Result<Option<(Rendering, Arc<RgbImage>)>, EngineError> {
        let was_here = self.keyframes.is_resident(keyframe_id);
        if !self.with_resident(keyframe_id)? {
            return Ok(None);
        }
        let registered = self.keyframes.registered().get(&keyframe_id);
        let image = registered.map(|registered| Arc::clone(&registered.image));
        let camera = camera(&mut self.split().0, keyframe_id)?;
        let Some((image, (intrinsics, cam_from_world))) = image.zip(camera) else {
            return Ok(None);
        };
        let sh_degree = self.params.train.sh_degree;
        let rendering = self
            .engine
            .render(&intrinsics, &cam_from_world, sh_degree)?;
        if !was_here {
            self.page_out(keyframe_id)?;
        }
        Ok(Some((rendering, image)))
    }

    /// Those that show nothing that is on disk.
    fn held_out(&self) -> Vec<u32> {
        let registered = self.keyframes.registered().iter();
        let held_out = registered.filter(|(_, p)| p.is_held_out && !p.home.rests);
        held_out.map(|(id, _)| *id).collect()
    }
}
