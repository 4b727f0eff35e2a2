//! Random splats before a camera, photos and depth of noise: for `gpu_bench` and the benchmarks of `benches/`.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{PoseMode, StepSettings};
use splat_engine::view::TrainingView;
use splat_geometry::mvs::view::MvsView;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Focal length over the shorter side of the image.
const FOCAL_SHARE: f64 = 350.0 / 270.0;

/// `n` splats over the whole image, of `size_px` each in the middle.
pub(crate) fn scene(
    n: usize,
    size_px: f64,
    [width_px, height_px]: [u32; 2],
) -> (Splats, TrainingView) {
    let mut rng = Pcg32::seed_from_u64(7);
    let (width, height) = (f64::from(width_px), f64::from(height_px));
    let focal = FOCAL_SHARE * width.min(height);
    let mut splats = Splats {
        sh_degree: 3,
        ..Splats::default()
    };
    for _ in 0..n {
        let z = rng.random_range(0.5..3.0);
        let x = (rng.random_range(-5.0..width + 5.0) - 0.5 * width) * z / focal;
        let y = (rng.random_range(-5.0..height + 5.0) - 0.5 * height) * z / focal;
        splats.means.push([x as f32, y as f32, z as f32]);
        let size = (size_px * z / focal).ln();
        let scales = std::array::from_fn(|_| (size + rng.random_range(-1.2..0.7)) as f32);
        splats.log_scales.push(scales);
        let quat = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        splats.quats.push(quat);
        splats.opacity_logits.push(rng.random_range(-3.0..2.0));
        let sh = (0..48).map(|k| rng.random_range(-1.0..1.0) / (1.0 + k as f32 / 3.0));
        splats.sh.extend(sh);
        splats.anchors.push(0);
    }
    let n_pixels = width_px as usize * height_px as usize;
    let view = TrainingView {
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels: (0..3 * n_pixels).map(|_| rng.random()).collect(),
        }),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx: focal,
            fy: focal,
            cx: 0.5 * width,
            cy: 0.5 * height,
        },
        cam_from_world: Rigid::new(DQuat::IDENTITY, DVec3::ZERO),
        depth: Some(Arc::new(DepthMap {
            width_px,
            height_px,
            depth: (0..n_pixels).map(|_| rng.random_range(0.5..3.0)).collect(),
            confidence: vec![1.0; n_pixels],
        })),
        mask: None,
    };
    (splats, view)
}

/// All that a step of the joint optimisation does.
pub(crate) fn settings() -> StepSettings {
    StepSettings {
        lr_mean: 1.6e-6,
        lr_scale: 5e-5,
        lr_quat: 1e-5,
        lr_opacity: 5e-4,
        lr_sh0: 2.5e-5,
        lr_sh_rest: 1e-6,
        lr_pose_rotation: 1e-7,
        lr_pose_translation: 1e-7,
        ssim_weight: 0.2,
        weights: LossWeights {
            depth_weight: 0.05,
            ..LossWeights::all(0.01)
        },
        sh_degree: 3,
        train_splats: true,
        pose: PoseMode::Direct,
        ..StepSettings::default()
    }
}

/// Of noise: matching takes as long whatever there is to see.
pub(crate) fn mvs_view([width_px, height_px]: [u32; 2], x: f64) -> MvsView {
    let mut rng = Pcg32::seed_from_u64(3);
    let pixels = (0..3 * width_px * height_px).map(|_| rng.random());
    MvsView {
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels: pixels.collect(),
        }),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx: f64::from(width_px),
            fy: f64::from(width_px),
            cx: 0.5 * f64::from(width_px),
            cy: 0.5 * f64::from(height_px),
        },
        submap_from_cam: Rigid::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0)),
    }
}
