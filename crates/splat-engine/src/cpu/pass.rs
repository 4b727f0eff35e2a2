//! One way there and back: splats and a view -> image, loss, gradients. Updates nothing.

use crate::cpu::bin::{self, Tiles};
use crate::cpu::exposure::Exposure;
use crate::cpu::loss::{self, LossValue, Target};
use crate::cpu::loss_buffers::PixelGradients;
use crate::cpu::project::{self, Camera, Projected};
use crate::cpu::project_backward::{self, Forward, SplatGradients};
use crate::cpu::raster::{self, Raster};
use crate::cpu::raster_backward::{self, InstanceGradients};
use crate::settings::StepSettings;
use crate::view::TrainingView;
use splat_types::splats::splats::Splats;

/// Buffers of one way there and back.
#[derive(Debug, Default)]
pub(crate) struct Pass {
    /// Splats nearer than this are left out, world units; never less than `project::NEAR`.
    pub(crate) near: f64,
    pub(crate) projected: Projected,
    pub(crate) tiles: Tiles,
    pub(crate) raster: Raster,
    pub(crate) pixels: PixelGradients,
    pub(crate) instances: InstanceGradients,
    pub(crate) gradients: SplatGradients,
}

impl Pass {
    pub(crate) fn render(&mut self, splats: &Splats, camera: &Camera, sh_degree: u8) {
        project::project(splats, camera, sh_degree, &mut self.projected);
        bin::bin(
            &self.projected.splats,
            camera.width_px,
            camera.height_px,
            &mut self.tiles,
        );
        raster::raster(&self.projected.splats, &self.tiles, &mut self.raster);
    }

    pub(crate) fn differentiate(
        &mut self,
        splats: &Splats,
        view: &TrainingView,
        exposure: Exposure,
        settings: &StepSettings,
    ) -> LossValue {
        let camera = Camera::new(&view.intrinsics, &view.cam_from_world).with_near(self.near);
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
