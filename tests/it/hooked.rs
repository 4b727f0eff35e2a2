//! The CPU engine with something in its way: calls that fail, steps and renderings of another kind.

use std::sync::Arc;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::densify::ScreenGradients;
use splat_engine::error::EngineError;
use splat_engine::settings::{McmcSettings, Memory, PoseNetworkSettings, StepSettings, StepStats};
use splat_engine::traits::{Device, Engine, Renderer, SplatBuffers, Trainer, ViewStore};
use splat_engine::view::{Correspondence, TrainingView};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// What is in the way.
pub trait Hooks<E: Engine = CpuEngine>: Send {
    /// Before every call that can fail.
    fn before(&self, _inner: &E, _call: &'static str) -> Result<(), EngineError> {
        Ok(())
    }
    fn step(&mut self, inner: &mut E, view_ix: usize, settings: &StepSettings) {
        inner.step(view_ix, settings).unwrap();
    }
    fn render(
        &mut self,
        inner: &mut E,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Rendering {
        inner.render(intrinsics, cam_from_world, sh_degree).unwrap()
    }
}

#[derive(Debug, Default)]
pub struct Hooked<H, E = CpuEngine> {
    pub inner: E,
    pub hooks: H,
}

impl<E: Engine, H: Hooks<E>> Device for Hooked<H, E> {
    fn adapter(&self) -> String {
        self.inner.adapter()
    }
    fn status(&self) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "status")
    }
    fn memory(&self) -> Memory {
        self.inner.memory()
    }
    fn capacity(&self, max_bytes: u64) -> usize {
        self.inner.capacity(max_bytes)
    }
}

impl<E: Engine, H: Hooks<E>> SplatBuffers for Hooked<H, E> {
    fn len(&self) -> usize {
        self.inner.len()
    }
    fn append(&mut self, splats: &Splats) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "append")?;
        self.inner.append(splats)
    }
    fn retain(&mut self, keep: &[bool]) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "retain")?;
        self.inner.retain(keep)
    }
    fn replace(&mut self, splats: &Splats) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "replace")?;
        self.inner.replace(splats)
    }
    fn read(&mut self) -> Result<Splats, EngineError> {
        self.hooks.before(&self.inner, "read")?;
        self.inner.read()
    }
    fn update_counts(&mut self) -> Result<Vec<u16>, EngineError> {
        self.hooks.before(&self.inner, "update_counts")?;
        self.inner.update_counts()
    }
    fn set_update_counts(&mut self, first: usize, counts: &[u16]) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_update_counts")?;
        self.inner.set_update_counts(first, counts)
    }
}

impl<E: Engine, H: Hooks<E>> ViewStore for Hooked<H, E> {
    fn add_view(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        self.hooks.before(&self.inner, "add_view")?;
        self.inner.add_view(view)
    }
    fn unload_view(&mut self, view_ix: usize) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "unload_view")?;
        self.inner.unload_view(view_ix)
    }
    fn set_image(
        &mut self,
        view_ix: usize,
        image: Arc<RgbImage>,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_image")?;
        self.inner.set_image(view_ix, image, intrinsics)
    }
    fn set_depth(
        &mut self,
        view_ix: usize,
        depth: Option<Arc<DepthMap>>,
    ) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_depth")?;
        self.inner.set_depth(view_ix, depth)
    }
    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_mask")?;
        self.inner.set_mask(view_ix, mask)
    }
    fn set_correspondences(
        &mut self,
        view_ix: usize,
        all: &[Correspondence],
    ) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_correspondences")?;
        self.inner.set_correspondences(view_ix, all)
    }
    fn set_pose(&mut self, view_ix: usize, cam_from_world: Rigid) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_pose")?;
        self.inner.set_pose(view_ix, cam_from_world)
    }
    fn set_intrinsics(
        &mut self,
        view_ix: usize,
        intrinsics: &Intrinsics,
    ) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "set_intrinsics")?;
        self.inner.set_intrinsics(view_ix, intrinsics)
    }
    fn transform_cameras(&mut self, new_from_old: &Rigid) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "transform_cameras")?;
        self.inner.transform_cameras(new_from_old)
    }
    fn poses(&mut self) -> Result<Vec<Rigid>, EngineError> {
        self.hooks.before(&self.inner, "poses")?;
        self.inner.poses()
    }
    fn focal_scale(&mut self) -> Result<f64, EngineError> {
        self.hooks.before(&self.inner, "focal_scale")?;
        self.inner.focal_scale()
    }
    fn exposures(&mut self) -> Result<Vec<[[f32; 3]; 2]>, EngineError> {
        self.hooks.before(&self.inner, "exposures")?;
        self.inner.exposures()
    }
}

impl<E: Engine, H: Hooks<E>> Renderer for Hooked<H, E> {
    fn set_near(&mut self, near: f32) {
        self.inner.set_near(near);
    }

    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, EngineError> {
        self.hooks.before(&self.inner, "render")?;
        let inner = &mut self.inner;
        Ok(self
            .hooks
            .render(inner, intrinsics, cam_from_world, sh_degree))
    }
}

impl<E: Engine, H: Hooks<E>> Trainer for Hooked<H, E> {
    fn step(&mut self, view_ix: usize, settings: &StepSettings) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "step")?;
        self.hooks.step(&mut self.inner, view_ix, settings);
        Ok(())
    }
    fn take_stats(&mut self) -> Result<StepStats, EngineError> {
        self.hooks.before(&self.inner, "take_stats")?;
        self.inner.take_stats()
    }
    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> Result<usize, EngineError> {
        self.hooks.before(&self.inner, "relocate_and_grow")?;
        self.inner.relocate_and_grow(settings)
    }
    fn take_screen_gradients(&mut self) -> Result<ScreenGradients, EngineError> {
        self.hooks.before(&self.inner, "take_screen_gradients")?;
        self.inner.take_screen_gradients()
    }
    fn reset_opacities(&mut self, max_opacity: f32) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "reset_opacities")?;
        self.inner.reset_opacities(max_opacity)
    }
    fn start_pose_network(&mut self, settings: &PoseNetworkSettings) -> Result<(), EngineError> {
        self.hooks.before(&self.inner, "start_pose_network")?;
        self.inner.start_pose_network(settings)
    }
}
