//! The engine on a GPU: the stages of the CPU engine as shaders, in one submission a step.
//!
//! A step reads nothing back. Whether there was room for its instances, the host learns some steps later; steps behind
//! one that had none do nothing, and are made again once there is. So the result does not depend on when the host looks.

use std::collections::VecDeque;

use crate::error::EngineError;
use crate::settings::StepSettings;
use crate::view::NEAR;
use crate::wgpu::frame::Frame;
use crate::wgpu::memory::SplatMemory;
use crate::wgpu::views::Views;
use splat_gpu::commands::Commands;
use splat_gpu::device::{Gpu, Wanted};
use splat_gpu::error::GpuError;
use splat_gpu::kernel::{self, Kernel};
use splat_types::camera::Intrinsics;
use splat_types::rendering::Rendering;
use splat_types::transform::Rigid;

/// Renders and optimises on one adapter.
#[derive(Debug)]
pub struct WgpuEngine {
    pub(crate) gpu: Gpu,
    pub(crate) memory: SplatMemory,
    pub(crate) frame: Frame,
    pub(crate) views: Views,
    /// Submitted, and not yet known to have had room: view, settings, number of the step.
    pub(crate) unconfirmed: VecDeque<(usize, StepSettings, u32)>,
    /// Steps that were to move splats.
    pub(crate) n_trained: u32,
    pub(crate) has_warned_of_room: bool,
    /// Splats nearer than this are not drawn, world units.
    pub(crate) near: f32,
}

impl WgpuEngine {
    /// On the best adapter that is wanted, without splats and views. The shaders are compiled here, so that a fault shows before
    /// anything is trained.
    ///
    /// # Errors
    ///
    /// No adapter answers, it gives no device, or a shader does not compile on it.
    pub fn new(wanted: Wanted) -> Result<Self, GpuError> {
        let gpu = Gpu::open(wanted)?;
        let is_fit = |kernel: &&Kernel| {
            let is_atomic = kernel.name == crate::wgpu::kernels::RASTER_BACKWARD_ATOMIC.name;
            gpu.has_float_atomics() || !is_atomic
        };
        let shared = kernel::ALL.iter().copied();
        let own = crate::wgpu::kernels::ALL.iter().copied().filter(is_fit);
        let kernels: Vec<_> = shared.chain(own).collect();
        gpu.compile(&kernels)?;
        Ok(Self {
            memory: SplatMemory::new(&gpu, 0)?,
            frame: Frame::new(&gpu)?,
            views: Views::new(&gpu)?,
            unconfirmed: VecDeque::new(),
            n_trained: 0,
            has_warned_of_room: false,
            near: NEAR,
            gpu,
        })
    }

    /// Whether sums of floats are made in any order: asked for, and the adapter can.
    pub fn sums_in_any_order(&self) -> bool {
        self.gpu.has_float_atomics()
    }

    /// What it runs on: to profile its kernels.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// As when the adapter is unplugged: for tests.
    pub fn lose_device(&self) {
        self.gpu.lose();
    }

    /// A result of work on a device that was there to the end.
    pub(crate) fn checked<T>(&self, result: Result<T, GpuError>) -> Result<T, EngineError> {
        let value = result?;
        self.gpu.check()?;
        Ok(value)
    }

    pub(crate) fn try_render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, GpuError> {
        self.confirm()?;
        let size = [intrinsics.width_px, intrinsics.height_px];
        self.frame.fit(&self.gpu, self.memory.n, size)?;
        loop {
            let step = self.image_of(size, sh_degree);
            self.write_step(&step);
            let camera = crate::wgpu::views::camera_of(intrinsics, cam_from_world);
            self.gpu.write(&self.frame.camera, 0, &[camera]);
            let mut commands = Commands::new(&self.gpu);
            crate::wgpu::passes::forward(&mut commands, &mut self.frame, &self.memory, &step)?;
            commands.submit();
            let camera = self.look()?;
            self.reset_counts(camera);
            if camera.is_full == 0 {
                return self.read_image(size);
            }
            self.make_room(&camera)?;
        }
    }

    pub(crate) fn read_image(
        &self,
        [width_px, height_px]: [u32; 2],
    ) -> Result<Rendering, GpuError> {
        let n = width_px as usize * height_px as usize;
        let pixels: Vec<[f32; 4]> = self.gpu.read(&self.frame.per_pixel.image, 0..n)?;
        let depth_sums: Vec<f32> = self.gpu.read(&self.frame.per_pixel.depth_sum, 0..n)?;
        let alpha: Vec<f32> = pixels.iter().map(|[.., t]| 1.0 - t).collect();
        let depths = depth_sums.iter().zip(&alpha);
        Ok(Rendering {
            width_px,
            height_px,
            rgb: pixels
                .iter()
                .flat_map(|[r, g, b, _]| [*r, *g, *b])
                .collect(),
            depth: depths
                .map(|(sum, alpha)| if *alpha > 0.0 { sum / alpha } else { 0.0 })
                .collect(),
            alpha,
        })
    }
}
