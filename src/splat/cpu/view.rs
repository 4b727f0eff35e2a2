//! What the engine keeps of one view: where it stands, and how its pose is moved by itself and by the network.
//!
//! Knows nothing of splats: a gradient of the pose comes in, the pose moves.

use std::sync::Arc;

use crate::frame::RgbImage;
use crate::pose::Rigid;
use crate::splat::cpu::exposure::{Exposure, ExposureAdam};
use crate::splat::cpu::pose_adam::PoseAdam;
use crate::splat::refiner::{Embedding, Moments, Refiner, first_embedding};
use crate::splat::{Match, StepSettings, TrainingView};

#[derive(Debug)]
pub(super) struct View {
    /// Its `cam_from_map` is the base pose, before the network.
    training: TrainingView,
    embedding: Embedding,
    moments: Moments,
    adam: PoseAdam,
    pub(super) matches: Vec<Match>,
    pub(super) exposure: Exposure,
    exposure_adam: ExposureAdam,
}

impl View {
    /// The camera stands where `view` says, whatever the network does to it. `ix`: its place in the order of arrival.
    pub(super) fn new(view: TrainingView, ix: usize, refiner: Option<&Refiner>) -> Self {
        let mut new = Self {
            training: view,
            embedding: first_embedding(ix),
            moments: Moments::default(),
            adam: PoseAdam::default(),
            matches: Vec::new(),
            exposure: Exposure::default(),
            exposure_adam: ExposureAdam::default(),
        };
        new.training.assert_consistent();
        new.set_pose(new.training.cam_from_map, refiner);
        new
    }

    /// Refined pose: base and network together.
    pub(super) fn pose(&self, refiner: Option<&Refiner>) -> Rigid {
        let base = &self.training.cam_from_map;
        refiner.map_or(*base, |refiner| refiner.apply(base, &self.embedding))
    }

    /// Picture and camera as a step sees them.
    pub(super) fn seen(&self, refiner: Option<&Refiner>, focal_factor: f64) -> TrainingView {
        let mut view = self.training.clone();
        view.cam_from_map = self.pose(refiner);
        view.intrinsics = view.intrinsics.refocused(focal_factor);
        view
    }

    /// Moves the base so that base and network together are `cam_from_map`; the view's own optimiser starts again.
    pub(super) fn set_pose(&mut self, cam_from_map: Rigid, refiner: Option<&Refiner>) {
        self.move_to(cam_from_map, refiner);
        self.adam = PoseAdam::default();
        self.moments = Moments::default();
    }

    /// What the old network did stays in the base; the new one starts from nothing.
    pub(super) fn fold(&mut self, ix: usize, old: Option<&Refiner>) {
        self.training.cam_from_map = self.pose(old);
        self.embedding = first_embedding(ix);
        self.moments = Moments::default();
    }

    /// The picture, what guides the loss, and the base pose.
    pub(super) fn training_mut(&mut self) -> &mut TrainingView {
        &mut self.training
    }

    /// One update of the view's own increment. false: the gradient is not finite, nothing changed.
    pub(super) fn step_alone(
        &mut self,
        refiner: Option<&Refiner>,
        gradient: [f64; 6],
        settings: &StepSettings,
    ) -> bool {
        let rates = [settings.lr_pose_translation, settings.lr_pose_rotation];
        let pose = self.adam.update(&self.pose(refiner), gradient, rates);
        if let Some(pose) = pose {
            self.move_to(pose, refiner);
        }
        pose.is_some()
    }

    /// One update of the network and of the view's embedding. false: the gradient is not finite, nothing changed.
    pub(super) fn step_shared(
        &mut self,
        refiner: &mut Refiner,
        gradient: [f64; 6],
        rate: f32,
    ) -> bool {
        let layers = refiner.forward(&self.embedding);
        let gradient = refiner.backward(&layers, gradient);
        refiner.update(&mut self.embedding, &mut self.moments, &gradient, rate)
    }

    /// One update of gain and offset. false: the gradient is not finite, nothing changed.
    pub(super) fn step_exposure(&mut self, gradient: [[f64; 3]; 2], rate: f32) -> bool {
        let exposure = self.exposure_adam.update(self.exposure, gradient, rate);
        self.exposure = exposure.unwrap_or(self.exposure);
        exposure.is_some()
    }

    /// Only where the view stands stays.
    pub(super) fn rest(&mut self) {
        let image = &self.training.image;
        self.training.image = Arc::new(RgbImage::hollow(image.width_px, image.height_px));
        (self.training.depth, self.training.mask) = (None, None);
        self.matches = Vec::new();
    }

    /// Of the picture and what guides the loss.
    pub(super) fn held_bytes(&self) -> usize {
        let view = &self.training;
        let of_depth = view.depth.as_ref().map_or(0, |depth| 8 * depth.depth.len());
        let of_mask = view.mask.as_ref().map_or(0, |mask| mask.len());
        view.image.pixels.len() + of_depth + of_mask + size_of_val(&self.matches[..])
    }

    pub(super) fn set_mask(&mut self, mask: Option<Arc<[u8]>>) {
        self.training.mask = mask;
        self.training.assert_consistent();
    }

    fn move_to(&mut self, cam_from_map: Rigid, refiner: Option<&Refiner>) {
        self.training.cam_from_map = match refiner {
            None => cam_from_map,
            Some(refiner) => {
                let motion = refiner.motion(&refiner.forward(&self.embedding).output);
                (motion * cam_from_map).renormalized()
            }
        };
    }
}
