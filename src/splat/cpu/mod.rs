//! The native engine: all stages on the CPU, one file each, in the order of a step.
//!
//! `project -> bin -> raster -> loss -> raster_backward -> project_backward -> adam`. Buffers live as long as the engine.
//! Results do not depend on the number of threads: tasks are of fixed size and sums run in a fixed order.

pub mod adam;
pub mod bin;
mod lanes;
pub mod loss;
pub mod pose_adam;
pub mod project;
pub mod project_backward;
pub mod raster;
pub mod raster_backward;
mod sh;
mod ssim;
mod tile_splat;

use adam::{Optimiser, retain_rows};
use bin::Tiles;
use loss::{LossValue, PixelGradients, Target};
use pose_adam::PoseAdam;
use project::{Camera, Projected};
use project_backward::{Forward, SplatGradients};
use raster::Raster;
use raster_backward::InstanceGradients;

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::frame::DepthMap;
use crate::pose::Rigid;
use crate::splat::{Engine, Rendering, Splats, StepSettings, StepStats, TrainingView};

/// Renders and optimises with rayon's global threads.
#[derive(Debug, Default)]
pub struct CpuEngine {
    splats: Splats,
    optimiser: Optimiser,
    views: Vec<View>,
    pass: Pass,
    stats: StepStats,
    n_skipped_updates: u64,
    n_left_out: u64,
}

/// Gradient of one view's loss, for tests and diagnosis. Arrays as in `Splats`, 0 where a splat is not visible.
#[derive(Debug, Clone, PartialEq)]
pub struct Gradients {
    pub means: Vec<[f32; 3]>,
    pub log_scales: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub opacity_logits: Vec<f32>,
    pub sh: Vec<f32>,
    /// rho, theta of `exp([rho; theta]) * cam_from_map`.
    pub pose: [f64; 6],
    /// Photometric, depth and regularisers, weighted.
    pub loss: f64,
    pub l1: f64,
    pub ssim: f64,
    /// Before its weight.
    pub depth: f64,
    pub rendering: Rendering,
    /// Indices of the visible splats, ascending.
    pub visible: Vec<u32>,
}

#[derive(Debug)]
struct View {
    view: TrainingView,
    adam: PoseAdam,
}

/// Buffers of one way there and back.
#[derive(Debug, Default)]
struct Pass {
    projected: Projected,
    tiles: Tiles,
    raster: Raster,
    pixels: PixelGradients,
    instances: InstanceGradients,
    gradients: SplatGradients,
}

/// One view's loss and gradient, without an update.
pub fn gradients(splats: &Splats, view: &TrainingView, settings: &StepSettings) -> Gradients {
    let mut pass = Pass::default();
    let value = pass.differentiate(splats, view, settings);
    let g = &pass.gradients;
    let mut out = Gradients {
        means: vec![[0.0; 3]; splats.len()],
        log_scales: vec![[0.0; 3]; splats.len()],
        quats: vec![[0.0; 4]; splats.len()],
        opacity_logits: vec![0.0; splats.len()],
        sh: vec![0.0; splats.sh.len()],
        pose: g.pose,
        loss: value.total + g.regulariser,
        l1: value.l1,
        ssim: value.ssim,
        depth: value.depth,
        rendering: pass.raster.rendering(),
        visible: pass.projected.splats.iter().map(|s| s.splat_ix).collect(),
    };
    for (v, ix) in out.visible.iter().map(|&ix| ix as usize).enumerate() {
        out.means[ix] = g.means[v];
        out.log_scales[ix] = g.log_scales[v];
        out.quats[ix] = g.quats[v];
        out.opacity_logits[ix] = g.opacity_logits[v];
        out.sh[ix * splats.sh_stride()..][..g.sh_stride]
            .copy_from_slice(&g.sh[v * g.sh_stride..][..g.sh_stride]);
    }
    out
}

impl CpuEngine {
    pub fn new() -> Self {
        Self::default()
    }

    /// Updates left out because a gradient was not finite.
    pub fn n_skipped_updates(&self) -> u64 {
        self.n_skipped_updates
    }

    /// Warns of what went wrong in a step, once of each kind.
    fn count_troubles(&mut self, n_skipped: usize) {
        if n_skipped > 0 && self.n_skipped_updates == 0 {
            tracing::warn!(
                "{n_skipped} gradients are not finite: their splats or poses are not updated; said once"
            );
        }
        self.n_skipped_updates += n_skipped as u64;
        let n_left_out = self.pass.tiles.n_left_out;
        if n_left_out > 0 && self.n_left_out == 0 {
            tracing::warn!(
                "splats are too large: the {n_left_out} farthest of a view are left out; said once"
            );
        }
        self.n_left_out += n_left_out as u64;
    }
}

impl Engine for CpuEngine {
    fn adapter(&self) -> String {
        format!(
            "cpu ({} threads, {})",
            rayon::current_num_threads(),
            instruction_set()
        )
    }

    fn append(&mut self, splats: &Splats) {
        splats.assert_consistent();
        if self.splats.is_empty() {
            self.splats.sh_degree = splats.sh_degree;
        }
        assert_eq!(
            self.splats.sh_degree, splats.sh_degree,
            "all splats of an engine have one SH degree"
        );
        let all = &mut self.splats;
        all.means.extend_from_slice(&splats.means);
        all.log_scales.extend_from_slice(&splats.log_scales);
        all.quats.extend_from_slice(&splats.quats);
        all.opacity_logits.extend_from_slice(&splats.opacity_logits);
        all.sh.extend_from_slice(&splats.sh);
        all.anchors.extend_from_slice(&splats.anchors);
        self.optimiser.resize(&self.splats);
    }

    fn retain(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.splats.len(), "one flag per splat");
        let sh_stride = self.splats.sh_stride();
        let all = &mut self.splats;
        retain_rows(&mut all.means, 1, keep);
        retain_rows(&mut all.log_scales, 1, keep);
        retain_rows(&mut all.quats, 1, keep);
        retain_rows(&mut all.opacity_logits, 1, keep);
        retain_rows(&mut all.sh, sh_stride, keep);
        retain_rows(&mut all.anchors, 1, keep);
        self.optimiser.retain(sh_stride, keep);
    }

    fn overwrite(&mut self, splats: &Splats) {
        splats.assert_consistent();
        assert_eq!(
            (splats.len(), splats.sh_degree),
            (self.splats.len(), self.splats.sh_degree),
            "same splats, new numbers"
        );
        self.splats.clone_from(splats);
    }

    fn n_splats(&self) -> usize {
        self.splats.len()
    }

    fn add_view(&mut self, view: TrainingView) -> usize {
        let (image, intrinsics) = (&view.image, &view.intrinsics);
        let size = (image.width_px, image.height_px);
        assert_eq!(
            size,
            (intrinsics.width_px, intrinsics.height_px),
            "a view's intrinsics are those of its image"
        );
        assert_eq!(
            image.pixels.len(),
            3 * size.0 as usize * size.1 as usize,
            "an image is as large as it says"
        );
        self.views.push(View {
            view,
            adam: PoseAdam::default(),
        });
        self.views.len() - 1
    }

    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid) {
        let view = &mut self.views[view_ix];
        view.view.cam_from_map = cam_from_map;
        view.adam = PoseAdam::default();
    }

    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>) {
        self.views[view_ix].view.depth = depth;
    }

    fn step(&mut self, view_ix: usize, settings: &StepSettings) {
        let view = &mut self.views[view_ix];
        let value = self.pass.differentiate(&self.splats, &view.view, settings);
        self.stats.n_steps += 1;
        self.stats.loss += value.total + self.pass.gradients.regulariser;
        self.stats.l1 += value.l1;
        self.stats.ssim += value.ssim;
        if self.pass.projected.splats.is_empty() {
            return;
        }
        let mut n_skipped = 0;
        if settings.train_pose {
            let rates = [settings.lr_pose_translation, settings.lr_pose_rotation];
            match view
                .adam
                .update(&view.view.cam_from_map, self.pass.gradients.pose, rates)
            {
                Some(pose) => view.view.cam_from_map = pose,
                None => n_skipped += 1,
            }
        }
        if settings.train_splats {
            n_skipped += self.optimiser.update(
                &mut self.splats,
                &self.pass.projected,
                &self.pass.gradients,
                settings,
            );
        }
        self.count_troubles(n_skipped);
    }

    fn take_stats(&mut self) -> StepStats {
        let sums = std::mem::take(&mut self.stats);
        let n = sums.n_steps.max(1) as f64;
        StepStats {
            n_steps: sums.n_steps,
            loss: sums.loss / n,
            l1: sums.l1 / n,
            ssim: sums.ssim / n,
        }
    }

    fn poses(&mut self) -> Vec<Rigid> {
        self.views
            .iter()
            .map(|view| view.view.cam_from_map)
            .collect()
    }

    fn splats(&mut self) -> Splats {
        self.splats.clone()
    }

    fn render(
        &mut self,
        intrinsics: &Intrinsics,
        cam_from_map: &Rigid,
        sh_degree: u8,
    ) -> Rendering {
        self.pass.render(
            &self.splats,
            &Camera::new(intrinsics, cam_from_map),
            sh_degree,
        );
        self.pass.raster.rendering()
    }
}

impl Pass {
    fn render(&mut self, splats: &Splats, camera: &Camera, sh_degree: u8) {
        project::project(splats, camera, sh_degree, &mut self.projected);
        bin::bin(
            &self.projected.splats,
            camera.width_px,
            camera.height_px,
            &mut self.tiles,
        );
        raster::raster(&self.projected.splats, &self.tiles, &mut self.raster);
    }

    fn differentiate(
        &mut self,
        splats: &Splats,
        view: &TrainingView,
        settings: &StepSettings,
    ) -> LossValue {
        let camera = Camera::new(&view.intrinsics, &view.cam_from_map);
        self.render(splats, &camera, settings.sh_degree);
        let visible = &self.projected.splats;
        let target = Target {
            image: &view.image,
            depth: view.depth.as_deref(),
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

impl Splats {
    /// Our own mistake when it fails: readers of files check before.
    fn assert_consistent(&self) {
        let n = self.means.len();
        let lengths = [
            self.log_scales.len(),
            self.quats.len(),
            self.opacity_logits.len(),
            self.anchors.len(),
        ];
        assert_eq!(lengths, [n; 4], "all attributes of splats have one length");
        assert!(
            self.sh_degree <= 3,
            "SH degree {} is above 3",
            self.sh_degree
        );
        assert_eq!(
            self.sh.len(),
            n * self.sh_stride(),
            "SH has `sh_stride` numbers a splat"
        );
    }
}

fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        if !has!("avx2") || !has!("fma") {
            return "sse2";
        }
        let has_avx512 =
            has!("avx512f") && has!("avx512vl") && has!("avx512bw") && has!("avx512dq");
        if has_avx512 { "avx512" } else { "avx2+fma" }
    }
    #[cfg(target_arch = "aarch64")]
    {
        "neon"
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    {
        "scalar"
    }
}
