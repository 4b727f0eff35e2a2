//! What the engine keeps of one view: where it stands, and how its pose is moved by itself and by the network.
//!
//! Knows nothing of splats: a gradient of the pose comes in, the pose moves.

use std::sync::Arc;

use crate::appearance::{AppearanceEmbedding, AppearanceNetwork, first_appearance};
use crate::cpu::exposure::{Exposure, ExposureAdam};
use crate::cpu::pose_adam::PoseAdam;
use crate::mlp::Moments;
use crate::pose_network::{Embedding, PoseNetwork, first_embedding};
use crate::settings::{FirstEmbedding, StepSettings};
use crate::view::{Correspondence, TrainingView};
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

#[derive(Debug)]
pub(crate) struct View {
    /// Its `cam_from_world` is the base pose, before the network.
    training: TrainingView,
    embedding: Embedding,
    moments: Moments,
    adam: PoseAdam,
    pub(crate) matches: Vec<Correspondence>,
    exposure: Exposure,
    exposure_adam: ExposureAdam,
    appearance: AppearanceEmbedding,
    appearance_moments: Moments,
}

impl View {
    /// The camera stands where `view` says, whatever the network does to it. `ix`: its place in the order of arrival.
    pub(crate) fn new(view: TrainingView, ix: usize, pose_network: Option<&PoseNetwork>) -> Self {
        let mut new = Self {
            training: view,
            embedding: first_embedding(kind_of(pose_network), ix),
            moments: Moments::default(),
            adam: PoseAdam::default(),
            matches: Vec::new(),
            exposure: Exposure::default(),
            exposure_adam: ExposureAdam::default(),
            appearance: first_appearance(ix),
            appearance_moments: Moments::default(),
        };
        new.training.assert_consistent();
        new.set_pose(new.training.cam_from_world, pose_network);
        new
    }

    /// Refined pose: base and network together.
    pub(crate) fn pose(&self, pose_network: Option<&PoseNetwork>) -> Rigid {
        let base = &self.training.cam_from_world;
        pose_network.map_or(*base, |pose_network| {
            pose_network.apply(base, &self.embedding)
        })
    }

    /// Image and camera as a step sees them.
    pub(crate) fn seen(
        &self,
        pose_network: Option<&PoseNetwork>,
        focal_factor: f64,
    ) -> TrainingView {
        let mut view = self.training.clone();
        view.cam_from_world = self.pose(pose_network);
        view.intrinsics = view.intrinsics.refocused(focal_factor);
        view
    }

    /// Moves the base so that base and network together are `cam_from_world`; the view's own optimiser starts again.
    pub(crate) fn set_pose(&mut self, cam_from_world: Rigid, pose_network: Option<&PoseNetwork>) {
        self.move_to(cam_from_world, pose_network);
        self.adam = PoseAdam::default();
        self.moments = Moments::default();
    }

    /// What the old network did stays in the base; the new one starts from nothing.
    pub(crate) fn fold(&mut self, ix: usize, old: Option<&PoseNetwork>, new: &PoseNetwork) {
        self.training.cam_from_world = self.pose(old);
        self.embedding = first_embedding(new.embedding, ix);
        self.moments = Moments::default();
    }

    /// The image, what guides the loss, and the base pose.
    pub(crate) fn training_mut(&mut self) -> &mut TrainingView {
        &mut self.training
    }

    /// One update of the view's own increment. false: the gradient is not finite, nothing changed.
    pub(crate) fn step_alone(
        &mut self,
        pose_network: Option<&PoseNetwork>,
        gradient: [f64; 6],
        settings: &StepSettings,
    ) -> bool {
        let rates = [settings.lr_pose_translation, settings.lr_pose_rotation];
        let pose = self.adam.update(&self.pose(pose_network), gradient, rates);
        if let Some(pose) = pose {
            self.move_to(pose, pose_network);
        }
        pose.is_some()
    }

    /// One update of the network and of the view's embedding. false: the gradient is not finite, nothing changed.
    pub(crate) fn step_shared(
        &mut self,
        pose_network: &mut PoseNetwork,
        gradient: [f64; 6],
        rate: f32,
    ) -> bool {
        let layers = pose_network.forward(&self.embedding);
        let gradient = pose_network.backward(&layers, gradient);
        pose_network.update(&mut self.embedding, &mut self.moments, &gradient, rate)
    }

    /// Gain and offset: the view's own and the network's together.
    pub(crate) fn exposure(&self, appearance: Option<&AppearanceNetwork>) -> Exposure {
        let Some(appearance) = appearance else {
            return self.exposure;
        };
        let shared = appearance.exposure(&self.appearance);
        std::array::from_fn(|kind| {
            std::array::from_fn(|i| self.exposure[kind][i] + shared[kind][i])
        })
    }

    /// One update of the appearance network and of the view's embedding. false: the gradient is not finite, nothing changed.
    pub(crate) fn step_appearance(
        &mut self,
        appearance: &mut AppearanceNetwork,
        gradient: [[f64; 3]; 2],
        rate: f32,
    ) -> bool {
        let moments = &mut self.appearance_moments;
        appearance.update(&mut self.appearance, moments, gradient, rate)
    }

    /// One update of the view's own gain and offset. false: the gradient is not finite, nothing changed.
    pub(crate) fn step_exposure(&mut self, gradient: [[f64; 3]; 2], rate: f32) -> bool {
        let exposure = self.exposure_adam.update(self.exposure, gradient, rate);
        self.exposure = exposure.unwrap_or(self.exposure);
        exposure.is_some()
    }

    /// Only where the view stands stays.
    pub(crate) fn rest(&mut self) {
        let image = &self.training.image;
        self.training.image = Arc::new(RgbImage::unloaded(image.width_px, image.height_px));
        (self.training.depth, self.training.mask) = (None, None);
        self.matches = Vec::new();
    }

    /// Of the image and what guides the loss.
    pub(crate) fn held_bytes(&self) -> usize {
        let view = &self.training;
        let of_depth = view.depth.as_ref().map_or(0, |depth| 8 * depth.depth.len());
        let of_mask = view.mask.as_ref().map_or(0, |mask| mask.len());
        view.image.pixels.len() + of_depth + of_mask + size_of_val(&self.matches[..])
    }

    pub(crate) fn set_mask(&mut self, mask: Option<Arc<[u8]>>) {
        self.training.mask = mask;
        self.training.assert_consistent();
    }

    fn move_to(&mut self, cam_from_world: Rigid, pose_network: Option<&PoseNetwork>) {
        self.training.cam_from_world = match pose_network {
            None => cam_from_world,
            Some(pose_network) => {
                let motion = pose_network.motion(&pose_network.forward(&self.embedding).output);
                (motion * cam_from_world).renormalized()
            }
        };
    }
}

fn kind_of(pose_network: Option<&PoseNetwork>) -> FirstEmbedding {
    pose_network.map_or(FirstEmbedding::default(), |network| network.embedding)
}
