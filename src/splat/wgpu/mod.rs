//! The engine on a GPU: the stages of the CPU engine as shaders, in one submission a step.
//!
//! A step reads nothing back. Whether there was room for its instances, the host learns some steps later; steps behind
//! one that had none do nothing, and are made again once there is. So the result does not depend on when the host looks.

mod frame;
mod gradients;
mod memory;
mod moves;
mod passes;
mod room;
mod steps;
mod views;

use std::collections::VecDeque;
use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::frame::{DepthMap, RgbImage};
use crate::gpu::GpuError;
use crate::gpu::commands::Commands;
use crate::gpu::device::{Gpu, Wanted};
use crate::gpu::kernel::{self, Kernel};
use crate::pose::Rigid;
use crate::splat::{
    Engine, Match, McmcSettings, RefinerSettings, Rendering, Splats, StepSettings, StepStats,
    TrainingView,
};
use frame::Frame;
use memory::SplatMemory;
use views::Views;

pub use gradients::gradients;

/// Statistics that a step adds to.
const N_STATS: usize = 4;

/// Renders and optimises on one adapter.
#[derive(Debug)]
pub struct WgpuEngine {
    gpu: Gpu,
    memory: SplatMemory,
    frame: Frame,
    views: Views,
    /// Submitted, and not yet known to have had room: view, settings, number of the step.
    unconfirmed: VecDeque<(usize, StepSettings, u32)>,
    /// Steps that were to move splats.
    n_trained: u32,
    fault: Option<String>,
    has_warned_of_room: bool,
}

impl WgpuEngine {
    /// On the best adapter. The shaders are compiled here, so that a fault shows before anything is mapped.
    pub fn new(wanted: Wanted) -> Result<Self, GpuError> {
        let gpu = Gpu::open(wanted)?;
        let is_fit = |kernel: &&Kernel| {
            let is_sweep = kernel::SWEEP.iter().any(|other| other.name == kernel.name);
            let is_atomic = kernel.name == kernel::RASTER_BACKWARD_ATOMIC.name;
            !is_sweep && (gpu.has_float_atomics() || !is_atomic)
        };
        let kernels: Vec<_> = kernel::ALL.iter().copied().filter(is_fit).collect();
        gpu.compile(&kernels)?;
        Ok(Self {
            memory: SplatMemory::new(&gpu, 0)?,
            frame: Frame::new(&gpu)?,
            views: Views::new(&gpu)?,
            unconfirmed: VecDeque::new(),
            n_trained: 0,
            fault: None,
            has_warned_of_room: false,
            gpu,
        })
    }

    /// Whether sums of floats are made in any order: asked for, and the adapter can.
    pub fn sums_in_any_order(&self) -> bool {
        self.gpu.has_float_atomics()
    }

    /// Notes the first fault; what needs the GPU from then on answers nothing.
    fn note<T>(&mut self, result: Result<T, GpuError>) -> Option<T> {
        result
            .map_err(|error| {
                if self.fault.is_none() {
                    tracing::error!("{error}");
                    self.fault = Some(error.to_string());
                }
            })
            .ok()
    }

    fn try_render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_map: &Rigid,
        sh_degree: u8,
    ) -> Result<Rendering, GpuError> {
        self.confirm()?;
        let size = [intrinsics.width_px, intrinsics.height_px];
        self.frame.fit(&self.gpu, self.memory.n, size)?;
        loop {
            let step = self.picture_of(size, sh_degree);
            self.write_step(&step);
            let camera = views::camera_of(intrinsics, cam_from_map);
            self.gpu.write(&self.frame.camera, 0, &[camera]);
            let mut commands = Commands::new(&self.gpu);
            passes::forward(&mut commands, &mut self.frame, &self.memory, &step)?;
            commands.submit();
            let camera = self.look()?;
            self.reset_counts(camera);
            if camera.is_full == 0 {
                return self.read_picture(size);
            }
            self.make_room(&camera)?;
        }
    }

    fn read_picture(&self, [width_px, height_px]: [u32; 2]) -> Result<Rendering, GpuError> {
        let n = width_px as usize * height_px as usize;
        let pixels: Vec<[f32; 4]> = self.gpu.read(&self.frame.per_pixel.picture, 0..n)?;
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

impl Engine for WgpuEngine {
    fn adapter(&self) -> String {
        format!("wgpu ({})", self.gpu.name())
    }

    fn append(&mut self, splats: &Splats) {
        let result = self.try_append(splats);
        self.note(result);
    }

    fn retain(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.memory.n, "one flag per splat");
        let result = self
            .confirm()
            .and_then(|()| self.memory.retain(&self.gpu, keep));
        self.gpu.forget_bindings();
        self.note(result);
    }

    fn overwrite(&mut self, splats: &Splats) {
        assert_eq!(
            (splats.len(), splats.sh_degree),
            (self.memory.n, self.memory.sh_degree),
            "same splats, new numbers"
        );
        let result = self
            .confirm()
            .and_then(|()| self.memory.overwrite(&self.gpu, splats));
        self.note(result);
    }

    fn n_splats(&self) -> usize {
        self.memory.n
    }

    fn add_view(&mut self, view: TrainingView) -> usize {
        view.assert_consistent();
        let result = self
            .confirm()
            .and_then(|()| self.views.add(&self.gpu, view));
        let n = self.views.all.len();
        self.note(result).unwrap_or(n)
    }

    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid) {
        let result = self
            .confirm()
            .and_then(|()| self.views.set_pose(&self.gpu, view_ix, cam_from_map));
        self.note(result);
    }

    fn move_cameras(&mut self, new_from_old: &Rigid) {
        let result = self
            .confirm()
            .and_then(|()| self.views.move_cameras(&self.gpu, new_from_old));
        self.note(result);
    }

    fn set_intrinsics(&mut self, view_ix: usize, intrinsics: &Intrinsics) {
        let result = self.confirm();
        let training = &mut self.views.all[view_ix].training;
        training.intrinsics = *intrinsics;
        training.assert_consistent();
        self.views.write_camera(&self.gpu, view_ix, intrinsics);
        self.note(result);
    }

    fn start_refiner(&mut self, settings: &RefinerSettings) {
        let result = self
            .confirm()
            .and_then(|()| self.views.start_refiner(&self.gpu, settings));
        self.note(result);
    }

    fn set_image(&mut self, view_ix: usize, image: Arc<RgbImage>, intrinsics: &Intrinsics) {
        let result = self.confirm().and_then(|()| {
            let view = &mut self.views.all[view_ix];
            view.training.image = image;
            view.upload(&self.gpu)
        });
        self.note(result);
        self.set_intrinsics(view_ix, intrinsics);
    }

    fn rest_view(&mut self, view_ix: usize) {
        let result = self
            .confirm()
            .and_then(|()| self.views.all[view_ix].rest(&self.gpu));
        self.note(result);
    }

    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>) {
        let result = self.confirm().and_then(|()| {
            let view = &mut self.views.all[view_ix];
            view.training.depth = depth;
            view.upload(&self.gpu)
        });
        self.note(result);
    }

    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) {
        let result = self.confirm().and_then(|()| {
            let view = &mut self.views.all[view_ix];
            view.training.mask = mask;
            view.training.assert_consistent();
            view.upload(&self.gpu)
        });
        self.note(result);
    }

    fn set_matches(&mut self, view_ix: usize, matches: &[Match]) {
        self.views.all[view_ix].matches = matches.to_vec();
    }

    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> usize {
        let result = self.confirm().and_then(|()| {
            moves::relocate_and_grow(&self.gpu, &mut self.memory, settings, self.n_trained)
        });
        self.note(result);
        self.memory.n
    }

    fn step(&mut self, view_ix: usize, settings: &StepSettings) {
        if self.fault.is_none() {
            let result = self.try_step(view_ix, settings);
            self.note(result);
        }
    }

    fn take_stats(&mut self) -> StepStats {
        let result = self
            .confirm()
            .and_then(|()| self.gpu.read::<f32>(&self.frame.stats, 0..N_STATS));
        let Some(sums) = self.note(result) else {
            return StepStats::default();
        };
        self.gpu.write(&self.frame.stats, 0, &[0.0_f32; N_STATS]);
        let n = f64::from(sums[0].max(1.0));
        StepStats {
            n_steps: sums[0] as u64,
            loss: f64::from(sums[1]) / n,
            l1: f64::from(sums[2]) / n,
            ssim: f64::from(sums[3]) / n,
        }
    }

    fn poses(&mut self) -> Vec<Rigid> {
        let result = self.confirm().and_then(|()| self.views.poses(&self.gpu));
        let poses = self.note(result);
        poses.unwrap_or_else(|| {
            let views = self.views.all.iter();
            views.map(|view| view.training.cam_from_map).collect()
        })
    }

    fn focal_factor(&mut self) -> f64 {
        let result = self
            .confirm()
            .and_then(|()| self.views.focal_factor(&self.gpu));
        self.note(result).unwrap_or(1.0)
    }

    fn exposures(&mut self) -> Vec<[[f32; 3]; 2]> {
        let result = self
            .confirm()
            .and_then(|()| self.views.exposures(&self.gpu));
        self.note(result).unwrap_or_default()
    }

    fn fault(&self) -> Option<String> {
        self.fault.clone()
    }

    fn peak_gpu_bytes(&self) -> u64 {
        self.gpu.meter().peak_bytes()
    }

    fn held_bytes(&self) -> u64 {
        self.gpu.meter().held_bytes()
    }

    fn room_within(&self, max_bytes: u64) -> usize {
        room::splats_within(self, max_bytes)
    }

    fn ages(&mut self) -> Vec<u16> {
        let result = self.confirm().and_then(|()| self.memory.ages(&self.gpu));
        self.note(result).unwrap_or_default()
    }

    fn set_ages(&mut self, first: usize, ages: &[u16]) {
        let n = self.memory.n.saturating_sub(first).min(ages.len());
        let result = self.confirm();
        self.memory.set_ages(&self.gpu, first, &ages[..n]);
        self.note(result);
    }

    fn splats(&mut self) -> Splats {
        let result = self.confirm().and_then(|()| self.memory.read(&self.gpu));
        self.note(result).unwrap_or_default()
    }

    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_map: &Rigid,
        sh_degree: u8,
    ) -> Rendering {
        let result = self.try_render(intrinsics, cam_from_map, sh_degree);
        self.note(result).unwrap_or_else(|| {
            let n = intrinsics.width_px as usize * intrinsics.height_px as usize;
            Rendering {
                width_px: intrinsics.width_px,
                height_px: intrinsics.height_px,
                rgb: vec![0.0; 3 * n],
                alpha: vec![0.0; n],
                depth: vec![0.0; n],
            }
        })
    }
}
