//! Plain f64 reference implementation of each splat stage: the oracle of every backend. Written to be read beside docs/GRADIENTS.md,
//! not to be fast; shares no arithmetic with `src/splat`. One file one stage, named like the stage.

pub mod adam;
pub mod bin;
pub mod densify;
pub mod differences;
pub mod doubt;
pub mod hostile;
pub mod loss;
pub mod loss_depth;
pub mod paper_run;
pub mod pose_network;
pub mod project;
pub mod project_backward;
pub mod random;
pub mod raster;
pub mod raster_backward;

use std::sync::Arc;

use loss::Loss;
use nalgebra::{Matrix3, Vector3};
use raster::Raster;

use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{DepthMode, StepSettings};
use splat_engine::view::TrainingView;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Splat parameters before activation, or a gradient with respect to them. Same layout as `Splats`.
#[derive(Debug, Clone, PartialEq)]
pub struct Params {
    pub means: Vec<[f64; 3]>,
    pub log_scales: Vec<[f64; 3]>,
    /// w, x, y, z.
    pub quats: Vec<[f64; 4]>,
    pub opacity_logits: Vec<f64>,
    pub sh: Vec<f64>,
    pub sh_degree: u8,
}

#[derive(Debug, Clone, Copy)]
pub struct Camera {
    pub intrinsics: Intrinsics,
    /// Rotation and translation of `cam_from_world`.
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

/// What a rendering is compared with.
#[derive(Debug, Clone)]
pub struct Target {
    /// 0 to 1, r g b per pixel.
    pub rgb: Vec<f64>,
    /// (depth, confidence) per image pixel; 0 where there is no depth, or the pixel does not count, and where nothing verified it.
    pub depth: Vec<(f64, f64)>,
    /// How much each pixel counts, 0 to 1.
    pub weights: Vec<f64>,
    /// Log gain and offset of r, g, b, under which the rendering is compared.
    pub exposure: [[f64; 3]; 2],
}

/// Weight of each term, so that tests can look at one alone.
#[derive(Debug, Clone, Copy, Default)]
pub struct Weights {
    pub l1: f64,
    pub ssim: f64,
    pub depth_mode: DepthMode,
    /// SSIM over the pixels whose whole window lies in the image.
    pub ssim_valid: bool,
    /// Regularisers are means over all splats, seen or not.
    pub all_splats: bool,
    /// Of the terms beside the photometric loss.
    pub terms: LossWeights,
}

#[derive(Debug, Clone)]
pub struct Gradients {
    pub splats: Params,
    /// With respect to the left-multiplied increment `exp([rho; theta])`: rho, then theta.
    pub pose: [f64; 6],
    /// Log gain and offset of r, g, b.
    pub exposure: [[f64; 3]; 2],
    /// With respect to s, where exp(s) multiplies both focal lengths.
    pub log_focal: f64,
    pub loss: Loss,
    pub raster: Raster,
    /// Splats that are drawn; only these get regularised and updated.
    pub visible: Vec<usize>,
}

impl Params {
    pub fn zeros_like(other: &Self) -> Self {
        let n = other.means.len();
        Self {
            means: vec![[0.0; 3]; n],
            log_scales: vec![[0.0; 3]; n],
            quats: vec![[0.0; 4]; n],
            opacity_logits: vec![0.0; n],
            sh: vec![0.0; other.sh.len()],
            sh_degree: other.sh_degree,
        }
    }

    /// One more splat, of zeros.
    pub fn push_zeros(&mut self) {
        self.means.push([0.0; 3]);
        self.log_scales.push([0.0; 3]);
        self.quats.push([0.0; 4]);
        self.opacity_logits.push(0.0);
        self.sh.extend(vec![0.0; self.sh_stride()]);
    }

    pub fn sh_stride(&self) -> usize {
        3 * (usize::from(self.sh_degree) + 1).pow(2)
    }
}

impl From<&Splats> for Params {
    fn from(splats: &Splats) -> Self {
        Self {
            means: splats.means.iter().map(|v| v.map(f64::from)).collect(),
            log_scales: splats.log_scales.iter().map(|v| v.map(f64::from)).collect(),
            quats: splats.quats.iter().map(|v| v.map(f64::from)).collect(),
            opacity_logits: splats
                .opacity_logits
                .iter()
                .copied()
                .map(f64::from)
                .collect(),
            sh: splats.sh.iter().copied().map(f64::from).collect(),
            sh_degree: splats.sh_degree,
        }
    }
}

impl Camera {
    pub fn new(intrinsics: &Intrinsics, cam_from_world: &Rigid) -> Self {
        let columns = cam_from_world.rotation_matrix().to_cols_array();
        Self {
            intrinsics: *intrinsics,
            rotation: Matrix3::from_column_slice(&columns),
            translation: Vector3::from(cam_from_world.translation.to_array()),
        }
    }
}

impl Target {
    pub fn new(view: &TrainingView) -> Self {
        let (width_px, height_px) = (view.image.width_px as usize, view.image.height_px as usize);
        let rgb = view
            .image
            .pixels
            .iter()
            .map(|&value| f64::from(value) / 255.0)
            .collect();
        let weights: Vec<f64> = match &view.mask {
            Some(mask) => mask.iter().map(|&byte| f64::from(byte) / 255.0).collect(),
            None => vec![1.0; width_px * height_px],
        };
        let depth = (0..width_px * height_px)
            .map(|pixel| {
                let (depth, confidence) = sample_depth(
                    view.depth.as_ref(),
                    pixel % width_px,
                    pixel / width_px,
                    [width_px, height_px],
                );
                let counts = weights[pixel] > 0.0;
                let depth = if counts { depth } else { 0.0 };
                (depth, weights[pixel] * confidence)
            })
            .collect();
        Self {
            rgb,
            depth,
            weights,
            exposure: [[0.0; 3]; 2],
        }
    }
}

/// Nearest neighbour: the pixel of the depth map that the centre of the image's pixel falls into.
fn sample_depth(map: Option<&Arc<DepthMap>>, x: usize, y: usize, size: [usize; 2]) -> (f64, f64) {
    let Some(map) = map else { return (0.0, 0.0) };
    let nearest = |pixel: usize, n_image: usize, n_map: u32| {
        let scaled = (pixel as f64 + 0.5) * f64::from(n_map) / n_image as f64;
        (scaled.floor() as usize).min(n_map as usize - 1)
    };
    let ix = nearest(y, size[1], map.height_px) * map.width_px as usize
        + nearest(x, size[0], map.width_px);
    let (depth, confidence) = (f64::from(map.depth[ix]), f64::from(map.confidence[ix]));
    // NaN fails both comparisons.
    if !(depth > 0.0 && depth.is_finite()) {
        (0.0, 0.0)
    } else if confidence > 0.0 {
        (depth, confidence)
    } else {
        (depth, 0.0)
    }
}

impl Weights {
    pub fn new(settings: &StepSettings) -> Self {
        let ssim = f64::from(settings.ssim_weight);
        Self {
            l1: 1.0 - ssim,
            ssim,
            depth_mode: settings.depth_mode,
            ssim_valid: settings.ssim_valid,
            all_splats: settings.all_splats,
            terms: settings.weights,
        }
    }
}

pub fn render(params: &Params, camera: &Camera, sh_degree: u8) -> Raster {
    let projected = project::project(params, camera, sh_degree);
    let order = bin::order(&projected);
    let size = [
        camera.intrinsics.width_px as usize,
        camera.intrinsics.height_px as usize,
    ];
    raster::raster(&projected, &order, size)
}

/// Forward and backward through every stage.
pub fn gradients(
    params: &Params,
    camera: &Camera,
    target: &Target,
    weights: &Weights,
    sh_degree: u8,
) -> Gradients {
    let projected = project::project(params, camera, sh_degree);
    let order = bin::order(&projected);
    let size = [
        camera.intrinsics.width_px as usize,
        camera.intrinsics.height_px as usize,
    ];
    let raster = raster::raster(&projected, &order, size);
    let visible: Vec<usize> = projected.iter().map(|splat| splat.splat_ix).collect();
    let mut loss = loss::loss(&raster, target, weights);

    let on_projected = raster_backward::raster_backward(&projected, &raster, &loss);
    let (mut splats, pose, log_focal) =
        project_backward::project_backward(params, camera, &projected, &on_projected, sh_degree);
    let all: Vec<usize> = (0..params.means.len()).collect();
    let regularised = if weights.all_splats { &all } else { &visible };
    loss.total += loss::regularise(params, regularised, weights, &mut splats);
    Gradients {
        splats,
        pose,
        exposure: loss.v_exposure,
        log_focal,
        loss,
        raster,
        visible,
    }
}
