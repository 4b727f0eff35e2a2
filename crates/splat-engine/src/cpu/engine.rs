//! The native engine: all stages on the CPU, one file each, in the order of a step.
//!
//! `project -> bin -> raster -> loss -> raster_backward -> project_backward -> adam`. Buffers live as long as the engine.
//! Results do not depend on the number of threads: tasks are of fixed size and sums run in a fixed order.

use std::collections::BTreeMap;

use crate::appearance::AppearanceNetwork;
use crate::cpu::adam::Optimiser;
use crate::cpu::exposure::Exposure;
use crate::cpu::pass::Pass;
use crate::cpu::pose_adam::FewAdam;
use crate::cpu::view::View;
use crate::epipolar::{self, Eye};
use crate::gradients::Gradients;
use crate::pose_network::PoseNetwork;
use crate::settings::{PoseMode, StepSettings, StepStats};
use crate::view::TrainingView;
use splat_types::splats::splats::Splats;

/// Renders and optimises with rayon's global threads.
#[derive(Debug, Default)]
pub struct CpuEngine {
    pub(crate) splats: Splats,
    pub(crate) optimiser: Optimiser,
    pub(crate) views: Vec<View>,
    pub(crate) pose_network: Option<PoseNetwork>,
    /// Once a step has moved it.
    pub(crate) appearance: Option<AppearanceNetwork>,
    pub(crate) log_focal: f64,
    focal_adam: FewAdam<1>,
    pub(crate) pass: Pass,
    pub(crate) stats: StepStats,
    /// Steps that were to move splats, this one included.
    pub(crate) n_trained: u32,
    n_skipped_updates: u64,
    n_left_out: u64,
}

/// One view's loss and gradient, without an update: for tests and diagnosis.
pub fn gradients(splats: &Splats, view: &TrainingView, settings: &StepSettings) -> Gradients {
    gradients_exposed(splats, view, Exposure::default(), settings)
}

/// [`gradients`] at log gains and offsets of r, g, b that are not 0.
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
    /// Without splats and views.
    pub fn new() -> Self {
        Self::default()
    }

    /// Updates of splats, poses and exposures that were left out because a gradient was not finite.
    pub fn n_skipped_updates(&self) -> u64 {
        self.n_skipped_updates
    }

    pub(crate) fn train(&mut self, view_ix: usize, settings: &StepSettings) {
        self.n_trained = self
            .n_trained
            .wrapping_add(u32::from(settings.train_splats));
        let view = self.views[view_ix].seen(self.pose_network.as_ref(), self.log_focal.exp());
        let exposure = self.views[view_ix].exposure(self.appearance.as_ref());
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
        if settings.lr_appearance > 0.0 {
            let network = self.appearance.get_or_insert_default();
            let view = &mut self.views[view_ix];
            let is_updated = view.step_appearance(network, value.exposure, settings.lr_appearance);
            n_skipped += usize::from(!is_updated);
        }
        if settings.train_splats {
            let (splats, seen) = (&mut self.splats, &self.pass.projected);
            let g = &self.pass.gradients;
            n_skipped += self
                .optimiser
                .update(splats, seen, g, settings, self.n_trained);
            if settings.all_splats {
                self.optimiser
                    .update_unseen(splats, settings, self.n_trained);
            }
            if settings.accumulate_screen_gradients {
                let size_px = [view.image.width_px, view.image.height_px];
                let sums = &mut self.optimiser.screen_gradients;
                sums.add(splats.len(), seen, g, size_px);
            }
            crate::cpu::mcmc::add_noise(splats, seen, settings, self.n_trained);
        }
        self.count_troubles(n_skipped);
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
            is_updated = view.step_alone(self.pose_network.as_ref(), gradient, settings);
        }
        if let (PoseMode::Shared, Some(pose_network)) = (settings.pose, &mut self.pose_network) {
            is_updated &= view.step_shared(pose_network, gradient, settings.lr_pose_network);
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
            cam_from_world: view.cam_from_world,
        };
        let matches = &self.views[view_ix].matches;
        let mut others = BTreeMap::new();
        for ix in matches.iter().map(|found| found.other_view_ix) {
            others.entry(ix).or_insert_with(|| {
                let view = self.views.get(ix as usize)?;
                Some(eye(
                    &view.seen(self.pose_network.as_ref(), self.log_focal.exp())
                ))
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
