//! Many steps on a small scene -> whether every number stays finite and memory stays flat.
//!
//! Joint optimisation with everything on: MCMC moves and noise, network and own increments, exposure, focal length.
//! `make soak` calls it for both backends.

#![allow(clippy::print_stdout, reason = "a program for people")]

use std::sync::Arc;

use anyhow::{Context, bail};
use clap::{Parser, ValueEnum};
use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::loss_weights::LossWeights;
use splat_engine::mcmc::Relocation;
use splat_engine::settings::{
    FirstEmbedding, McmcSettings, PoseMode, PoseNetworkSettings, StepSettings,
};
use splat_engine::traits::Engine;
use splat_engine::view::TrainingView;
use splat_engine::wgpu::engine::WgpuEngine;
use splat_gpu::device::Wanted;
use splat_types::camera::Intrinsics;
use splat_types::image::RgbImage;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

const N_VIEWS: usize = 8;
const N_SPLATS: usize = 700;
const MAX_SPLATS: usize = 1500;
const MOVE_EVERY: u64 = 100;
/// Lines of the table, and the first from which memory must be flat: buffers have grown by then.
const N_LOOKS: u64 = 10;
const FLAT_FROM: u64 = 3;
/// Growth of resident memory that counts as none, MiB: allocators and drivers breathe.
const MAX_GROWTH_MIB: f64 = 4.0;

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Backend {
    Cpu,
    Wgpu,
}

/// Steps an engine for long and looks at it.
#[derive(Debug, Parser)]
struct Args {
    #[arg(long, value_enum, default_value = "cpu")]
    backend: Backend,
    #[arg(long, default_value_t = 100_000)]
    steps: u64,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let mut engine: Box<dyn Engine> = match args.backend {
        Backend::Cpu => Box::new(CpuEngine::new()),
        Backend::Wgpu => Box::new(WgpuEngine::new(Wanted {
            any_kind: true,
            subgroups: true,
            float_atomics: false,
            lanes: None,
        })?),
    };
    set_up(&mut *engine)?;
    println!("{} steps on {}\n", args.steps, engine.adapter());
    println!("| step | loss | splats | RSS, MiB | GPU, MiB |");
    println!("|---|---|---|---|---|");
    let every = (args.steps / N_LOOKS).max(1);
    let mut first_mib = None;
    for n in 1..=args.steps {
        engine.step((n as usize * 5) % N_VIEWS, &settings(n))?;
        if n.is_multiple_of(MOVE_EVERY) {
            engine.relocate_and_grow(&McmcSettings {
                min_opacity: 0.005,
                copies: Relocation::Image,
                max_splats: MAX_SPLATS,
                growth: 1.05,
                active_steps: 0,
                keeps_age: false,
                seed: n as u32,
            })?;
        }
        if !n.is_multiple_of(every) {
            continue;
        }
        let mib = rss_mib()?;
        report(&mut *engine, n, mib)?;
        if n >= FLAT_FROM * every {
            let growth = mib - *first_mib.get_or_insert(mib);
            if growth > MAX_GROWTH_MIB {
                bail!("resident memory has grown by {growth:.1} MiB up to step {n}");
            }
        }
    }
    println!("\nfinite and flat");
    Ok(())
}

fn report(engine: &mut dyn Engine, n: u64, mib: f64) -> anyhow::Result<()> {
    let loss = engine.take_stats()?.loss;
    let splats = engine.read()?;
    let broken = (0..splats.len()).filter(|i| !splats.is_finite(*i)).count();
    let poses = engine.poses()?;
    if broken > 0 || !loss.is_finite() || !poses.iter().all(Rigid::is_finite) {
        bail!("step {n}: loss {loss}, {broken} splats are not finite, poses {poses:?}");
    }
    let gpu_mib = engine.memory().peak_gpu_bytes as f64 / (1024.0 * 1024.0);
    println!(
        "| {n} | {loss:.5} | {} | {mib:.1} | {gpu_mib:.1} |",
        splats.len()
    );
    Ok(())
}

/// Resident now, not at most: what a leak would raise.
fn rss_mib() -> anyhow::Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status").context("needs Linux's /proc")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    Ok(kib.context("no VmRSS in /proc/self/status")? / 1024.0)
}

fn settings(n: u64) -> StepSettings {
    StepSettings {
        lr_mean: 5e-4,
        lr_scale: 5e-3,
        lr_quat: 1e-3,
        lr_opacity: 5e-2,
        lr_sh0: 2.5e-3,
        lr_sh_rest: 1.25e-4,
        lr_pose_rotation: 1e-4,
        lr_pose_translation: 1e-4,
        lr_pose_network: 1.5e-4,
        lr_focal: 1e-5,
        lr_exposure: 1e-4,
        ssim_weight: 0.2,
        weights: LossWeights {
            opacity_reg: 0.01,
            scale_reg: 0.01,
            ..LossWeights::default()
        },
        noise: 0.05,
        noise_seed: n as u32,
        sh_degree: 2,
        sh_interval: 1000,
        train_splats: true,
        pose: PoseMode::Shared,
        ..StepSettings::default()
    }
}

/// A wall of splats with relief, photographed along an arc, disturbed.
fn set_up(engine: &mut dyn Engine) -> anyhow::Result<()> {
    let mut rng = Pcg64Mcg::seed_from_u64(21);
    let mut splats = Splats {
        sh_degree: 2,
        ..Splats::default()
    };
    for _ in 0..N_SPLATS {
        let at = [rng.random_range(-1.6..1.6), rng.random_range(-1.2..1.2)];
        let depth = rng.random_range(2.0_f32..3.2);
        splats.means.push([at[0], at[1], depth]);
        splats.log_scales.push([rng.random_range(-3.2..-2.2); 3]);
        splats.quats.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacity_logits.push(2.0);
        splats.anchors.push(0);
        let color = (0..27).map(|k| rng.random_range(-1.5_f32..1.5) / (1.0 + k as f32));
        splats.sh.extend(color);
    }
    engine.append(&splats)?;
    let intrinsics = Intrinsics {
        width_px: 72,
        height_px: 54,
        fx: 62.0,
        fy: 62.0,
        cx: 36.0,
        cy: 27.0,
    };
    for k in 0..N_VIEWS {
        let t = k as f64 / (N_VIEWS - 1) as f64 - 0.5;
        let place = DVec3::new(1.2 * t, 0.2 * (7.0 * t).sin(), 0.1 * t);
        let truth = Rigid::new(DQuat::from_rotation_y(-0.25 * t), place).inverse();
        let rendering = engine.render(&intrinsics, &truth, 2)?;
        let pixels = rendering.rgb.iter();
        let pixels = pixels.map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8);
        let mut three =
            || DVec3::from_array(std::array::from_fn(|_| rng.random_range(-0.02..0.02)));
        engine.add_view(TrainingView {
            image: Arc::new(RgbImage {
                width_px: intrinsics.width_px,
                height_px: intrinsics.height_px,
                pixels: pixels.collect(),
            }),
            intrinsics,
            cam_from_world: Rigid::exp(three(), three()) * truth,
            depth: None,
            mask: None,
        })?;
    }
    for mean in &mut splats.means {
        mean.iter_mut()
            .for_each(|v| *v += rng.random_range(-0.02..0.02));
    }
    engine.replace(&splats)?;
    engine.start_pose_network(&PoseNetworkSettings {
        embedding: FirstEmbedding::Order,
        seed: 1,
        camera_scale: 0.4,
    })?;
    Ok(())
}
