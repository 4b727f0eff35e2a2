//! The native engine: all stages on the CPU, one file each, in the order of a step.
//!
//! `project -> bin -> raster -> loss -> raster_backward -> project_backward -> adam`. Buffers live as long as the engine.
//! Results do not depend on the number of threads: tasks are of fixed size and sums run in a fixed order.

pub mod adam;
mod adam_sh;
pub mod bin;
mod exposure;
mod lanes;
pub mod loss;
mod loss_depth;
mod moves;
mod pass;
pub mod pose_adam;
pub mod project;
pub mod project_backward;
pub mod raster;
pub mod raster_backward;
mod rows;
pub(crate) mod sh;
mod ssim;
mod tile_splat;
mod view;

use adam::Optimiser;
use exposure::Exposure;
use pass::Pass;
use pose_adam::FewAdam;
use project::Camera;
use view::View;

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::frame::{DepthMap, RgbImage};
use crate::pose::Rigid;
use crate::splat::epipolar::{self, Eye};
use crate::splat::gradients::Gradients;
use crate::splat::refiner::Refiner;
use crate::splat::{
    Engine, Match, McmcSettings, PoseStep, RefinerSettings, Rendering, Splats, StepSettings,
    StepStats, TrainingView,
};

/// Rows grow by a quarter at a time, and the largest attribute is there twice while it grows.
const MAX_SPARE: f64 = 1.75;

/// Renders and optimises with rayon's global threads.
#[derive(Debug, Default)]
pub struct CpuEngine {
    splats: Splats,
    optimiser: Optimiser,
    views: Vec<View>,
    refiner: Option<Refiner>,
    log_focal: f64,
    focal_adam: FewAdam<1>,
    pass: Pass,
    stats: StepStats,
    /// Steps that were to move splats, this one included.
    n_trained: u32,
    n_skipped_updates: u64,
    n_left_out: u64,
}

/// One view's loss and gradient, without an update.
pub fn gradients(splats: &Splats, view: &TrainingView, settings: &StepSettings) -> Gradients {
    gradients_exposed(splats, view, Exposure::default(), settings)
}

/// The same at log gains and offsets of r, g, b that are not 0.
pub fn gradients_exposed(
    splats: &Splats,
    view: &TrainingView,
    exposure: [[f32; 3]; 2],
    settings: &StepSettings,
) -> Gradients {
    let mut pass = Pass::default();
    let value = pass.differentiate(splats, view, exposure, settings);
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
        exposure: value.exposure,
        log_focal: g.log_focal,
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

    /// Moves what the step lets move of the camera that was `seen`. Returns the updates left out.
    fn step_camera(
        &mut self,
        view_ix: usize,
        seen: &TrainingView,
        settings: &StepSettings,
    ) -> usize {
        let mut gradient = self.pass.gradients.pose;
        if settings.epipolar_weight > 0.0 {
            let of_matches = self.epipolar_gradient(view_ix, seen);
            let weight = f64::from(settings.epipolar_weight);
            gradient
                .iter_mut()
                .zip(of_matches)
                .for_each(|(g, v)| *g += weight * v);
        }
        let view = &mut self.views[view_ix];
        // Both parts answer to the gradient at the pose that was seen.
        let mut is_updated = true;
        if settings.moves_alone() {
            is_updated = view.step_alone(self.refiner.as_ref(), gradient, settings);
        }
        if let (PoseStep::Shared, Some(refiner)) = (settings.pose, &mut self.refiner) {
            is_updated &= view.step_shared(refiner, gradient, settings.lr_refiner);
        }
        let mut n_skipped = usize::from(!is_updated);
        if settings.lr_focal > 0.0 {
            match self.focal_adam.direction([self.pass.gradients.log_focal]) {
                Some([change]) => self.log_focal += f64::from(settings.lr_focal) * change,
                None => n_skipped += 1,
            }
        }
        n_skipped
    }

    fn epipolar_gradient(&self, view_ix: usize, seen: &TrainingView) -> [f64; 6] {
        let eye = |view: &TrainingView| Eye {
            intrinsics: view.intrinsics,
            cam_from_map: view.cam_from_map,
        };
        let matches = &self.views[view_ix].matches;
        let mut others = BTreeMap::new();
        for ix in matches.iter().map(|found| found.other_view_ix) {
            others.entry(ix).or_insert_with(|| {
                let view = self.views.get(ix as usize)?;
                Some(eye(&view.seen(self.refiner.as_ref(), self.log_focal.exp())))
            });
        }
        let other = |ix: u32| others.get(&ix).copied().flatten();
        epipolar::epipolar(&eye(seen), matches, other).1
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
            lanes::instruction_set()
        )
    }

    fn append(&mut self, splats: &Splats) {
        self.splats.extend(splats);
        self.optimiser.resize(&self.splats, self.n_trained);
    }

    fn retain(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.splats.len(), "one flag per splat");
        self.splats.retain(keep);
        self.optimiser.retain(self.splats.sh_stride(), keep);
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
        let new = View::new(view, self.views.len(), self.refiner.as_ref());
        self.views.push(new);
        self.views.len() - 1
    }

    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid) {
        self.views[view_ix].set_pose(cam_from_map, self.refiner.as_ref());
    }

    fn move_cameras(&mut self, new_from_old: &Rigid) {
        let old_from_new = new_from_old.inverse();
        for view in &mut self.views {
            let base = &mut view.training_mut().cam_from_map;
            *base = (*base * old_from_new).renormalized();
        }
    }

    fn set_intrinsics(&mut self, view_ix: usize, intrinsics: &Intrinsics) {
        let view = self.views[view_ix].training_mut();
        view.intrinsics = *intrinsics;
        view.assert_consistent();
    }

    fn set_image(&mut self, view_ix: usize, image: Arc<RgbImage>, intrinsics: &Intrinsics) {
        self.views[view_ix].training_mut().image = image;
        self.set_intrinsics(view_ix, intrinsics);
    }

    fn rest_view(&mut self, view_ix: usize) {
        self.views[view_ix].rest();
    }

    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>) {
        self.views[view_ix].training_mut().depth = depth;
    }

    fn start_refiner(&mut self, settings: &RefinerSettings) {
        let old = self.refiner.take();
        for (ix, view) in self.views.iter_mut().enumerate() {
            view.fold(ix, old.as_ref());
        }
        self.refiner = Some(Refiner::new(settings));
    }

    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>) {
        self.views[view_ix].set_mask(mask);
    }

    fn set_matches(&mut self, view_ix: usize, matches: &[Match]) {
        self.views[view_ix].matches = matches.to_vec();
    }

    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> usize {
        let (splats, optimiser) = (&mut self.splats, &mut self.optimiser);
        moves::relocate_and_grow(splats, optimiser, settings, self.n_trained);
        self.splats.len()
    }

    fn focal_factor(&mut self) -> f64 {
        self.log_focal.exp()
    }

    fn exposures(&mut self) -> Vec<[[f32; 3]; 2]> {
        self.views.iter().map(|view| view.exposure).collect()
    }

    fn peak_gpu_bytes(&self) -> u64 {
        0
    }

    fn held_bytes(&self) -> u64 {
        let of_splats = self.splats.held_bytes() + self.optimiser.held_bytes();
        let of_views: usize = self.views.iter().map(View::held_bytes).sum();
        (of_splats + of_views) as u64
    }

    fn room_within(&self, max_bytes: u64) -> usize {
        let of_views: usize = self.views.iter().map(View::held_bytes).sum();
        let free = (max_bytes as usize).saturating_sub(of_views);
        (free as f64 / (MAX_SPARE * Optimiser::bytes_per_splat(self.splats.sh_degree) as f64))
            as usize
    }

    fn ages(&mut self) -> Vec<u16> {
        self.optimiser.ages()
    }

    fn set_ages(&mut self, first: usize, ages: &[u16]) {
        self.optimiser.set_ages(first, ages);
    }

    fn step(&mut self, view_ix: usize, settings: &StepSettings) {
        self.n_trained = self
            .n_trained
            .wrapping_add(u32::from(settings.train_splats));
        let view = self.views[view_ix].seen(self.refiner.as_ref(), self.log_focal.exp());
        let exposure = self.views[view_ix].exposure;
        let value = self
            .pass
            .differentiate(&self.splats, &view, exposure, settings);
        self.stats.n_steps += 1;
        self.stats.loss += value.total + self.pass.gradients.regulariser;
        self.stats.l1 += value.l1;
        self.stats.ssim += value.ssim;
        if self.pass.projected.splats.is_empty() {
            return;
        }
        let mut n_skipped = self.step_camera(view_ix, &view, settings);
        if settings.lr_exposure > 0.0 {
            let view = &mut self.views[view_ix];
            let is_updated = view.step_exposure(value.exposure, settings.lr_exposure);
            n_skipped += usize::from(!is_updated);
        }
        if settings.train_splats {
            let (splats, seen) = (&mut self.splats, &self.pass.projected);
            let g = &self.pass.gradients;
            n_skipped += self
                .optimiser
                .update(splats, seen, g, settings, self.n_trained);
            moves::shake(splats, seen, settings, self.n_trained);
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
            .map(|view| view.pose(self.refiner.as_ref()))
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
