//! Seeded random scenes: a camera, an image, a depth map and splats in front of it.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{PoseMode, StepSettings};
use splat_engine::view::TrainingView;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// A splat as it is drawn by lot: in the camera frame, sizes in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Recipe {
    pub width_px: u32,
    pub height_px: u32,
    pub n_splats: usize,
    pub sh_degree: u8,
    /// Standard deviations in pixels of the image, drawn evenly in their logarithm.
    pub size_px: [f64; 2],
    pub opacity_logit: [f32; 2],
    pub depth: [f64; 2],
}

#[derive(Debug, Clone)]
pub struct Scene {
    pub splats: Splats,
    pub view: TrainingView,
}

pub const SMALL: Recipe = Recipe {
    width_px: 18,
    height_px: 14,
    n_splats: 8,
    sh_degree: 3,
    size_px: [1.0, 5.0],
    opacity_logit: [-1.5, 2.5],
    depth: [1.0, 4.0],
};

pub fn rng(seed: u64) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(seed)
}

/// Every term of the loss has a say.
pub fn settings() -> StepSettings {
    StepSettings {
        lr_mean: 2e-3,
        lr_scale: 5e-3,
        lr_quat: 1e-3,
        lr_opacity: 5e-2,
        lr_sh0: 2.5e-3,
        lr_sh_rest: 1.25e-4,
        lr_pose_rotation: 1e-3,
        lr_pose_translation: 2e-3,
        ssim_weight: 0.2,
        weights: LossWeights {
            depth_weight: 0.1,
            ..LossWeights::all(0.01)
        },
        sh_degree: 3,
        train_splats: true,
        pose: PoseMode::Direct,
        ..StepSettings::default()
    }
}

pub fn scene(seed: u64, recipe: &Recipe) -> Scene {
    let mut rng = rng(seed);
    let intrinsics = intrinsics(&mut rng, recipe.width_px, recipe.height_px);
    let cam_from_world = pose(&mut rng);
    let mut splats = Splats {
        sh_degree: recipe.sh_degree,
        ..Splats::default()
    };
    for _ in 0..recipe.n_splats {
        // A little beyond the edges too.
        let pixel = [recipe.width_px, recipe.height_px]
            .map(|side| f64::from(side) * rng.random_range(-0.15..1.15));
        let depth = rng.random_range(recipe.depth[0]..recipe.depth[1]);
        let mean_in_cam = intrinsics.ray_in_cam(pixel.into()) * depth;
        push(
            &mut splats,
            &mut rng,
            cam_from_world.inverse().transform_point(mean_in_cam),
        );
        let last = splats.len() - 1;
        let ln_size = recipe.size_px.map(f64::ln);
        splats.log_scales[last] = [0; 3].map(|_| {
            (rng.random_range(ln_size[0]..=ln_size[1]) + (depth / intrinsics.fx).ln()) as f32
        });
        splats.opacity_logits[last] =
            rng.random_range(recipe.opacity_logit[0]..=recipe.opacity_logit[1]);
    }
    let view = view(&mut rng, intrinsics, cam_from_world, recipe.depth);
    Scene { splats, view }
}

/// A splat of middling size at a place in the map; callers overwrite what they care for.
pub fn push(splats: &mut Splats, rng: &mut Pcg64Mcg, mean_in_world: DVec3) {
    splats.means.push(mean_in_world.as_vec3().to_array());
    splats
        .log_scales
        .push([0; 3].map(|_| rng.random_range(-3.0..-1.0)));
    // Not unit: it is normalised on use.
    let length: f32 = rng.random_range(0.3..3.0);
    splats
        .quats
        .push(rotation(rng).as_quat().to_array().map(|q| q * length));
    splats.opacity_logits.push(rng.random_range(-2.0..3.0));
    splats.anchors.push(0);
    for k in 0..splats.sh_stride() {
        let reach = if k < 3 { 1.5 } else { 0.4 };
        splats.sh.push(rng.random_range(-reach..reach));
    }
}

pub fn pose(rng: &mut Pcg64Mcg) -> Rigid {
    let translation = DVec3::from([0; 3].map(|_| rng.random_range(-2.0..2.0)));
    Rigid::new(rotation(rng), translation)
}

fn rotation(rng: &mut Pcg64Mcg) -> DQuat {
    let axis = DVec3::from([0; 3].map(|_| rng.random_range(-1.0..1.0))).normalize_or(DVec3::X);
    DQuat::from_axis_angle(axis, rng.random_range(0.0..std::f64::consts::TAU))
}

/// Off-centre, with different focal lengths.
pub fn intrinsics(rng: &mut Pcg64Mcg, width_px: u32, height_px: u32) -> Intrinsics {
    let longest = f64::from(width_px.max(height_px));
    Intrinsics {
        width_px,
        height_px,
        fx: longest * rng.random_range(0.7..1.3),
        fy: longest * rng.random_range(0.7..1.3),
        cx: f64::from(width_px) * rng.random_range(0.35..0.65),
        cy: f64::from(height_px) * rng.random_range(0.35..0.65),
    }
}

/// Weights of a third of the pixels are 0, of a third 1, of the rest in between.
pub fn mask(seed: u64, image: &RgbImage) -> Arc<[u8]> {
    let mut rng = rng(seed ^ 0x3a5c);
    let n_pixels = image.pixels.len() / 3;
    let weights = (0..n_pixels).map(|_| match rng.random_range(0..3) {
        0 => 0,
        1 => 255,
        _ => rng.random(),
    });
    weights.collect()
}

/// Random image and a coarser depth map with holes; depths agree with the splats' only by chance.
pub fn view(
    rng: &mut Pcg64Mcg,
    intrinsics: Intrinsics,
    cam_from_world: Rigid,
    depth: [f64; 2],
) -> TrainingView {
    let (width_px, height_px) = (intrinsics.width_px, intrinsics.height_px);
    let pixels = (0..3 * width_px * height_px)
        .map(|_| rng.random())
        .collect();
    let map_size = [width_px, height_px].map(|side| (side * 2).div_ceil(3));
    let n = (map_size[0] * map_size[1]) as usize;
    let mut map = DepthMap {
        width_px: map_size[0],
        height_px: map_size[1],
        depth: vec![0.0; n],
        confidence: vec![0.0; n],
    };
    for pixel in 0..n {
        let is_known = rng.random_bool(0.8);
        map.depth[pixel] = if is_known {
            rng.random_range(depth[0]..depth[1]) as f32
        } else {
            0.0
        };
        map.confidence[pixel] = if rng.random_bool(0.9) {
            rng.random_range(0.1..1.0)
        } else {
            0.0
        };
    }
    TrainingView {
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels,
        }),
        intrinsics,
        cam_from_world,
        depth: Some(Arc::new(map)),
        mask: None,
    }
}
