//! What a backend must be able to do, by role. `Engine` is all of them on one device; one thread owns it.
//!
//! No call invents an answer: what cannot be done is an error. Work may be queued, so `step` and the calls that write
//! may return before it is done; what fails in it, the next call reports, and no read answers after that.

use std::sync::Arc;

use crate::densify::ScreenGradients;
use crate::error::EngineError;
use crate::settings::{McmcSettings, Memory, PoseNetworkSettings, StepSettings, StepStats};
use crate::view::{Correspondence, TrainingView};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Where the numbers live.
pub trait Device {
    /// For logs and `report.json`, for example `cpu (2 threads, avx2)`.
    fn adapter(&self) -> String;

    /// An error once the device is lost.
    fn status(&self) -> Result<(), EngineError>;

    /// Bytes of splats, optimiser state and views.
    fn memory(&self) -> Memory;

    /// Splats that there may be in all without the held bytes passing `max_bytes`, not even while rows are moved.
    fn capacity(&self, max_bytes: u64) -> usize;
}

/// The splats and their optimiser state, in order of arrival.
#[expect(
    clippy::len_without_is_empty,
    reason = "a role has no method that another one implies"
)]
pub trait SplatBuffers {
    /// Number of splats.
    fn len(&self) -> usize;

    /// Adds splats behind those that are there, with fresh optimiser state. All must share one SH degree, and their arrays must be of
    /// one length, or it panics.
    fn append(&mut self, splats: &Splats) -> Result<(), EngineError>;

    /// Keeps splat i when `keep[i]`, in order, with its optimiser state. One flag per splat, or it panics.
    fn retain(&mut self, keep: &[bool]) -> Result<(), EngineError>;

    /// Replaces the parameters of all splats (same count), optimiser state stays. For pose corrections that carry
    /// splats along.
    fn replace(&mut self, splats: &Splats) -> Result<(), EngineError>;

    /// Waits for all steps and reads the splats back.
    fn read(&mut self) -> Result<Splats, EngineError>;

    /// Waits for all steps and reads how many updates each splat has had: what admits the bands of its colour.
    fn update_counts(&mut self) -> Result<Vec<u16>, EngineError>;

    /// Gives splats from `first` on the update counts that they had in an earlier run.
    fn set_update_counts(&mut self, first: usize, counts: &[u16]) -> Result<(), EngineError>;
}

/// The views to train on. Index = order of `add_view`.
pub trait ViewStore {
    /// Returns the index of the view. Panics when the sizes of its image, intrinsics and mask differ. Every other call panics on an index
    /// that there is not.
    fn add_view(&mut self, view: TrainingView) -> Result<usize, EngineError>;

    /// Drops a view's image, depth, mask and correspondences; its camera stays. No step until it has an image again.
    fn unload_view(&mut self, view_ix: usize) -> Result<(), EngineError>;

    /// Replaces a view's image, and its intrinsics. A mask of another size must have gone before.
    fn set_image(
        &mut self,
        view_ix: usize,
        image: Arc<RgbImage>,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError>;

    /// Replaces the depth that guides a view's depth loss.
    fn set_depth(
        &mut self,
        view_ix: usize,
        depth: Option<Arc<DepthMap>>,
    ) -> Result<(), EngineError>;

    /// Replaces the weights of a view's pixels.
    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) -> Result<(), EngineError>;

    /// Replaces the correspondences between a view and others.
    fn set_correspondences(
        &mut self,
        view_ix: usize,
        correspondences: &[Correspondence],
    ) -> Result<(), EngineError>;

    /// Replaces a view's pose and clears its own optimiser state; the shared network stays as it is.
    fn set_pose(&mut self, view_ix: usize, cam_from_world: Rigid) -> Result<(), EngineError>;

    /// Replaces a view's intrinsics, of the same image; the factor on all focal lengths stays.
    fn set_intrinsics(
        &mut self,
        view_ix: usize,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError>;

    /// Moves the frame that all cameras stand in, not the splats: every `cam_from_world` is given its inverse on the
    /// right. Optimisers go on, since their increments are in the cameras' own axes.
    fn transform_cameras(&mut self, new_from_old: &Rigid) -> Result<(), EngineError>;

    /// Waits for all steps and reads all refined poses back, `cam_from_world` by view index.
    fn poses(&mut self) -> Result<Vec<Rigid>, EngineError>;

    /// Waits for all steps and reads the factor on all focal lengths back.
    fn focal_scale(&mut self) -> Result<f64, EngineError>;

    /// Waits for all steps and reads back each view's log gain and offset of r, g, b: its image shows `exp(gain) * rendered + offset`.
    fn exposures(&mut self) -> Result<Vec<[[f32; 3]; 2]>, EngineError>;
}

/// Splats -> image.
pub trait Renderer {
    /// From now on splats nearer than this to a camera are neither drawn nor trained, world units; [`NEAR`](crate::view::NEAR) at
    /// least, which it is at first. FastSplatting has 0.05 of the scene's extent.
    fn set_near(&mut self, near: f32);

    /// Renders with SH up to the given degree on a black background, after all steps so far. `cam_from_world` need not be a view's. Exposures
    /// of views have no part in it.
    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, EngineError>;
}

/// What moves splats and poses.
pub trait Trainer {
    /// One optimiser update on one view. Reads nothing back; a view that sees no splat changes nothing.
    fn step(&mut self, view_ix: usize, settings: &StepSettings) -> Result<(), EngineError>;

    /// Waits for all steps and takes their statistics.
    fn take_stats(&mut self) -> Result<StepStats, EngineError>;

    /// Moves dead splats to live ones and adds some, so that the image stays the same. Returns how many splats there are then.
    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> Result<usize, EngineError>;

    /// Waits for all steps, takes what those with `accumulate_screen_gradients` have added up of each splat, and begins anew.
    fn take_screen_gradients(&mut self) -> Result<ScreenGradients, EngineError>;

    /// Holds all opacities to at most `max_opacity`, 0 to 1, and clears the moments that Adam keeps of them.
    fn reset_opacities(&mut self, max_opacity: f32) -> Result<(), EngineError>;

    /// Begins with a fresh network; what the old one did to the poses stays in them.
    fn start_pose_network(&mut self, settings: &PoseNetworkSettings) -> Result<(), EngineError>;
}

/// Renders and optimises splats and poses on one device.
pub trait Engine: Device + SplatBuffers + ViewStore + Renderer + Trainer + Send {}

impl<T: Device + SplatBuffers + ViewStore + Renderer + Trainer + Send> Engine for T {}
