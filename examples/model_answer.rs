//! What a model of docs/MODELS.md answers to given images, decoded as the node does it: for comparing an export with
//! the network that it came from.

#![allow(clippy::print_stdout, reason = "a program for people")]

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Parser;
use glam::DMat4;
use serde_json::json;

use splat_geometry::foundation::decode::{Answer, POSE_LENGTH};
use splat_geometry::foundation::model::Model;
use splat_mapper::params::settings::Settings;

/// Runs a model on images and writes answer.json, depth.f32 and conf.f32
#[derive(Debug, Parser)]
struct Args {
    /// Its description lies beside it as MODEL.json
    #[arg(value_name = "MODEL.onnx")]
    model: PathBuf,
    /// S*3*H*W numbers, f32 little endian, from 0 to 1
    #[arg(value_name = "IMAGES.f32")]
    images: PathBuf,
    /// Number of images
    #[arg(value_name = "S")]
    n_frames: usize,
    /// Folder for what comes out
    #[arg(value_name = "OUT_DIR")]
    out: PathBuf,
    /// One parameter, for example onnx.providers=cuda; repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let mut settings = Settings::shipped();
    for setting in &args.set {
        settings.merge_setting(setting)?;
    }
    let mut model = Model::open(&args.model, &settings.params()?.onnx)?;
    let bytes = fs::read(&args.images)
        .with_context(|| format!("cannot read the images: {}", args.images.display()))?;
    let numbers = bytes.chunks_exact(4);
    let images: Vec<f32> = numbers
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    let answer = model.answer(images)?;
    if answer.n_frames != args.n_frames {
        bail!("{} images, expected {}", answer.n_frames, args.n_frames);
    }
    write(&model, &answer, &args.out)?;
    println!(
        "{} frames on {}: {}",
        answer.n_frames,
        model.provider().name(),
        args.out.display()
    );
    Ok(())
}

fn write(model: &Model, answer: &Answer, out: &Path) -> anyhow::Result<()> {
    let mut frames = Vec::new();
    let cameras = answer.cameras(model.sidecar.pose);
    for (camera, encoded) in cameras
        .iter()
        .zip(answer.pose_enc.chunks_exact(POSE_LENGTH))
    {
        let camera = match camera {
            Ok(camera) => camera,
            Err(fault) => bail!("frame {} has {fault}", frames.len()),
        };
        let cam_from_world = camera.window_from_cam.inverse();
        let matrix =
            DMat4::from_rotation_translation(cam_from_world.rotation, cam_from_world.translation);
        frames.push(json!({
            "cam_from_world": matrix.transpose().to_cols_array(),
            "pose_enc": encoded,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": 0.5 * answer.width as f64,
            "cy": 0.5 * answer.height as f64,
        }));
    }
    fs::create_dir_all(out)?;
    fs::write(
        out.join("answer.json"),
        serde_json::to_vec_pretty(&json!({ "frames": frames }))?,
    )?;
    fs::write(out.join("depth.f32"), bytes_of(&answer.depth))?;
    fs::write(out.join("conf.f32"), bytes_of(&answer.depth_conf))?;
    Ok(())
}

fn bytes_of(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|v| v.to_le_bytes()).collect()
}
