//! The native engine by role. Nothing here can fail: what the processor has no memory for ends the process.

use std::sync::Arc;

use crate::cpu::engine::CpuEngine;
use crate::cpu::project::Camera;
use crate::cpu::view::View;
use crate::cpu::{lanes, mcmc};
use crate::densify::{self, ScreenGradients};
use crate::error::EngineError;
use crate::pose_network::PoseNetwork;
use crate::settings::{McmcSettings, Memory, PoseNetworkSettings, StepSettings, StepStats};
use crate::traits::{Device, Renderer, SplatBuffers, Trainer, ViewStore};
use crate::view::{Correspondence, TrainingView};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Rows grow by a quarter at a time, and the largest attribute is there twice while it grows.
const MAX_SPARE: f64 = 1.75;

impl Device for CpuEngine {
    fn adapter(&self) -> String {
        format!(
            "cpu ({} threads, {})",
            rayon::current_num_threads(),
            lanes::instruction_set()
        )
    }

    fn status(&self) -> Result<(), EngineError> {
        Ok(())
    }

    fn memory(&self) -> Memory {
        let of_splats = self.splats.held_bytes() + self.optimiser.held_bytes();
        let of_views: usize = self.views.iter().map(View::held_bytes).sum();
        Memory {
            held_bytes: (of_splats + of_views) as u64,
            peak_gpu_bytes: 0,
        }
    }

    fn capacity(&self, max_bytes: u64) -> usize {
        let of_views: usize = self.views.iter().map(View::held_bytes).sum();
        let free = (max_bytes as usize).saturating_sub(of_views);
        let per_splat = self.optimiser.bytes_per_splat(self.splats.sh_degree);
        (free as f64 / (MAX_SPARE * per_splat as f64)) as usize
    }
}

impl SplatBuffers for CpuEngine {
    fn len(&self) -> usize {
        self.splats.len()
    }

    fn append(&mut self, splats: &Splats) -> Result<(), EngineError> {
        self.splats.extend(splats);
        self.optimiser.resize(&self.splats, self.n_trained);
        Ok(())
    }

    fn retain(&mut self, keep: &[bool]) -> Result<(), EngineError> {
        assert_eq!(keep.len(), self.splats.len(), "one flag per splat");
        self.splats.retain(keep);
        self.optimiser.retain(self.splats.sh_stride(), keep);
        Ok(())
    }

    fn replace(&mut self, splats: &Splats) -> Result<(), EngineError> {
        splats.assert_consistent();
        assert_eq!(
            (splats.len(), splats.sh_degree),
            (self.splats.len(), self.splats.sh_degree),
            "same splats, new numbers"
        );
        self.splats.clone_from(splats);
        Ok(())
    }

    fn read(&mut self) -> Result<Splats, EngineError> {
        Ok(self.splats.clone())
    }

    fn update_counts(&mut self) -> Result<Vec<u16>, EngineError> {
        Ok(self.optimiser.update_counts())
    }

    fn set_update_counts(&mut self, first: usize, counts: &[u16]) -> Result<(), EngineError> {
        self.optimiser.set_update_counts(first, counts);
        Ok(())
    }
}

impl ViewStore for CpuEngine {
    fn add_view(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        let new = View::new(view, self.views.len(), self.pose_network.as_ref());
        self.views.push(new);
        Ok(self.views.len() - 1)
    }

    fn unload_view(&mut self, view_ix: usize) -> Result<(), EngineError> {
        self.views[view_ix].rest();
        Ok(())
    }

    fn set_image(
        &mut self,
        view_ix: usize,
        image: Arc<RgbImage>,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        self.views[view_ix].training_mut().image = image;
        self.set_intrinsics(view_ix, intrinsics)
    }

    fn set_depth(
        &mut self,
        view_ix: usize,
        depth: Option<Arc<DepthMap>>,
    ) -> Result<(), EngineError> {
        self.views[view_ix].training_mut().depth = depth;
        Ok(())
    }

    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) -> Result<(), EngineError> {
        self.views[view_ix].set_mask(mask);
        Ok(())
    }

    fn set_correspondences(
        &mut self,
        view_ix: usize,
        correspondences: &[Correspondence],
    ) -> Result<(), EngineError> {
        self.views[view_ix].matches = correspondences.to_vec();
        Ok(())
    }

    fn set_pose(&mut self, view_ix: usize, cam_from_world: Rigid) -> Result<(), EngineError> {
        self.views[view_ix].set_pose(cam_from_world, self.pose_network.as_ref());
        Ok(())
    }

    fn set_intrinsics(
        &mut self,
        view_ix: usize,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        let view = self.views[view_ix].training_mut();
        view.intrinsics = *intrinsics;
        view.assert_consistent();
        Ok(())
    }

    fn transform_cameras(&mut self, new_from_old: &Rigid) -> Result<(), EngineError> {
        let old_from_new = new_from_old.inverse();
        for view in &mut self.views {
            let base = &mut view.training_mut().cam_from_world;
            *base = (*base * old_from_new).renormalized();
        }
        Ok(())
    }

    fn poses(&mut self) -> Result<Vec<Rigid>, EngineError> {
        let views = self.views.iter();
        Ok(views
            .map(|view| view.pose(self.pose_network.as_ref()))
            .collect())
    }

    fn focal_scale(&mut self) -> Result<f64, EngineError> {
        Ok(self.log_focal.exp())
    }

    fn exposures(&mut self) -> Result<Vec<[[f32; 3]; 2]>, EngineError> {
        let appearance = self.appearance.as_ref();
        let views = self.views.iter();
        Ok(views.map(|view| view.exposure(appearance)).collect())
    }
}

impl Renderer for CpuEngine {
    fn set_near(&mut self, near: f32) {
        self.pass.near = f64::from(near);
    }

    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, EngineError> {
        let camera = Camera::new(intrinsics, cam_from_world).with_near(self.pass.near);
        self.pass.render(&self.splats, &camera, sh_degree);
        Ok(self.pass.raster.rendering())
    }
}

impl Trainer for CpuEngine {
    fn step(&mut self, view_ix: usize, settings: &StepSettings) -> Result<(), EngineError> {
        self.train(view_ix, settings);
        Ok(())
    }

    fn take_stats(&mut self) -> Result<StepStats, EngineError> {
        let sums = std::mem::take(&mut self.stats);
        let n = sums.n_steps.max(1) as f64;
        Ok(StepStats {
            n_steps: sums.n_steps,
            loss: sums.loss / n,
            l1: sums.l1 / n,
            ssim: sums.ssim / n,
        })
    }

    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> Result<usize, EngineError> {
        let (splats, optimiser) = (&mut self.splats, &mut self.optimiser);
        mcmc::relocate_and_grow(splats, optimiser, settings, self.n_trained);
        Ok(self.splats.len())
    }

    fn take_screen_gradients(&mut self) -> Result<ScreenGradients, EngineError> {
        let mut taken = std::mem::take(&mut self.optimiser.screen_gradients);
        taken.sums.resize(self.splats.len(), 0.0);
        taken.counts.resize(self.splats.len(), 0);
        Ok(taken)
    }

    fn reset_opacities(&mut self, max_opacity: f32) -> Result<(), EngineError> {
        let most = densify::logit(max_opacity);
        let logits = self.splats.opacity_logits.iter_mut();
        logits.for_each(|logit| *logit = logit.min(most));
        self.optimiser.clear_opacities();
        Ok(())
    }

    fn start_pose_network(&mut self, settings: &PoseNetworkSettings) -> Result<(), EngineError> {
        let (old, new) = (self.pose_network.take(), PoseNetwork::new(settings));
        for (ix, view) in self.views.iter_mut().enumerate() {
            view.fold(ix, old.as_ref(), &new);
        }
        self.pose_network = Some(new);
        Ok(())
    }
}
