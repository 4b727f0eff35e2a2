//! Trains splats on photos with known poses, then renders a view that it never trained on.
//!
//! `cargo run --release -p splat-engine --example train_fox -- fox/transforms.json fox.png 2000`
#![allow(clippy::print_stdout, reason = "an example")]

use std::{env, error::Error, iter, path::Path};

use image::{ColorType, save_buffer};
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::random_start::{camera_extent, random_splats};
use splat_engine::settings::StepSettings;
use splat_engine::traits::{Renderer, SplatBuffers, Trainer, ViewStore};
use splat_engine::view::TrainingView;
use splat_io::{frame_source::Source, images::ImagesSource, params::SourceParams};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = env::args().collect();
    let [_, json, png, n_steps] = args.as_slice() else {
        return Err("usage: train_fox TRANSFORMS_JSON OUTPUT_PNG STEPS".into());
    };
    let n_steps: usize = n_steps.parse()?;

    let params = SourceParams {
        max_side: 400,
        ..SourceParams::default()
    };
    let mut photos = ImagesSource::open(Path::new(json), &params, 0)?;
    let views = iter::from_fn(|| photos.next()).filter_map(|photo| {
        let (intrinsics, world_from_cam) = (photo.intrinsics?, photo.truth?);
        let cam_from_world = world_from_cam.inverse();
        Some(TrainingView::new(photo.image, intrinsics, cam_from_world))
    });
    let mut views: Vec<TrainingView> = views.collect();
    let held_out = views.remove(views.len() / 2);

    let mut engine = CpuEngine::new();
    engine.append(&random_splats(&views, 20_000, 0))?;
    for view in &views {
        engine.add_view(view.clone())?;
    }
    // Rates of 3DGS, raised for a short run. That of the means is a length, and decays to a hundredth.
    let mut settings = StepSettings {
        lr_scale: 1e-2,
        lr_quat: 1e-3,
        lr_opacity: 5e-2,
        lr_sh0: 1e-2,
        ssim_weight: 0.2,
        train_splats: true,
        ..StepSettings::default()
    };
    let extent = camera_extent(&views) as f32;
    for step in 0..n_steps {
        settings.lr_mean = 1e-3 * extent * 0.01_f32.powf(step as f32 / n_steps as f32);
        // A prime stride mixes the order of the views.
        engine.step(step * 7919 % views.len(), &settings)?;
    }

    let rendering = engine.render(&held_out.intrinsics, &held_out.cam_from_world, 0)?;
    let psnr = rendering.psnr(&held_out.image);
    println!("held-out view: PSNR {psnr:.2} dB");
    let shown = rendering.to_rgb();
    let (width, height) = (shown.width_px, shown.height_px);
    save_buffer(png, &shown.pixels, width, height, ColorType::Rgb8)?;
    Ok(())
}
