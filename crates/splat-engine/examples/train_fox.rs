//! Trains splats on photos with known poses, then renders a view that it never trained on.
//!
//! `cargo run --release -p splat-engine --example train_fox -- fox/transforms.json fox.png 2000`
#![allow(clippy::print_stdout, reason = "an example")]

use std::{env, error::Error, iter, path::Path};

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::random_start::{camera_extent, random_splats};
use splat_engine::settings::StepSettings;
use splat_engine::traits::{Renderer, SplatBuffers, Trainer, ViewStore};
use splat_engine::view::TrainingView;
use splat_io::{frame_source::Source, images::ImagesSource, params::SourceParams};
use splat_types::frame::Frame;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = env::args().collect();
    let [_, json, png, n_steps] = args.as_slice() else {
        return Err("usage: train_fox TRANSFORMS_JSON OUTPUT_PNG STEPS".into());
    };
    let params = SourceParams {
        max_side: 400,
        ..SourceParams::default()
    };
    let mut photos = ImagesSource::open(Path::new(json), &params, 0)?;
    let mut views: Vec<_> = iter::from_fn(|| photos.next()).filter_map(view).collect();
    let held_out = views.remove(views.len() / 2);

    let mut engine = CpuEngine::new();
    engine.append(&random_splats(&views, 20_000, 0))?;
    for view in &views {
        engine.add_view(view.clone())?;
    }
    // Rates of 3DGS, raised for a short run. That of the means is a length, and decays to a hundredth.
    let (lr_scale, lr_quat, lr_opacity, lr_sh0) = (1e-2, 1e-3, 5e-2, 1e-2);
    let (extent, n_steps) = (camera_extent(&views) as f32, n_steps.parse::<usize>()?);
    for step in 0..n_steps {
        let lr_mean = 1e-3 * extent * 0.01_f32.powf(step as f32 / n_steps as f32);
        #[rustfmt::skip]
        let settings = StepSettings {
            lr_mean, lr_scale, lr_quat, lr_opacity, lr_sh0, ssim_weight: 0.2, train_splats: true, ..StepSettings::default()
        };
        // A prime stride mixes the order of the views.
        engine.step(step * 7919 % views.len(), &settings)?;
    }

    let shown = engine
        .render(&held_out.intrinsics, &held_out.cam_from_world, 0)?
        .to_rgb();
    let pairs = shown.pixels.iter().zip(&held_out.image.pixels);
    let squares: f64 = pairs.map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
    let psnr = 10.0 * (255_f64.powi(2) * shown.pixels.len() as f64 / squares).log10();
    println!("held-out view: PSNR {psnr:.2} dB");
    let (width, height) = (shown.width_px, shown.height_px);
    Ok(image::save_buffer(
        png,
        &shown.pixels,
        width,
        height,
        image::ColorType::Rgb8,
    )?)
}

/// A photo and its camera, where both are known.
fn view(frame: Frame) -> Option<TrainingView> {
    let (intrinsics, world_from_cam) = frame.intrinsics.zip(frame.truth)?;
    let cam_from_world = world_from_cam.inverse();
    let (image, depth, mask) = (frame.image, None, None);
    Some(TrainingView {
        image,
        intrinsics,
        cam_from_world,
        depth,
        mask,
    })
}
