//! The paper's ablation at a small size: the same replays with one submap left out each -> a table in Markdown.
//!
//! Runs the program beside it (`cargo build --release` first) with `--preset paper`, disturbed true poses and half of
//! the views held out, and judges each run with `eval --json`. `make ablation` calls it.

#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a program for people"
)]

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, bail};
use clap::Parser;
use serde_json::Value;

/// Every fourth frame of fox is trained on, and the one in the middle between two of them is held out.
const STRIDE: usize = 4;
const N_TRAIN: usize = 12;
/// 24 views at a third of the room's round, so that neighbours overlap as fox's do.
const ROOM: &str = "synthetic:room?frames=24&width=240&height=180&speed=1.6";

/// What is left out of the full method: name, settings.
const VARIANTS: [(&str, &[&str]); 6] = [
    ("full", &[]),
    ("no MCMC", &["mcmc.enabled=false"]),
    ("no depth", &["train.depth_weight=0.0"]),
    (
        "depth as in the paper's code",
        &["train.depth_mode=paper_code"],
    ),
    ("no MLP (poses one by one)", &["train.pose_opt=per_view"]),
    ("poses held", &["train.pose_opt=fixed"]),
];

/// Prints the ablation table.
#[derive(Debug, Parser)]
struct Args {
    /// Folder of the real scenes; else SPLAT_MAPPER_DATA, else ../shared/data
    #[arg(long)]
    data: Option<PathBuf>,
    /// Where the run directories go
    #[arg(long, default_value = "out/ablation")]
    out: PathBuf,
    #[arg(long, default_value_t = 2000)]
    steps: u64,
    /// Longer side of the images, in pixels
    #[arg(long, default_value_t = 240)]
    side: u32,
    #[arg(long, default_value_t = 20_000)]
    splats: u64,
    /// Standard deviation of the disturbance about each axis
    #[arg(long, default_value_t = 0.5)]
    noise_deg: f64,
    /// The same along each axis, in percent of the extent
    #[arg(long, default_value_t = 0.5)]
    noise_percent: f64,
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// A scene to run on: what names it, where it is, its settings and the file of its true poses.
struct Scene {
    name: &'static str,
    input: String,
    settings: Vec<String>,
    reference: PathBuf,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let program = program()?;
    let mut scenes = vec![room(&program, &args)?];
    let named = std::env::var_os("SPLAT_MAPPER_DATA").map(PathBuf::from);
    let data = args.data.clone().or(named);
    match fox(&data.unwrap_or_else(|| PathBuf::from("../shared/data"))) {
        Ok(scene) => scenes.insert(0, scene),
        Err(e) => eprintln!("fox is left out: {e:#}"),
    }
    println!(
        "{} steps, {} px, at most {} splats, poses disturbed by {} deg and {} % of the extent (std per axis), seed {}\n",
        args.steps, args.side, args.splats, args.noise_deg, args.noise_percent, args.seed
    );
    println!(
        "| scene | variant | held-out PSNR, dB | SSIM | ATE, % of extent | rotation, deg | splats | s |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for scene in &scenes {
        for (variant, settings) in VARIANTS {
            println!("{}", row(&program, &args, scene, variant, settings)?);
        }
    }
    Ok(())
}

fn program() -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own
        .parent()
        .and_then(Path::parent)
        .context("no folder above")?;
    let program = folder.join("splat-mapper");
    if !program.is_file() {
        bail!(
            "run cargo build --release first; missing: {}",
            program.display()
        );
    }
    Ok(program)
}

fn fox(data: &Path) -> anyhow::Result<Scene> {
    let folder = data.join("fox");
    let list = std::fs::read_to_string(folder.join("images.txt"))
        .with_context(|| format!("name the scenes' folder with --data: {}", folder.display()))?;
    let files: Vec<&str> = list
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'))
        .filter_map(|line| line.split_whitespace().nth(1)?.rsplit('/').next())
        .collect();
    let every_from = |first: usize| -> Vec<&str> {
        files
            .iter()
            .copied()
            .skip(first)
            .step_by(STRIDE)
            .take(N_TRAIN)
            .collect()
    };
    let (train, held_out) = (every_from(0), every_from(STRIDE / 2));
    let settings = vec![
        format!(
            "source.include_prefixes={},{}",
            train.join(","),
            held_out.join(",")
        ),
        format!("source.holdout_prefixes={}", held_out.join(",")),
        "map.holdout=0".to_owned(),
    ];
    Ok(Scene {
        name: "fox",
        input: format!("images:{}", folder.display()),
        settings,
        reference: folder.join("poses_tum.txt"),
    })
}

/// Its truth is what an undisturbed run says of its poses before the first step.
fn room(program: &Path, args: &Args) -> anyhow::Result<Scene> {
    let truth = args.out.join("room_truth");
    let settings = ["select.every_frame=true", "map.holdout=0", "train.steps=0"].map(str::to_owned);
    replay(program, args, ROOM, &truth, &settings)?;
    Ok(Scene {
        name: "room",
        input: ROOM.to_owned(),
        settings: vec!["map.holdout=2".to_owned()],
        reference: truth.join("keyframes.tum"),
    })
}

fn row(
    program: &Path,
    args: &Args,
    scene: &Scene,
    variant: &str,
    settings: &[&str],
) -> anyhow::Result<String> {
    let out = args.out.join(format!(
        "{}_{}",
        scene.name,
        variant.replace([' ', '(', ')'], "_")
    ));
    let seeds = args.splats / (2 * N_TRAIN as u64);
    let mut all = vec![
        format!("source.max_side={}", 2 * args.side),
        format!("train.max_side={}", args.side),
        format!("train.steps={}", args.steps),
        format!("map.max_splats={}", args.splats),
        format!("train.seeds_per_keyframe={seeds}"),
        // The preset's intervals, for its 7,000 steps, shortened as the run is.
        format!("train.sh_interval={}", (args.steps / 7).max(1)),
        format!("mcmc.every={}", (args.steps / 70).max(1)),
        format!("mcmc.start={}", args.steps / 14),
        "train.depth_mode=inv_depth".to_owned(),
        format!("ground_truth.rotation_noise_deg={}", args.noise_deg),
        format!(
            "ground_truth.translation_noise_extent={}",
            0.01 * args.noise_percent
        ),
    ];
    all.extend(scene.settings.iter().cloned());
    all.extend(settings.iter().map(|s| (*s).to_owned()));
    eprintln!("{} {variant}: {}", scene.name, out.display());
    replay(program, args, &scene.input, &out, &all)?;
    let report: Value = serde_json::from_slice(&std::fs::read(out.join("report.json"))?)?;
    let eval = Command::new(program)
        .arg("eval")
        .arg(&out)
        .arg("--reference")
        .arg(&scene.reference)
        .arg("--json")
        .output()?;
    let eval: Value = serde_json::from_slice(&eval.stdout).context("eval gave no JSON")?;
    let figure = |value: &Value, digits: usize| {
        value
            .as_f64()
            .map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
    };
    Ok(format!(
        "| {} | {variant} | {} | {} | {} | {} | {} | {} |",
        scene.name,
        figure(&report["quality"]["psnr_holdout"], 2),
        figure(&report["quality"]["ssim_holdout"], 3),
        figure(&eval["ate_percent_of_extent"], 3),
        figure(&eval["rotation_mean_deg"], 3),
        report["splats"],
        figure(&report["timing_s"]["wall"], 0),
    ))
}

fn replay(
    program: &Path,
    args: &Args,
    input: &str,
    out: &Path,
    settings: &[String],
) -> anyhow::Result<()> {
    let mut command = Command::new(program);
    command
        .args([
            "replay",
            input,
            "--preset",
            "paper",
            "--geometry",
            "ground_truth",
        ])
        .arg("--out")
        .arg(out)
        .args(["--seed", &args.seed.to_string()])
        .env("RUST_LOG", "warn");
    for setting in settings {
        command.args(["--set", setting]);
    }
    let output = command.output()?;
    if !output.status.success() {
        bail!("{}", String::from_utf8_lossy(&output.stderr));
    }
    Ok(())
}
