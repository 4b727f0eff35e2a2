//! Splats -> picture, and the way back: the engine that renders and optimises.
//!
//! `Engine` is the wall between the map (policy) and a backend (arithmetic). Nothing above it may assume where
//! the numbers live: a step returns nothing, statistics arrive later, read-backs are explicit and rare.

pub mod cpu;

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::frame::{DepthMap, RgbImage};
use crate::pose::Rigid;

/// 3D Gaussians as structure of arrays, before activation, in the map frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splats {
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the standard deviation along each own axis, map units.
    pub log_scales: Vec<[f32; 3]>,
    /// w, x, y, z; normalised on use.
    pub quats: Vec<[f32; 4]>,
    pub opacity_logits: Vec<f32>,
    /// `sh[splat][coefficient][rgb]` flattened, `3 * (sh_degree + 1)^2` numbers a splat.
    pub sh: Vec<f32>,
    /// 0 to 3, the same for all.
    pub sh_degree: u8,
    /// Keyframe that each splat was seeded from; a pose correction carries its splats along.
    pub anchors: Vec<u32>,
}

/// A picture to train on. Index in the engine = order of `add_view`.
#[derive(Debug, Clone)]
pub struct TrainingView {
    pub image: Arc<RgbImage>,
    pub intrinsics: Intrinsics,
    pub cam_from_map: Rigid,
    /// In map units; guides the depth loss where confidence > 0. May be smaller than the image.
    pub depth: Option<Arc<DepthMap>>,
}

/// Numbers of one step; the map's schedule sets them.
#[derive(Debug, Clone, PartialEq)]
pub struct StepSettings {
    pub lr_mean: f32,
    pub lr_scale: f32,
    pub lr_quat: f32,
    pub lr_opacity: f32,
    pub lr_sh0: f32,
    pub lr_sh_rest: f32,
    /// Adam rate of the pose delta: radians for rotation.
    pub lr_pose_rotation: f32,
    /// Adam rate of the pose delta: map units for translation.
    pub lr_pose_translation: f32,
    /// Share of 1 - SSIM in the photometric loss; the rest is L1.
    pub ssim_weight: f32,
    /// Weight of the inverse depth loss; 0 turns it off.
    pub depth_weight: f32,
    /// Weights of mean opacity and mean scale over the visible splats (3DGS-MCMC regularisers).
    pub opacity_reg: f32,
    pub scale_reg: f32,
    /// SH bands above this degree are neither used nor trained.
    pub sh_degree: u8,
    /// false: the splats are frozen and only the view's pose moves (test-time refinement).
    pub train_splats: bool,
    pub train_pose: bool,
}

/// Means over the steps since it was last taken.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepStats {
    pub n_steps: u64,
    pub loss: f64,
    pub l1: f64,
    pub ssim: f64,
}

/// A rendered view, row by row. `depth` is the expected depth of what was hit, 0 where alpha is 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    pub width_px: u32,
    pub height_px: u32,
    /// r g b per pixel, linear in the stored colour, not clamped above.
    pub rgb: Vec<f32>,
    pub alpha: Vec<f32>,
    pub depth: Vec<f32>,
}

/// Renders and optimises splats and poses on one device. One thread owns it.
pub trait Engine: Send {
    /// For logs and `report.json`, for example `cpu (2 threads, avx2)`.
    fn adapter(&self) -> String;

    /// Adds splats behind those that are there, with fresh optimiser state. All must share one SH degree.
    fn append(&mut self, splats: &Splats);

    /// Keeps splat i when `keep[i]`, in order, with its optimiser state.
    fn retain(&mut self, keep: &[bool]);

    /// Overwrites the parameters of all splats (same count), optimiser state stays. For pose corrections that carry splats along.
    fn overwrite(&mut self, splats: &Splats);

    fn n_splats(&self) -> usize;

    /// Returns the index of the view.
    fn add_view(&mut self, view: TrainingView) -> usize;

    /// Replaces a view's pose and clears its optimiser state.
    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid);

    /// Replaces the depth that guides a view's depth loss.
    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>);

    /// One optimiser update on one view. Reads nothing back; a view that sees no splat changes nothing.
    fn step(&mut self, view_ix: usize, settings: &StepSettings);

    /// Waits for all steps and takes their statistics.
    fn take_stats(&mut self) -> StepStats;

    /// Waits for all steps and reads all refined poses back, by view index.
    fn poses(&mut self) -> Vec<Rigid>;

    /// Waits for all steps and reads the splats back.
    fn splats(&mut self) -> Splats;

    /// Renders at the given SH degree, black background.
    fn render(&mut self, intrinsics: &Intrinsics, cam_from_map: &Rigid, sh_degree: u8)
    -> Rendering;
}

impl Splats {
    pub fn len(&self) -> usize {
        self.means.len()
    }

    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Numbers of SH per splat.
    pub fn sh_stride(&self) -> usize {
        3 * (usize::from(self.sh_degree) + 1).pow(2)
    }

    /// Whether every number of splat `i` is finite.
    pub fn is_finite(&self, i: usize) -> bool {
        let stride = self.sh_stride();
        self.means[i].iter().all(|v| v.is_finite())
            && self.log_scales[i].iter().all(|v| v.is_finite())
            && self.quats[i].iter().all(|v| v.is_finite())
            && self.opacity_logits[i].is_finite()
            && self.sh[i * stride..(i + 1) * stride]
                .iter()
                .all(|v| v.is_finite())
    }

    /// Drops all behind the first `n`.
    pub fn truncate(&mut self, n: usize) {
        let stride = self.sh_stride();
        self.means.truncate(n);
        self.log_scales.truncate(n);
        self.quats.truncate(n);
        self.opacity_logits.truncate(n);
        self.anchors.truncate(n);
        self.sh.truncate(n * stride);
    }

    /// Only splats whose every number is finite: clients and viewers rely on it.
    pub fn into_finite(self) -> Self {
        if (0..self.len()).all(|i| self.is_finite(i)) {
            return self;
        }
        let stride = self.sh_stride();
        let mut kept = Self {
            sh_degree: self.sh_degree,
            ..Self::default()
        };
        for i in (0..self.len()).filter(|i| self.is_finite(*i)) {
            kept.means.push(self.means[i]);
            kept.log_scales.push(self.log_scales[i]);
            kept.quats.push(self.quats[i]);
            kept.opacity_logits.push(self.opacity_logits[i]);
            kept.anchors.push(self.anchors[i]);
            kept.sh
                .extend_from_slice(&self.sh[i * stride..(i + 1) * stride]);
        }
        kept
    }
}
