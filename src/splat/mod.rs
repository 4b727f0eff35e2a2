//! Splats -> picture, and the way back: the engine that renders and optimises.
//!
//! `Engine` is the wall between the map (policy) and a backend (arithmetic). Nothing above it may assume where
//! the numbers live: a step returns nothing, statistics arrive later, read-backs are explicit and rare.

pub mod cpu;
pub mod epipolar;
pub mod gradients;
pub mod mcmc;
pub mod refiner;
pub mod sh_rotation;
pub mod wgpu;

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

/// A picture to train on, or a hollow one, which no step may have. Index in the engine = order of `add_view`.
#[derive(Debug, Clone)]
pub struct TrainingView {
    pub image: Arc<RgbImage>,
    pub intrinsics: Intrinsics,
    pub cam_from_map: Rigid,
    /// In map units; guides the depth loss where confidence > 0. May be smaller than the image.
    pub depth: Option<Arc<DepthMap>>,
    /// Weight of each pixel in the photometric loss, 255 = all; what moves gets less. `None`: all count.
    pub mask: Option<Arc<[u8]>>,
}

/// What the depth loss compares. Equations: docs/GRADIENTS.md, losses.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DepthMode {
    /// Relative error of inverse expected depth, Huber, weighted by confidence.
    #[default]
    InverseDepth,
    /// Expected depth and inverted inverse depth, each stretched to 0..1 over the picture (FastSplatting, code).
    PaperCode,
    /// Alpha and depth, each stretched to 0..1 over the picture (FastSplatting, text).
    PaperAlpha,
}

/// How a step may move the view's pose.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PoseStep {
    #[default]
    Held,
    /// The view's own increment of six numbers.
    Direct,
    /// The network that all views share (3R-GS), and what it leaves by the view's own increment.
    Shared,
}

/// The network that moves all poses together; see `refiner`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinerSettings {
    pub seed: u64,
    /// Map units that an output of 1 moves a camera by: RMS distance of the cameras to their mean.
    pub camera_scale: f32,
}

/// One pass of MCMC moves (Kheradmand et al. 2024).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct McmcSettings {
    /// Splats of at most this opacity are dead and move to live ones.
    pub min_opacity: f32,
    pub copies: mcmc::Copies,
    /// Splats that there may be in all.
    pub max_splats: usize,
    /// Count after growth as a multiple of the count before, 1.05 in the paper; 1: none are added.
    pub growth: f32,
    /// Only splats that one of the last so many steps has seen take part; 0: all.
    pub active_steps: u32,
    /// Different in every pass.
    pub seed: u32,
}

/// A point seen in two views: pixels of the training pictures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    pub own_px: [f32; 2],
    pub other_view_ix: u32,
    pub other_px: [f32; 2],
    pub weight: f32,
}

/// Numbers of one step; the map's schedule sets them. The default changes nothing.
#[derive(Debug, Clone, Default, PartialEq)]
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
    /// Adam rate of the shared network and of the views' embeddings.
    pub lr_refiner: f32,
    /// Adam rate of the logarithm of the factor on all focal lengths; 0 holds it.
    pub lr_focal: f32,
    /// Adam rate of the view's gain and offset per channel; 0 holds them.
    pub lr_exposure: f32,
    /// Weight of the depth loss; 0 turns it off.
    pub depth_weight: f32,
    pub depth_mode: DepthMode,
    /// Weight of the symmetric epipolar distance, in px, over the view's matches; 0 turns it off.
    pub epipolar_weight: f32,
    /// Weights of mean opacity and mean scale over the visible splats (3DGS-MCMC regularisers).
    pub opacity_reg: f32,
    pub scale_reg: f32,
    /// Rate of SGLD noise on the means: `lr_mean` times 5e5 in the paper; 0 turns it off.
    pub noise: f32,
    /// Of the noise, with the number of the step and of the splat.
    pub noise_seed: u32,
    /// SH bands above this degree are neither used nor trained.
    pub sh_degree: u8,
    /// Band b of a splat is trained from its `b * sh_interval`-th update on; 0: at once.
    pub sh_interval: u32,
    /// false: the splats are frozen and only the view's pose and exposure move (test-time refinement).
    pub train_splats: bool,
    pub pose: PoseStep,
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

    /// Replaces a view's pose and clears its own optimiser state; the shared network stays as it is.
    fn set_pose(&mut self, view_ix: usize, cam_from_map: Rigid);

    /// Moves the frame that all cameras stand in, not the splats: every `cam_from_map` is given its inverse on the right.
    /// Optimisers go on, since their increments are in the cameras' own axes.
    fn move_cameras(&mut self, new_from_old: &Rigid);

    /// Replaces a view's intrinsics, of the same picture; the factor on all focal lengths stays.
    fn set_intrinsics(&mut self, view_ix: usize, intrinsics: &Intrinsics);

    /// Begins with a fresh network; what the old one did to the poses stays in them.
    fn start_refiner(&mut self, settings: &RefinerSettings);

    /// Replaces a view's picture, and its intrinsics. A mask of another size must have gone before.
    fn set_image(&mut self, view_ix: usize, image: Arc<RgbImage>, intrinsics: &Intrinsics);

    /// Lets go of a view's picture, depth, mask and matches; where it stands stays. No step until it has a picture again.
    fn rest_view(&mut self, _view_ix: usize) {}

    /// Replaces the depth that guides a view's depth loss.
    fn set_depth(&mut self, view_ix: usize, depth: Option<Arc<DepthMap>>);

    /// Replaces the weights of a view's pixels.
    fn set_mask(&mut self, view_ix: usize, mask: Option<Arc<[u8]>>);

    /// Replaces the matches between a view and others.
    fn set_matches(&mut self, view_ix: usize, matches: &[Match]);

    /// Moves dead splats to live ones and adds some, so that the picture stays the same. Returns the count.
    fn relocate_and_grow(&mut self, settings: &McmcSettings) -> usize;

    /// One optimiser update on one view. Reads nothing back; a view that sees no splat changes nothing.
    fn step(&mut self, view_ix: usize, settings: &StepSettings);

    /// Waits for all steps and takes their statistics.
    fn take_stats(&mut self) -> StepStats;

    /// Waits for all steps and reads all refined poses back, by view index.
    fn poses(&mut self) -> Vec<Rigid>;

    /// Waits for all steps and reads the factor on all focal lengths back.
    fn focal_factor(&mut self) -> f64;

    /// Waits for all steps and reads back each view's log gain and offset of r, g, b.
    fn exposures(&mut self) -> Vec<[[f32; 3]; 2]>;

    /// What has broken for good, a lost device for example; from then on steps do nothing.
    fn fault(&self) -> Option<String> {
        None
    }

    /// Most bytes that the buffers on a GPU have held; 0 on the CPU.
    fn peak_gpu_bytes(&self) -> u64;

    /// Bytes that it holds: splats, optimiser state and views; on a GPU those of all buffers there.
    fn held_bytes(&self) -> u64 {
        0
    }

    /// Splats that there may be in all without `held_bytes` passing `max_bytes`, not even while rows are moved.
    fn room_within(&self, _max_bytes: u64) -> usize {
        usize::MAX
    }

    /// Waits for all steps and reads how many updates each splat has had: what admits the bands of its colour.
    fn ages(&mut self) -> Vec<u16> {
        vec![0; self.n_splats()]
    }

    /// Gives splats from `first` on the ages that they had in an earlier run.
    fn set_ages(&mut self, _first: usize, _ages: &[u16]) {}

    /// Waits for all steps and reads the splats back.
    fn splats(&mut self) -> Splats;

    /// Renders at the given SH degree, black background.
    fn render(&mut self, intrinsics: &Intrinsics, cam_from_map: &Rigid, sh_degree: u8)
    -> Rendering;
}

impl StepSettings {
    /// Whether the view's own increment moves.
    pub(crate) fn moves_alone(&self) -> bool {
        let is_on = self.lr_pose_rotation > 0.0 || self.lr_pose_translation > 0.0;
        self.pose != PoseStep::Held && is_on
    }
}

impl TrainingView {
    /// Our own mistake when it fails.
    pub(crate) fn assert_consistent(&self) {
        let (image, intrinsics) = (&self.image, &self.intrinsics);
        let size = (image.width_px, image.height_px);
        assert_eq!(
            size,
            (intrinsics.width_px, intrinsics.height_px),
            "a view's intrinsics are those of its image"
        );
        let n_pixels = size.0 as usize * size.1 as usize;
        assert!(
            image.is_hollow() || image.pixels.len() == 3 * n_pixels,
            "an image is as large as it says, or its pixels are elsewhere"
        );
        let is_fit = self.mask.as_ref().is_none_or(|mask| mask.len() == n_pixels);
        assert!(is_fit, "a mask has one byte for each of {n_pixels} pixels");
    }
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

    /// Appends splat `i` of others of the same SH degree.
    pub fn push(&mut self, others: &Self, i: usize) {
        let stride = self.sh_stride();
        self.means.push(others.means[i]);
        self.log_scales.push(others.log_scales[i]);
        self.quats.push(others.quats[i]);
        self.opacity_logits.push(others.opacity_logits[i]);
        self.anchors.push(others.anchors[i]);
        self.sh
            .extend_from_slice(&others.sh[i * stride..(i + 1) * stride]);
    }

    /// Some of them, in the order of their indices given.
    pub fn picked(&self, ixs: &[usize]) -> Self {
        let mut some = Self {
            sh_degree: self.sh_degree,
            ..Self::default()
        };
        ixs.iter().for_each(|ix| some.push(self, *ix));
        some
    }
}
