//! Numbers of one optimiser step and of one relocation; what steps report back.

use crate::loss_weights::LossWeights;
use crate::mcmc;

/// What the depth loss compares. Equations: docs/GRADIENTS.md, losses.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DepthMode {
    /// Relative error of inverse expected depth, Huber, weighted by confidence.
    #[default]
    InverseDepth,
    /// Expected depth and inverted inverse depth, each stretched to 0..1 over the image (FastSplatting, code).
    PaperCode,
    /// Alpha and depth, each stretched to 0..1 over the image (FastSplatting, text).
    PaperAlpha,
}

/// How a step may move the view's pose. `docs/GRADIENTS.md`, section 8.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PoseMode {
    /// Not at all.
    #[default]
    Held,
    /// The view's own increment of six numbers.
    Direct,
    /// The network that all views share (3R-GS, arXiv 2504.04294), and what it leaves by the view's own increment.
    Shared,
}

/// What the pose network knows of a view before anything was learnt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum FirstEmbedding {
    /// Its place in the order of arrival, as waves: neighbours along the way move alike, as drift does.
    #[default]
    Order,
    /// Nothing, as in 3R-GS: zeros. All cameras move alike until steps part them.
    Zero,
}

/// The network that moves all poses together; see `pose_network`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseNetworkSettings {
    /// Of the first values of its hidden layers.
    pub seed: u64,
    /// What the embeddings of the views are at first.
    pub embedding: FirstEmbedding,
    /// World units that an output of 1 moves a camera by: RMS distance of the cameras to their mean.
    pub camera_scale: f32,
}

/// One pass of MCMC relocation and growth (Kheradmand et al., NeurIPS 2024). `docs/GRADIENTS.md`, section 10.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct McmcSettings {
    /// Splats of at most this opacity, 0 to 1, are dead and move to live ones.
    pub min_opacity: f32,
    /// What a source and its copies keep of the source.
    pub copies: mcmc::Relocation,
    /// Splats that there may be in all.
    pub max_splats: usize,
    /// Count after growth as a multiple of the count before, 1.05 in the paper; 1: none are added.
    pub growth: f32,
    /// Only splats that one of the last so many steps has seen take part; 0: all.
    pub active_steps: u32,
    /// Moved splats and their sources are bias-corrected by all steps so far, as where a whole attribute has one counter (gsplat);
    /// else by those since their moments were cleared.
    pub keeps_age: bool,
    /// Different in every pass.
    pub seed: u32,
}

/// Numbers of one step; the caller's schedule sets them. The default changes nothing. Rates are Adam's: about how far a number
/// moves in one step. `docs/GRADIENTS.md`, sections 5 and 9. Many fields: a rate for each kind of number that is trained.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepSettings {
    /// Of the means, world units; 1.6e-4 times the scene's extent in 3DGS, decaying to a hundredth.
    pub lr_mean: f32,
    /// Fall of `lr_mean` with the updates n that a splat has had, this one included: `lr_mean / (1 + lr_mean_decay n)`, a hundredth
    /// at least; 0: none.
    pub lr_mean_decay: f32,
    /// Of the log-scales; 5e-3 in 3DGS.
    pub lr_scale: f32,
    /// Of the quaternions as stored; 1e-3 in 3DGS.
    pub lr_quat: f32,
    /// Of the opacity logits; 5e-2 in 3DGS.
    pub lr_opacity: f32,
    /// Of the SH coefficients of degree 0; 2.5e-3 in 3DGS.
    pub lr_sh0: f32,
    /// Of the SH coefficients above degree 0; 1.25e-4 in 3DGS.
    pub lr_sh_rest: f32,
    /// Adam rate of the pose delta: radians for rotation.
    pub lr_pose_rotation: f32,
    /// Adam rate of the pose delta: world units for translation.
    pub lr_pose_translation: f32,
    /// Share of 1 - SSIM in the photometric loss, 0 to 1; the rest is L1. 0.2 in 3DGS.
    pub ssim_weight: f32,
    /// SSIM is averaged over the pixels whose whole window lies in the image ("valid" padding, as in FastSplatting and gsplat); else
    /// over all, with black beyond the edges.
    pub ssim_valid: bool,
    /// Adam's moments, regularisers and noise move all splats, as in 3DGS-MCMC, and not only those that the view sees. The
    /// regularisers are means over all then.
    pub all_splats: bool,
    /// Adam rate of the shared network and of the views' embeddings.
    pub lr_pose_network: f32,
    /// Adam rate of the logarithm of the factor on all focal lengths; 0 holds it.
    pub lr_focal: f32,
    /// Adam rate of the view's gain and offset per channel; 0 holds them.
    pub lr_exposure: f32,
    /// Adam rate of the network that all views' gains and offsets share, see `appearance`; 0 holds it.
    pub lr_appearance: f32,
    /// Of the terms beside the photometric loss.
    pub weights: LossWeights,
    /// What the depth loss compares.
    pub depth_mode: DepthMode,
    /// Weight of the symmetric epipolar distance, in px, over the view's correspondences; 0 turns it off. Moves the pose alone.
    pub epipolar_weight: f32,
    /// Rate of SGLD noise on the means: `lr_mean` times 5e5 in the paper; 0 turns it off.
    pub noise: f32,
    /// Of the noise, with the number of the step and of the splat.
    pub noise_seed: u32,
    /// SH bands above this degree are neither used nor trained.
    pub sh_degree: u8,
    /// Band b of a splat is trained from its `b * sh_interval`-th update on; 0: at once.
    pub sh_interval: u32,
    /// Each splat that the step sees and moves adds up its screen gradient, for densification.
    pub accumulate_screen_gradients: bool,
    /// false: the splats are frozen and only the view's pose and exposure move (test-time refinement).
    pub train_splats: bool,
    /// How the view's pose may move.
    pub pose: PoseMode,
}

/// Means over the steps since it was last taken; zeros if there were none.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepStats {
    /// Steps that the means are of.
    pub n_steps: u64,
    /// Photometric, depth and regularisers, weighted.
    pub loss: f64,
    /// Mean absolute difference of the colours, 0 to 1.
    pub l1: f64,
    /// Mean SSIM, 1 is best.
    pub ssim: f64,
}

/// Bytes that an engine holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Memory {
    /// Splats, optimiser state and views; on a GPU all buffers there.
    pub held_bytes: u64,
    /// Most that the buffers on a GPU have held; 0 on the CPU.
    pub peak_gpu_bytes: u64,
}

impl StepSettings {
    /// Whether the view's own increment moves.
    pub(crate) fn moves_alone(&self) -> bool {
        let is_on = self.lr_pose_rotation > 0.0 || self.lr_pose_translation > 0.0;
        self.pose != PoseMode::Held && is_on
    }
}
