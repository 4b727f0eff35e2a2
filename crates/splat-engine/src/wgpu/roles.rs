//! The engine on a GPU by role: each call waits for the steps before it where it has to, and fails once the device is lost.

use std::sync::Arc;

use crate::densify::{self, ScreenGradients};
use crate::error::EngineError;
use crate::settings::{McmcSettings, Memory, PoseNetworkSettings, StepSettings, StepStats};
use crate::traits::{Device, Renderer, SplatBuffers, Trainer, ViewStore};
use crate::view::{Correspondence, NEAR, TrainingView};
use crate::wgpu::engine::WgpuEngine;
use crate::wgpu::{capacity, mcmc};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Statistics that a step adds to.
const N_STATS: usize = 4;

impl Device for WgpuEngine {
    fn adapter(&self) -> String {
        format!("wgpu ({})", self.gpu.name())
    }

    fn status(&self) -> Result<(), EngineError> {
        Ok(self.gpu.check()?)
    }

    fn memory(&self) -> Memory {
        let meter = self.gpu.meter();
        Memory {
            held_bytes: meter.held_bytes(),
            peak_gpu_bytes: meter.peak_bytes(),
        }
    }

    fn capacity(&self, max_bytes: u64) -> usize {
        capacity::splats_within(self, max_bytes)
    }
}

impl SplatBuffers for WgpuEngine {
    fn len(&self) -> usize {
        self.memory.n
    }

    fn append(&mut self, splats: &Splats) -> Result<(), EngineError> {
        let result = self.try_append(splats);
        self.checked(result)
    }

    fn retain(&mut self, keep: &[bool]) -> Result<(), EngineError> {
        assert_eq!(keep.len(), self.memory.n, "one flag per splat");
        let result = self
            .confirm()
            .and_then(|()| self.memory.retain(&self.gpu, keep));
        self.gpu.forget_bindings();
        self.checked(result)
    }

    fn replace(&mut self, splats: &Splats) -> Result<(), EngineError> {
        assert_eq!(
            (splats.len(), splats.sh_degree),
            (self.memory.n, self.memory.sh_degree),
            "same splats, new numbers"
        );
        let result = self
            .confirm()
            .and_then(|()| self.memory.overwrite(&self.gpu, splats));
        self.checked(result)
    }

    fn read(&mut self) -> Result<Splats, EngineError> {
        let result = self.confirm().and_then(|()| self.memory.read(&self.gpu));
        self.checked(result)
    }

    fn update_counts(&mut self) -> Result<Vec<u16>, EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.memory.update_counts(&self.gpu));
        self.checked(result)
    }

    fn set_update_counts(&mut self, first: usize, counts: &[u16]) -> Result<(), EngineError> {
        self.confirm()?;
        let n = self.memory.n.saturating_sub(first).min(counts.len());
        self.memory
            .set_update_counts(&self.gpu, first, &counts[..n]);
        self.checked(Ok(()))
    }
}

impl ViewStore for WgpuEngine {
    fn add_view(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        view.assert_consistent();
        let result = self
            .confirm()
            .and_then(|()| self.views.add(&self.gpu, view));
        self.checked(result)
    }

    fn unload_view(&mut self, view_ix: usize) -> Result<(), EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.all[view_ix].rest(&self.gpu));
        self.checked(result)
    }

    fn set_image(
        &mut self,
        view_ix: usize,
        image: Arc<RgbImage>,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        let training = TrainingView {
            image,
            ..self.views.all[view_ix].training.clone()
        };
        self.upload(view_ix, training)?;
        self.set_intrinsics(view_ix, intrinsics)
    }

    fn set_depth(
        &mut self,
        view_ix: usize,
        depth: Option<Arc<DepthMap>>,
    ) -> Result<(), EngineError> {
        let training = TrainingView {
            depth,
            ..self.views.all[view_ix].training.clone()
        };
        self.upload(view_ix, training)
    }

    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) -> Result<(), EngineError> {
        let training = TrainingView {
            mask,
            ..self.views.all[view_ix].training.clone()
        };
        training.assert_consistent();
        self.upload(view_ix, training)
    }

    fn set_correspondences(
        &mut self,
        view_ix: usize,
        correspondences: &[Correspondence],
    ) -> Result<(), EngineError> {
        self.gpu.check()?;
        self.views.all[view_ix].matches = correspondences.to_vec();
        Ok(())
    }

    fn set_pose(&mut self, view_ix: usize, cam_from_world: Rigid) -> Result<(), EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.set_pose(&self.gpu, view_ix, cam_from_world));
        self.checked(result)
    }

    fn set_intrinsics(
        &mut self,
        view_ix: usize,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        self.confirm()?;
        let training = &mut self.views.all[view_ix].training;
        training.intrinsics = *intrinsics;
        training.assert_consistent();
        self.views.write_camera(&self.gpu, view_ix, intrinsics);
        self.checked(Ok(()))
    }

    fn transform_cameras(&mut self, new_from_old: &Rigid) -> Result<(), EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.move_cameras(&self.gpu, new_from_old));
        self.checked(result)
    }

    fn poses(&mut self) -> Result<Vec<Rigid>, EngineError> {
        let result = self.confirm().and_then(|()| self.views.poses(&self.gpu));
        self.checked(result)
    }

    fn focal_scale(&mut self) -> Result<f64, EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.focal_factor(&self.gpu));
        self.checked(result)
    }

    fn exposures(&mut self) -> Result<Vec<[[f32; 3]; 2]>, EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.exposures(&self.gpu));
        self.checked(result)
    }
}

impl WgpuEngine {
    /// Takes a view's new content once the steps before have seen the old one.
    fn upload(&mut self, view_ix: usize, training: TrainingView) -> Result<(), EngineError> {
        self.confirm()?;
        let result = self.views.all[view_ix].upload(&self.gpu, training);
        self.checked(result)
    }
}

impl Renderer for WgpuEngine {
    fn set_near(&mut self, near: f32) {
        self.near = near.max(NEAR);
    }

    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, EngineError> {
        let result = self.try_render(intrinsics, cam_from_world, sh_degree);
        self.checked(result)
    }
}

impl Trainer for WgpuEngine {
    fn step(&mut self, view_ix: usize, settings: &StepSettings) -> Result<(), EngineError> {
        self.gpu.check()?;
        Ok(self.try_step(view_ix, settings)?)
    }

    fn take_stats(&mut self) -> Result<StepStats, EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.gpu.read::<f32>(&self.frame.stats, 0..N_STATS));
        let sums = self.checked(result)?;
        self.gpu.write(&self.frame.stats, 0, &[0.0_f32; N_STATS]);
        let n = f64::from(sums[0].max(1.0));
        Ok(StepStats {
            n_steps: sums[0] as u64,
            loss: f64::from(sums[1]) / n,
            l1: f64::from(sums[2]) / n,
            ssim: f64::from(sums[3]) / n,
        })
    }

    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> Result<usize, EngineError> {
        let result = self.confirm().and_then(|()| {
            mcmc::relocate_and_grow(&self.gpu, &mut self.memory, settings, self.n_trained)
        });
        self.checked(result)?;
        Ok(self.memory.n)
    }

    fn take_screen_gradients(&mut self) -> Result<ScreenGradients, EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.memory.take_screen_gradients(&self.gpu));
        self.checked(result)
    }

    fn reset_opacities(&mut self, max_opacity: f32) -> Result<(), EngineError> {
        let most = densify::logit(max_opacity);
        let result = self
            .confirm()
            .and_then(|()| self.memory.reset_opacities(&self.gpu, most));
        self.checked(result)
    }

    fn start_pose_network(&mut self, settings: &PoseNetworkSettings) -> Result<(), EngineError> {
        let result = self
            .confirm()
            .and_then(|()| self.views.start_pose_network(&self.gpu, settings));
        self.checked(result)
    }
}
