//! Trains splats on photos with known poses, then renders a view that it never trained on.
//!
//! `cargo run --release -p splat-engine --example train_fox -- fox/transforms.json fox.png 2000`
#![allow(clippy::print_stdout, reason = "an example")]

use std::{env, error::Error, f64::consts::PI, fs, path::Path, sync::Arc};

use glam::{DMat4, DQuat, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use serde_json::Value;
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::settings::StepSettings;
use splat_engine::traits::{Renderer, SplatBuffers, Trainer, ViewStore};
use splat_engine::view::TrainingView;
use splat_types::{camera::Intrinsics, image::RgbImage, splats::splats::Splats, transform::Rigid};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = env::args().collect();
    let [_, json, png, n_steps] = args.as_slice() else {
        return Err("usage: train_fox TRANSFORMS_JSON OUTPUT_PNG STEPS".into());
    };
    let file: Value = serde_json::from_slice(&fs::read(json)?)?;
    let frames = file["frames"].as_array().ok_or("no frames")?.iter();
    let views = frames.map(|frame| view(Path::new(json), &file, frame));
    let mut views: Vec<TrainingView> = views.collect::<Result<_, _>>()?;
    let held_out = views.remove(views.len() / 2);

    let (splats, reach) = random_splats(&views, 20_000);
    let mut engine = CpuEngine::new();
    engine.append(&splats)?;
    for view in &views {
        engine.add_view(view.clone())?;
    }
    // Rates of 3DGS, raised for a short run. That of the means is a length, and decays to a hundredth.
    let (lr_scale, lr_quat, lr_opacity, lr_sh0) = (1e-2, 1e-3, 5e-2, 1e-2);
    let n_steps: usize = n_steps.parse()?;
    for step in 0..n_steps {
        let lr_mean = 1e-3 * reach * 0.01_f32.powf(step as f32 / n_steps as f32);
        #[rustfmt::skip]
        let settings = StepSettings {
            lr_mean, lr_scale, lr_quat, lr_opacity, lr_sh0, ssim_weight: 0.2, train_splats: true, ..StepSettings::default()
        };
        // A prime stride mixes the order of the views.
        engine.step(step * 7919 % views.len(), &settings)?;
    }

    let shown = engine.render(&held_out.intrinsics, &held_out.cam_from_world, 0)?;
    let bytes: Vec<u8> = shown
        .rgb
        .iter()
        .map(|v| (255.0 * v).round() as u8)
        .collect();
    let pairs = bytes.iter().zip(&held_out.image.pixels);
    let squares: f64 = pairs.map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
    println!(
        "held-out view: PSNR {:.2} dB",
        10.0 * (255_f64.powi(2) * bytes.len() as f64 / squares).log10()
    );
    Ok(image::save_buffer(
        png,
        &bytes,
        shown.width_px,
        shown.height_px,
        image::ColorType::Rgb8,
    )?)
}

/// A photo of at most 400 px a side, and its camera; lens distortion is ignored.
fn view(json: &Path, file: &Value, frame: &Value) -> Result<TrainingView, Box<dyn Error>> {
    let number = |key: &'static str| file[key].as_f64().ok_or(key);
    let name = frame["file_path"].as_str().ok_or("no file_path")?;
    let photo = image::open(json.with_file_name(name))?
        .thumbnail(400, 400)
        .to_rgb8();
    let (width_px, height_px) = photo.dimensions();
    let shrink = f64::from(width_px) / number("w")?;
    let [fx, fy, cx, cy] = [
        number("fl_x")?,
        number("fl_y")?,
        number("cx")?,
        number("cy")?,
    ]
    .map(|v| v * shrink);
    let rows: [[f64; 4]; 4] = serde_json::from_value(frame["transform_matrix"].clone())?;
    let (_, rotation, translation) = DMat4::from_cols_array_2d(&rows)
        .transpose()
        .to_scale_rotation_translation();
    // OpenGL cameras have y up and z backward, ours y down and z forward.
    let world_from_cam = Rigid::new(rotation * DQuat::from_rotation_x(PI), translation);
    Ok(TrainingView {
        image: Arc::new(RgbImage {
            width_px,
            height_px,
            pixels: photo.into_raw(),
        }),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx,
            fy,
            cx,
            cy,
        },
        cam_from_world: world_from_cam.inverse(),
        depth: None,
        mask: None,
    })
}

/// Grey splats somewhere on rays through random pixels; also how far cameras are from their middle.
fn random_splats(views: &[TrainingView], n: usize) -> (Splats, f32) {
    let centres: Vec<DVec3> = views
        .iter()
        .map(|view| view.cam_from_world.inverse().translation)
        .collect();
    let middle = centres.iter().sum::<DVec3>() / centres.len() as f64;
    let reach = centres
        .iter()
        .map(|centre| centre.distance(middle))
        .fold(0.0, f64::max);
    let mut rng = rand_pcg::Pcg32::seed_from_u64(0);
    let mut point = || {
        let view = &views[rng.random_range(0..views.len())];
        let size = DVec2::new(view.image.width_px.into(), view.image.height_px.into());
        let pixel = size * DVec2::new(rng.random(), rng.random());
        let in_cam = view.intrinsics.ray_in_cam(pixel) * rng.random_range(0.3..3.0) * reach;
        view.cam_from_world
            .inverse()
            .transform_point(in_cam)
            .as_vec3()
            .to_array()
    };
    let splats = Splats {
        means: (0..n).map(|_| point()).collect(),
        log_scales: vec![[(0.03 * reach).ln() as f32; 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![-2.0; n],
        sh: vec![0.0; 3 * n],
        sh_degree: 0,
        anchors: vec![0; n],
    };
    (splats, reach as f32)
}
