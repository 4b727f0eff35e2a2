//! Parameters of mapping: `map.*`, `train.*`, `mcmc.*`, `densify.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use splat_engine::loss_weights::LossWeights;

/// All that the map needs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MapperParams {
    pub map: MapParams,
    pub train: TrainParams,
    pub mcmc: McmcParams,
    pub densify: DensifyParams,
    pub held_out: HeldOutParams,
}

/// Parameters `map.*`: budgets of memory and disk, files, snapshots.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MapParams {
    /// Cap on splats in memory. Beyond it those far from the camera are paged out to disk and paged in when it is
    /// near; where all are near, seeding stops.
    #[schemars(range(min = 100, max = 20000000))]
    pub max_splats: usize,
    /// Cap on the memory of the engine (on a GPU all its buffers, else splats, their optimiser and the training
    /// images); 0 = none.
    #[schemars(range(min = 0, max = 1048576), extend("unit" = "MiB"))]
    pub max_gpu_mib: u64,
    /// Images and depth of more keyframes are paged out to disk and trained in turns; at least 8; 0 = no cap.
    #[schemars(range(min = 0, max = 1000000))]
    pub max_resident_keyframes: usize,
    /// Cap on the page file, which has no name and lies in the run directory.
    #[schemars(range(min = 0, max = 16777216), extend("unit" = "MiB"))]
    pub max_page_file_mib: u64,
    /// .splatmap of an earlier run to resume, as --resume; empty = start a new map.
    pub resume: String,
    /// Images of keyframes in the map file, some 50 KiB each, so that a later run can train on them; subsampled
    /// evenly where all would be more; 0 = none.
    #[schemars(range(min = 0, max = 1048576), extend("unit" = "MiB"))]
    pub save_images_mib: u64,
    /// Time between writes of the run directory's map.splatmap during a run; 0 = only at its end.
    #[schemars(range(min = 0.0, max = 86400.0), extend("unit" = "s"))]
    pub autosave_secs: f64,
    /// Every n-th keyframe is kept out of optimisation to measure quality; 0 = off.
    #[schemars(range(min = 0, max = 1000))]
    pub holdout: u32,
    /// Wall time between snapshots for publishers.
    #[schemars(range(min = 0.05, max = 3600.0), extend("unit" = "s"))]
    pub snapshot_secs: f64,
    /// Live: how long the map gets better after the last frame before it is saved; another stop cuts it short.
    #[schemars(range(min = 0.0, max = 3600.0), extend("unit" = "s"))]
    pub finish_secs: f64,
}

impl Default for MapParams {
    fn default() -> Self {
        Self {
            max_splats: 120_000,
            max_gpu_mib: 0,
            max_resident_keyframes: 400,
            max_page_file_mib: 8192,
            resume: String::new(),
            save_images_mib: 64,
            autosave_secs: 0.0,
            holdout: 8,
            snapshot_secs: 0.5,
            finish_secs: 0.0,
        }
    }
}

/// Parameters `train.*`: steps, losses and learning rates of the optimisation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrainParams {
    /// Optimiser updates of the whole run, spread over the batches and the end.
    #[schemars(range(min = 0, max = 10000000))]
    pub steps: u64,
    /// Longer side of the image that splats are trained on.
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub max_side: u32,
    /// Share of the steps that are made after the last keyframe.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub final_share: f64,
    /// What the first splats are made from: depth = the depth of each keyframe; points = the scene's sparse points (points3D of a
    /// COLMAP model, ply_file_path of a transforms.json), with geometry ground_truth, and no splat from depth.
    pub start: Start,
    /// Scale of a splat that starts from a point, as a multiple of the distance to its three nearest neighbours; 1 in 3DGS,
    /// 0.1 in 3DGS-MCMC.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub start_scale: f32,
    /// Splats that a keyframe may add where the map has none yet.
    #[schemars(range(min = 1, max = 1000000))]
    pub seeds_per_keyframe: usize,
    /// Highest band of view-dependent colour.
    #[schemars(range(min = 0, max = 3))]
    pub sh_degree: u8,
    /// Share of 1 - SSIM in the photometric loss.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub ssim_weight: f32,
    /// Order of the views in a round through all of them: spread, so that steps that follow each other see different places; or shuffled.
    pub view_order: ViewOrder,
    /// What SSIM takes for the pixels beyond the edges: black; or only windows inside the image are averaged (gsplat).
    pub ssim_padding: SsimPadding,
    /// Weight of the photometric loss; 0.95 in the code of FastSplatting.
    #[schemars(range(min = 0.01, max = 100.0))]
    pub photo_weight: f32,
    /// Weights of the further terms of the loss, each under its own name: `train.depth_weight` and what else the engine declares.
    #[serde(flatten)]
    pub weights: LossWeights,
    /// What the depth loss compares: inverse depth; as the code of FastSplatting; as its paper.
    pub depth_mode: DepthLoss,
    /// Weight of the depth loss at the last step, as a share of that at the first; 1 = constant.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub final_depth_weight: f32,
    /// What rates of means and translations, mcmc.scale_reg and train.near are shares of: the median depth of the views; or the
    /// largest distance of a camera to the mean of all (3DGS).
    pub scene_scale: SceneScale,
    /// Splats nearer than this share of the scene scale to a camera are neither drawn nor trained; 0 = 0.01 map units.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub near: f32,
    /// Steps between looks at a view for holes and errors to seed; 0 = only new keyframes bring splats.
    #[schemars(range(min = 0, max = 1000000))]
    pub reseed_every: u64,
    /// Share of the steps after the last keyframe behind which splats are neither added, moved nor removed; 1 = to the end.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub refine_until: f32,
    /// Size, opacity and rotation of splats seeded from depth: by their spacing in the image; or as gsplat starts 3DGS-MCMC, by the
    /// distance to their three nearest neighbours in the map.
    pub seed_shape: SeedShape,
    /// Weight of the epipolar distance in px over the correspondences of a view (3R-GS); 0 = off.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub epipolar_weight: f32,
    /// Weights of the correspondences: all equal; or adaptive, by how many of all are about as far off as each, none beyond 20 px of an
    /// image of 518 (VGGT-X, 3R-GS).
    pub epipolar_weighting: EpipolarWeighting,
    /// Steps of the run after which the epipolar loss ends; 0 = never.
    #[schemars(range(min = 0, max = 10000000))]
    pub epipolar_until: u64,
    /// Share of an image's pixels that surely are static; worse ones in clusters lose their weight (RobustNeRF);
    /// 1 = off.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub robust_inlier_fraction: f32,
    /// Adam rate, share of the scene scale; decays to a hundredth over the run.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_mean: f32,
    /// Updates of a splat after which lr_mean is half for it while keyframes may still come; it falls on, to a hundredth at least;
    /// 0 = it does not fall.
    #[schemars(range(min = 0, max = 1000000))]
    pub half_mean_updates: u32,
    /// Adam rate of log-scales.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_scale: f32,
    /// Adam rate of quaternions.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_quat: f32,
    /// Adam rate of opacity logits.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_opacity: f32,
    /// Adam rate of the base colour.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_sh: f32,
    /// Rate of the colour bands above the base, as a share of train.lr_sh; a twentieth in 3DGS.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub sh_rest_rate: f32,
    /// Steps on a view after which a step on it trains splats at half of these rates; they fall on, to a tenth at least; 0 = they
    /// do not fall.
    #[schemars(range(min = 0, max = 1000000))]
    pub half_rate_steps: u32,
    /// Rates of scales, quaternions, opacity and colour at the last step, as a share of those at the first.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub final_rate: f32,
    /// Updates of a splat before each further band of its colour is trained; 0 = all from the first.
    #[schemars(range(min = 0, max = 1000000))]
    pub sh_interval: u32,
    /// What train.sh_interval counts: updates of a splat; or steps of the whole run (3DGS).
    pub sh_interval_of: ShInterval,
    /// Pose optimisation: per view, by a shared MLP (3R-GS) and per view, or none.
    pub pose_opt: PoseOptimization,
    /// Adam rate of a view's own rotation, pose_opt per_view and network; decays to 3 % over the run; 0 fixes it.
    #[schemars(range(min = 0.0, max = 1.0), extend("unit" = "rad"))]
    pub lr_rotation: f32,
    /// Adam rate of a view's own translation, share of the scene scale; decays the same way; 0 fixes it.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_translation: f32,
    /// Adam rate of the network and of its embedding of each view, pose_opt network.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_pose_network: f32,
    /// Rates of poses and of the focal length at the last step, as a share of those at the first; 1 = constant.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub final_pose_rate: f32,
    /// What the network knows of a view at first: its place in the order of arrival; or nothing (3R-GS).
    pub pose_embedding: PoseEmbedding,
    /// Adam rate of the logarithm of one factor on all focal lengths; 0 fixes it.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_focal: f32,
    /// Adam rate of each view's gain and offset of r, g, b; 0 = none.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_exposure: f32,
    /// Adam rate of the network that gives the views' gains and offsets together, from an embedding per view; 0 = none.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr_appearance: f32,
}

impl Default for TrainParams {
    fn default() -> Self {
        Self {
            steps: 3000,
            max_side: 480,
            final_share: 0.5,
            start: Start::Depth,
            start_scale: 1.0,
            seeds_per_keyframe: 5000,
            sh_degree: 3,
            ssim_weight: 0.2,
            view_order: ViewOrder::Spread,
            ssim_padding: SsimPadding::Zero,
            photo_weight: 1.0,
            weights: LossWeights {
                depth_weight: 0.1,
                ..LossWeights::default()
            },
            depth_mode: DepthLoss::InvDepth,
            final_depth_weight: 0.1,
            scene_scale: SceneScale::MedianDepth,
            near: 0.0,
            reseed_every: 50,
            refine_until: 0.6,
            seed_shape: SeedShape::Spacing,
            epipolar_weight: 0.0,
            epipolar_weighting: EpipolarWeighting::Adaptive,
            epipolar_until: 3000,
            robust_inlier_fraction: 1.0,
            lr_mean: 0.0012,
            half_mean_updates: 30,
            lr_scale: 0.05,
            lr_quat: 0.006,
            lr_opacity: 0.1,
            lr_sh: 0.02,
            sh_rest_rate: 0.15,
            half_rate_steps: 30,
            final_rate: 0.2,
            sh_interval: 0,
            sh_interval_of: ShInterval::Updates,
            pose_opt: PoseOptimization::PerView,
            lr_rotation: 0.0005,
            lr_translation: 0.0005,
            lr_pose_network: 0.001,
            final_pose_rate: 0.03,
            pose_embedding: PoseEmbedding::Order,
            lr_focal: 0.0,
            lr_exposure: 0.0,
            lr_appearance: 0.0,
        }
    }
}

/// Parameters `mcmc.*`: relocation, growth and regularisation of 3DGS-MCMC.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct McmcParams {
    /// Dead splats are relocated to live ones instead of removed, and some are added (3DGS-MCMC).
    pub enabled: bool,
    /// Steps between relocations.
    #[schemars(range(min = 1, max = 1000000))]
    pub every: u64,
    /// Step of the first relocation.
    #[schemars(range(min = 0, max = 10000000))]
    pub start: u64,
    /// Noise, regularisers, Adam's moments and moves take in all splats, and not only those that views see (3DGS-MCMC); with
    /// mcmc.enabled.
    pub all_splats: bool,
    /// Splats after a relocation as a multiple of those before, up to map.max_splats.
    #[schemars(range(min = 1.0, max = 2.0))]
    pub growth: f32,
    /// What splats at one position preserve of the splat that they replace: the sums of its alpha and alpha
    /// squared over the image; the opacity along a ray through its centre, as in the paper of 3DGS-MCMC.
    pub relocation: RelocationRule,
    /// SGLD noise on the means, multiple of train.lr_mean, with mcmc.enabled; 0 = none.
    #[schemars(range(min = 0.0, max = 1e9))]
    pub noise: f32,
    /// Weight of the mean opacity, with mcmc.enabled.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub opacity_reg: f32,
    /// Weight of the mean scale as a share of the scene scale, with mcmc.enabled.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub scale_reg: f32,
    /// Splats below it are dead: removed with each batch and at intervals, or relocated with mcmc.enabled.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_opacity: f32,
}

impl Default for McmcParams {
    fn default() -> Self {
        Self {
            enabled: false,
            every: 100,
            start: 500,
            all_splats: false,
            growth: 1.05,
            relocation: RelocationRule::Image,
            noise: 67000.0,
            opacity_reg: 0.01,
            scale_reg: 0.01,
            min_opacity: 0.02,
        }
    }
}

/// Parameters `densify.*`: growth by a threshold on gradients (3D Gaussian Splatting).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DensifyParams {
    /// Splats with large screen gradients are cloned or split, faint and too large ones removed, opacities reset (3DGS);
    /// without mcmc.enabled.
    pub enabled: bool,
    /// Step after which the first splats are cloned and split.
    #[schemars(range(min = 0, max = 10000000))]
    pub start: u64,
    /// Step from which on none are, nor opacities reset; at 60 % of the steps after the last keyframe at the latest.
    #[schemars(range(min = 0, max = 10000000))]
    pub until: u64,
    /// Steps between passes.
    #[schemars(range(min = 1, max = 1000000))]
    pub every: u64,
    /// Mean norm of the loss's gradient by the projected mean, in normalised device coordinates, from which on a splat is
    /// cloned or split.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub gradient: f32,
    /// Splats up to this largest scale are cloned, larger ones split; share of the radius of the cameras.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub dense_share: f32,
    /// Splats above this largest scale are removed once opacities were reset; share of the radius of the cameras; 0 = none.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub max_share: f32,
    /// Steps between resets of all opacities to twice min_opacity at most; 0 = none.
    #[schemars(range(min = 0, max = 10000000))]
    pub opacity_reset_every: u64,
    /// Splats below it are removed in each pass.
    #[schemars(range(min = 0.0, max = 0.25))]
    pub min_opacity: f32,
}

impl Default for DensifyParams {
    fn default() -> Self {
        Self {
            enabled: false,
            start: 500,
            until: 15_000,
            every: 100,
            gradient: 0.0002,
            dense_share: 0.01,
            max_share: 0.1,
            opacity_reset_every: 3000,
            min_opacity: 0.005,
        }
    }
}

/// What the first splats are made from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// The depth of each keyframe.
    Depth,
    /// The sparse points of the scene.
    Points,
}

/// How keyframe poses are optimised with the splats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PoseOptimization {
    /// Each view by itself.
    PerView,
    /// By an MLP that all views share (3R-GS), and per view.
    Network,
    /// Not at all.
    Fixed,
}

/// What the depth loss compares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DepthLoss {
    /// Inverse depth.
    InvDepth,
    /// As the code of FastSplatting.
    PaperCode,
    /// As its paper.
    PaperAlpha,
}

/// What splats at one position preserve of the splat that they replace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RelocationRule {
    /// The sums of its alpha and alpha squared over the image.
    Image,
    /// The opacity along a ray through its centre (3DGS-MCMC).
    Paper,
}

/// Order of the views in a round of steps through all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ViewOrder {
    /// Steps that follow each other are on views that are far apart in the order of arrival.
    Spread,
    /// Random.
    Shuffled,
}

/// What SSIM takes for the pixels beyond the edges of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SsimPadding {
    /// Black.
    Zero,
    /// Nothing: only windows that lie in the image are averaged (gsplat).
    Valid,
}

/// Weights of the matches of the epipolar loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EpipolarWeighting {
    /// By how many of all matches are about as far off (VGGT-X, 3R-GS).
    Adaptive,
    /// The same for all.
    Equal,
}

/// The length that rates are shares of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SceneScale {
    /// Median depth of the views.
    MedianDepth,
    /// Largest distance of a camera to the mean of all (3DGS).
    Cameras,
}

/// Size, opacity and rotation of seeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SeedShape {
    /// As wide as their spacing in the image.
    Spacing,
    /// A tenth of the distance to the three nearest neighbours, opacity 0.5, turned at random (gsplat for 3DGS-MCMC).
    Neighbours,
}

/// What admits bands of colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ShInterval {
    /// Updates of each splat.
    Updates,
    /// Steps of the run.
    Steps,
}

/// What the pose network knows of a view at first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PoseEmbedding {
    /// Its place in the order of arrival.
    Order,
    /// Nothing (3R-GS).
    Zero,
}

/// Parameters `eval.*` of the poses of held-out views: each is moved alone, with the splats frozen, to where its image fits best.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct HeldOutParams {
    /// Steps on the pose of each held-out view; 3R-GS makes 100, half of them end within 0.03 dB. 0 = poses stay as geometry gave them.
    #[schemars(range(min = 0, max = 10000))]
    pub pose_steps: u32,
    /// Adam rate of the first of these steps, in radians and shares of the scene scale; falls to a hundredth. 3R-GS: 0.0008.
    #[schemars(range(min = 0.0, max = 0.1))]
    pub pose_rate: f32,
    /// What these steps make small: the photometric loss of training; or L1 where the image has strong gradients (3R-GS).
    pub pose_loss: HeldOutLoss,
}

impl Default for HeldOutParams {
    fn default() -> Self {
        Self {
            pose_steps: 50,
            pose_rate: 3e-3,
            pose_loss: HeldOutLoss::Photometric,
        }
    }
}

/// What the poses of held-out views are fitted by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum HeldOutLoss {
    /// The loss of training.
    Photometric,
    /// L1 where the image has strong gradients.
    MaskedL1,
}
