//! LPIPS of two images by an ONNX file, as `eval.lpips_model` measures it: for comparing an export with the network that it came from.

#![allow(clippy::print_stdout, reason = "a program for people")]

use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Parser;
use serde_json::json;

use splat_mapper::eval::lpips::lpips;
use splat_types::image::RgbImage;

/// Prints the distance of two images as JSON
#[derive(Debug, Parser)]
struct Args {
    #[arg(value_name = "LPIPS.onnx")]
    model: PathBuf,
    /// Two images, one after the other: 2*H*W*3 bytes
    #[arg(value_name = "IMAGES.u8")]
    images: PathBuf,
    width: u32,
    height: u32,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let bytes = std::fs::read(&args.images)
        .with_context(|| format!("cannot read {}", args.images.display()))?;
    let n = 3 * args.width as usize * args.height as usize;
    ensure!(
        n > 0 && bytes.len() == 2 * n,
        "{} holds {} bytes, not two images of {}x{}",
        args.images.display(),
        bytes.len(),
        args.width,
        args.height
    );
    let rendered: Vec<f32> = bytes[..n].iter().map(|v| f32::from(*v) / 255.0).collect();
    let photo = RgbImage {
        width_px: args.width,
        height_px: args.height,
        pixels: bytes[n..].to_vec(),
    };
    let model = args.model.to_string_lossy();
    let mut network = lpips(&model)?.context("name an ONNX file")?;
    let distance = network.distance(&rendered, &photo)?;
    println!("{}", json!({ "distance": distance }));
    Ok(())
}
