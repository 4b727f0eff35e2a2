//! One way there and back: splats and a view -> picture, loss, gradients. Updates nothing.

use crate::splat::cpu::bin::{self, Tiles};
use crate::splat::cpu::exposure::Exposure;
use crate::splat::cpu::loss::{self, LossValue, PixelGradients, Target};
use crate::splat::cpu::project::{self, Camera, Projected};
use crate::splat::cpu::project_backward::{self, Forward, SplatGradients};
use crate::splat::cpu::raster::{self, Raster};
use crate::splat::cpu::raster_backward::{self, InstanceGradients};
use crate::splat::{Splats, StepSettings, TrainingView};

/// Buffers of one way there and back.
#[derive(Debug, Default)]
pub(super) struct Pass {
    pub(super) projected: Projected,
    pub(super) tiles: Tiles,
    pub(super) raster: Raster,
    pub(super) pixels: PixelGradients,
    pub(super) instances: InstanceGradients,
    pub(super) gradients: SplatGradients,
}

impl Pass {
    pub(super) fn render(&mut self, splats: &Splats, camera: &Camera, sh_degree: u8) {
        project::project(splats, camera, sh_degree, &mut self.projected);
        bin::bin(
            &self.projected.splats,
            camera.width_px,
            camera.height_px,
            &mut self.tiles,
        );
        raster::raster(&self.projected.splats, &self.tiles, &mut self.raster);
    }

    pub(super) fn differentiate(
        &mut self,
        splats: &Splats,
        view: &TrainingView,
        exposure: Exposure,
        settings: &StepSettings,
    ) -> LossValue {
        let camera = Camera::new(&view.intrinsics, &view.cam_from_map);
        self.render(splats, &camera, settings.sh_degree);
        let visible = &self.projected.splats;
        let target = Target {
            image: &view.image,
            depth: view.depth.as_deref(),
            mask: view.mask.as_deref(),
            exposure,
        };
        let value = loss::loss(&self.raster, &target, settings, &mut self.pixels);
        raster_backward::raster_backward(
            visible,
            &self.tiles,
            &self.raster,
            &self.pixels,
            &mut self.instances,
        );
        let forward = Forward {
            splats,
            camera: &camera,
            visible,
            tiles: &self.tiles,
        };
        project_backward::project_backward(forward, &self.instances, settings, &mut self.gradients);
        value
    }
}
