//! Bytes that a map takes on the GPU, against the formula of docs/GRADIENTS.md, section 11.

use std::sync::Arc;

use rand::RngExt;

use crate::gpu::{fast_engine, gpu_engine};
use crate::reference::random::{rng, settings};
use splat_engine::traits::{Device as _, SplatBuffers as _, Trainer as _, ViewStore as _};
use splat_engine::view::TrainingView;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

const WIDTH_PX: u32 = 200;
const HEIGHT_PX: u32 = 160;
const FOCAL_PX: f32 = 180.0;
/// The formula's last terms are rounded; the bar is 10 %.
const BAR: f64 = 0.1;
/// Instances that there is room for, per splat, where a splat needs fewer.
const INSTANCES: usize = 4;

/// Small enough to lie in one to four tiles.
fn speck_cloud(n: usize, degree: u8) -> Splats {
    let mut rng = rng(31);
    let mut splats = Splats {
        sh_degree: degree,
        ..Splats::default()
    };
    for _ in 0..n {
        let z = rng.random_range(1.0_f32..3.0);
        let mut across = |size: u32| rng.random_range(-0.5..0.5) * size as f32 * z / FOCAL_PX;
        let mean = [across(WIDTH_PX), across(HEIGHT_PX), z];
        splats.means.push(mean);
        splats.log_scales.push([(0.7 * z / FOCAL_PX).ln(); 3]);
        splats.quats.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacity_logits.push(0.0);
        splats.anchors.push(0);
    }
    splats.sh = vec![0.1; n * splats.sh_stride()];
    splats
}

fn view() -> TrainingView {
    let n_pixels = (WIDTH_PX * HEIGHT_PX) as usize;
    TrainingView {
        image: Arc::new(RgbImage {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            pixels: vec![100; 3 * n_pixels],
        }),
        intrinsics: Intrinsics {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            fx: f64::from(FOCAL_PX),
            fy: f64::from(FOCAL_PX),
            cx: 0.5 * f64::from(WIDTH_PX),
            cy: 0.5 * f64::from(HEIGHT_PX),
        },
        cam_from_world: Rigid::IDENTITY,
        depth: Some(Arc::new(DepthMap {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            depth: vec![2.0; n_pixels],
            confidence: vec![1.0; n_pixels],
        })),
        mask: None,
    }
}

fn formula(n: usize, degree: usize, bytes_of_instance: usize) -> usize {
    let rest = 3 * ((degree + 1).pow(2) - 1);
    let of_splat = 196 + 4 * (rest + rest.div_ceil(2) + degree) + 138;
    let n_pixels = (WIDTH_PX * HEIGHT_PX) as usize;
    let of_view = 4 * n_pixels + 8 * n_pixels + 1024;
    n * of_splat + INSTANCES * n * bytes_of_instance + 153 * n_pixels + of_view
}

#[test]
fn a_map_takes_the_bytes_that_the_formula_says() {
    for (n, degree) in [(20_000, 3), (60_000, 1)] {
        for mut engine in [gpu_engine(true), fast_engine()] {
            let bytes_of_instance = if engine.sums_in_any_order() { 29 } else { 77 };
            engine.append(&speck_cloud(n, degree)).unwrap();
            let view_ix = engine.add_view(view()).unwrap();
            (0..3).for_each(|_| engine.step(view_ix, &settings()).unwrap());
            assert_eq!(engine.take_stats().unwrap().n_steps, 3);
            let found = engine.memory().peak_gpu_bytes as f64;
            let said = formula(n, usize::from(degree), bytes_of_instance) as f64;
            assert!(
                (found / said - 1.0).abs() < BAR,
                "{n} splats of degree {degree}: {found} bytes, the formula says {said}"
            );
        }
    }
}
