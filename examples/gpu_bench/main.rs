//! What an adapter makes of the shaders: whether they agree with the CPU engine, how fast steps and their kernels are, what
//! whole replays take. Writes tables of Markdown to the standard output; `make gpu-bench` makes a report of them.

#![allow(clippy::print_stdout, reason = "a program for people")]

mod agreement;
mod replays;
mod scene;
mod speed;

use std::path::PathBuf;

use clap::{Parser, ValueEnum};

use splat_engine::traits::Device as _;
use splat_engine::view::TrainingView;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_gpu::device::Wanted;
use splat_types::splats::splats::Splats;

/// Benchmarks of a GPU.
#[derive(Debug, Parser)]
struct Args {
    /// Recordings to replay on the GPU and on the CPU.
    #[arg(long = "replay")]
    replays: Vec<PathBuf>,
    /// The program that replays them.
    #[arg(long, default_value = "target/release/splat-mapper")]
    binary: PathBuf,
    /// Folder for their runs.
    #[arg(long, default_value = "out/gpu_bench")]
    out: PathBuf,
    /// Threads of a tile to compare: divisors of 256.
    #[arg(long, value_delimiter = ',', default_values_t = [32, 64, 128, 256])]
    lanes: Vec<u32>,
    /// Splats of the largest map.
    #[arg(long, default_value_t = 1_000_000)]
    max_splats: usize,
    /// Tables to make.
    #[arg(long, value_delimiter = ',', value_enum, default_values_t = [
        Part::Agreement, Part::Lanes, Part::Sizes, Part::Kernels, Part::Sweeps, Part::Replays,
    ])]
    parts: Vec<Part>,
    /// Leave the CPU's figures out.
    #[arg(long)]
    gpu_only: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    /// Gradients beside the CPU engine's.
    Agreement,
    /// Steps by threads of a tile.
    Lanes,
    /// Steps by splats and image.
    Sizes,
    /// Time of each kernel of a step.
    Kernels,
    /// Depth of a view.
    Sweeps,
    Replays,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let engine = WgpuEngine::new(wanted(None, false))?;
    println!(
        "Adapter: {}, {:?}\n",
        engine.adapter(),
        engine.gpu().lanes()
    );
    println!("```\n{:#?}\n```\n", engine.gpu().limits());
    drop(engine);
    for part in &args.parts {
        match part {
            Part::Agreement => agreement::table()?,
            Part::Lanes => speed::lanes(&args.lanes)?,
            Part::Sizes => speed::sizes(args.max_splats, args.gpu_only)?,
            Part::Kernels => {
                speed::kernels(args.max_splats.min(54_000), [270, 480])?;
                speed::kernels(args.max_splats, [1920, 1080])?;
            }
            Part::Sweeps => speed::sweeps(args.gpu_only)?,
            Part::Replays => replays::table(&args),
        }
    }
    Ok(())
}

/// What the benchmarks ask of an adapter: software too, so that they run anywhere.
pub(crate) fn wanted(lanes: Option<u32>, float_atomics: bool) -> Wanted {
    Wanted {
        any_kind: true,
        subgroups: true,
        float_atomics,
        lanes,
    }
}

/// A scene whose splats are as large together as those of trained maps: some 200 in a tile at 270x480.
pub(crate) fn trained_scene(n: usize, size: [u32; 2]) -> (Splats, TrainingView) {
    let n_pixels = f64::from(size[0]) * f64::from(size[1]);
    scene::scene(n, 1.2 * (n_pixels / n as f64).sqrt(), size)
}
