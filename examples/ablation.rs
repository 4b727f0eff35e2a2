//! The paper's ablation at a small size: the same replays with one part left out or added each, on several scenes and seeds -> a table in
//! Markdown, means and spreads.
//!
//! Runs the program beside it (`cargo build --release` first) with `--preset paper`, disturbed true poses and views held out, and judges each
//! run with `eval --json`. A run that is there already, with the same settings, is kept. `make ablation` calls it.

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

/// 24 views at a third of the room's round, so that neighbours overlap as fox's do.
const ROOM: &str = "synthetic:room?frames=24&width=240&height=180&speed=1.6";

/// What is left out of the full method, or added to it: name, settings.
const VARIANTS: [(&str, &[&str]); 9] = [
    ("full", &[]),
    ("no MCMC", &["mcmc.enabled=false"]),
    ("no depth", &["train.depth_weight=0.0"]),
    (
        "depth as in the paper's code",
        &["train.depth_mode=paper_code"],
    ),
    // The preset's rates of single views are 0: the network alone moves poses.
    (
        "no MLP (poses one by one)",
        &[
            "train.pose_opt=per_view",
            "train.lr_rotation=0.0005",
            "train.lr_translation=0.0005",
        ],
    ),
    ("poses held", &["train.pose_opt=fixed"]),
    ("with exposures", &["train.lr_exposure=0.001"]),
    (
        "with the appearance network",
        &["train.lr_appearance=0.001"],
    ),
    ("with the epipolar loss", &["train.epipolar_weight=2.0"]),
];
/// Poses off one by one.
const INDEPENDENT: [&str; 2] = [
    "ground_truth.rotation_noise_deg=0.5",
    "ground_truth.translation_noise_extent=0.005",
];
/// One window with the errors of a network (docs/ALIGNMENT.md), left as they are: what neighbouring views have in common is the most of them.
const CORRELATED: [&str; 10] = [
    "ground_truth.windows=true",
    "align.method=off",
    "select.batch_size=64",
    "ground_truth.rotation_noise_deg=0.05",
    "ground_truth.walk_deg=0.2",
    "ground_truth.walk_translation=0.002",
    "ground_truth.depth_noise=0.03",
    "ground_truth.depth_outliers=0.02",
    "ground_truth.depth_warp=0.04",
    "ground_truth.edge_bleed_px=2",
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
    #[arg(long, default_value_t = 1000)]
    steps: u64,
    /// Longer side of the images, in pixels
    #[arg(long, default_value_t = 240)]
    side: u32,
    #[arg(long, default_value_t = 20_000)]
    splats: u64,
    #[arg(long, value_delimiter = ',', default_value = "0,1,2")]
    seeds: Vec<u64>,
    /// Names of scenes; else all
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
}

/// A scene to run on: what names it, where it is, its settings and the file of its true poses.
struct Scene {
    name: &'static str,
    input: String,
    settings: Vec<String>,
    reference: PathBuf,
    n_train: u64,
}

/// What a run ended with, in the order of the table; `None`: not measured.
type Figures = [Option<f64>; 7];
const COLUMNS: [(&str, usize); 7] = [
    ("held-out PSNR, dB", 2),
    ("with own exposure, dB", 2),
    ("SSIM", 3),
    ("ATE, % of extent", 3),
    ("rotation, deg", 3),
    ("splats", 0),
    ("s", 0),
];

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let program = program()?;
    let named = std::env::var_os("SPLAT_MAPPER_DATA").map(PathBuf::from);
    let data = args.data.clone().or(named);
    let data = data.unwrap_or_else(|| PathBuf::from("../shared/data"));
    println!(
        "{} steps, {} px, at most {} splats, seeds {:?}: mean, and half of the range\n",
        args.steps, args.side, args.splats, args.seeds
    );
    let titles: Vec<&str> = COLUMNS.iter().map(|column| column.0).collect();
    println!("| scene | variant | {} |", titles.join(" | "));
    println!("|{}", "---|".repeat(COLUMNS.len() + 2));
    for scene in scenes(&program, &args, &data)? {
        let is_wanted = args.scenes.is_empty() || args.scenes.iter().any(|name| name == scene.name);
        for (variant, settings) in VARIANTS.iter().filter(|_| is_wanted) {
            let runs: Vec<Figures> = args
                .seeds
                .iter()
                .map(|seed| run(&program, &args, &scene, (variant, settings, *seed)))
                .collect::<anyhow::Result<_>>()?;
            println!("| {} | {variant} | {} |", scene.name, cells(&runs));
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

/// Scenes whose data is there.
fn scenes(program: &Path, args: &Args, data: &Path) -> anyhow::Result<Vec<Scene>> {
    let mut scenes = Vec::new();
    let images = [
        ("fox_clean, 12 views", "fox_clean", (4, 2)),
        ("fox_clean, 24 views", "fox_clean", (2, 1)),
        ("lund_door, 9 views", "lund_door", (1, 0)),
    ];
    for (name, folder, stride) in images {
        match image_scene(name, &data.join(folder), stride) {
            Ok(scene) => scenes.push(scene),
            Err(e) => eprintln!("{name} is left out: {e:#}"),
        }
    }
    let kitchen = data.join("kitchen7s");
    if kitchen.join("rosbag2").is_dir() {
        let own = [
            "select.every_frame=false",
            "select.max_rate_hz=1",
            "select.holdout_frames=25",
            "map.holdout=0",
        ];
        scenes.push(Scene {
            name: "kitchen7s",
            input: kitchen.join("rosbag2").display().to_string(),
            settings: own
                .iter()
                .chain(&INDEPENDENT)
                .map(|s| (*s).to_owned())
                .collect(),
            reference: kitchen.join("poses_tum.txt"),
            n_train: 30,
        });
    } else {
        eprintln!("kitchen7s is left out: it is not in {}", data.display());
    }
    scenes.push(room("room, errors of a network", "", program, args)?);
    scenes.push(room(
        "the same, exposure drifts",
        "&exposure=1",
        program,
        args,
    )?);
    Ok(scenes)
}

/// Of a folder of images every `stride`-th from the first on is trained on and every `stride`-th from `held_out_from` on held out; with a
/// stride of 1, every fourth is held out.
fn image_scene(
    name: &'static str,
    folder: &Path,
    (stride, held_out_from): (usize, usize),
) -> anyhow::Result<Scene> {
    let list = std::fs::read_to_string(folder.join("images.txt"))
        .with_context(|| format!("name the scenes' folder with --data: {}", folder.display()))?;
    let files: Vec<&str> = list
        .lines()
        .filter(|line| !line.trim_start().starts_with('#'))
        .filter_map(|line| line.split_whitespace().nth(1)?.rsplit('/').next())
        .collect();
    let is_held_out = |at: usize| match stride {
        1 => at % 4 == 2,
        _ => at % stride == held_out_from,
    };
    let is_train = |at: usize| !is_held_out(at) && at.is_multiple_of(stride);
    let those = |is_one: &dyn Fn(usize) -> bool| -> Vec<&str> {
        let all = files.iter().enumerate();
        all.filter(|(at, _)| is_one(*at)).map(|(_, f)| *f).collect()
    };
    let (train, held_out) = (those(&is_train), those(&is_held_out));
    let mut settings = vec![
        format!(
            "source.include_prefixes={},{}",
            train.join(","),
            held_out.join(",")
        ),
        format!("source.holdout_prefixes={}", held_out.join(",")),
        "source.subsample=0".to_owned(),
        "map.holdout=0".to_owned(),
    ];
    settings.extend(INDEPENDENT.map(str::to_owned));
    Ok(Scene {
        name,
        input: format!("images:{}", folder.display()),
        settings,
        reference: folder.join("poses_tum.txt"),
        n_train: train.len() as u64,
    })
}

/// Its truth is what an undisturbed run says of its poses before the first step.
fn room(name: &'static str, more: &str, program: &Path, args: &Args) -> anyhow::Result<Scene> {
    let input = format!("{ROOM}{more}");
    let truth = args.out.join("room_truth");
    let settings = ["select.every_frame=true", "map.holdout=0", "train.steps=0"].map(str::to_owned);
    replay(program, (&input, &truth), &settings, 0)?;
    let mut settings = vec!["map.holdout=2".to_owned()];
    settings.extend(CORRELATED.map(str::to_owned));
    Ok(Scene {
        name,
        input,
        settings,
        reference: truth.join("keyframes.tum"),
        n_train: 12,
    })
}

fn settings_of(args: &Args, scene: &Scene, own: &[&str]) -> Vec<String> {
    let seeds = args.splats / (2 * scene.n_train);
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
        format!("train.epipolar_until={}", (args.steps / 10).max(1)),
        "train.depth_mode=inv_depth".to_owned(),
        "eval.at_steps=".to_owned(),
        "eval.train_views=1".to_owned(),
    ];
    all.extend(scene.settings.iter().cloned());
    all.extend(own.iter().map(|s| (*s).to_owned()));
    all
}

fn run(
    program: &Path,
    args: &Args,
    scene: &Scene,
    (variant, own, seed): (&str, &[&str], u64),
) -> anyhow::Result<Figures> {
    let name = format!("{}_{variant}_{seed}", scene.name);
    let out = args.out.join(name.replace([' ', '(', ')', ',', '\''], "_"));
    let all = settings_of(args, scene, own);
    eprintln!("{}, {variant}, seed {seed}: {}", scene.name, out.display());
    let (record, wanted) = (out.join("ablation.txt"), all.join("\n"));
    if std::fs::read_to_string(&record).ok().as_ref() != Some(&wanted) {
        replay(program, (&scene.input, &out), &all, seed)?;
        std::fs::write(&record, wanted)?;
    }
    let report: Value = serde_json::from_slice(&std::fs::read(out.join("report.json"))?)?;
    let eval = Command::new(program)
        .arg("eval")
        .arg(&out)
        .arg("--reference")
        .arg(&scene.reference)
        .arg("--json")
        .output()?;
    let eval: Value = serde_json::from_slice(&eval.stdout).context("eval gave no JSON")?;
    let quality = &report["quality"];
    let all = [
        &quality["psnr_holdout"],
        &quality["psnr_holdout_exposed"],
        &quality["ssim_holdout"],
        &eval["ate_percent_of_extent"],
        &eval["rotation_mean_deg"],
        &report["splats"],
        &report["timing_s"]["wall"],
    ];
    Ok(all.map(Value::as_f64))
}

/// Mean over the runs and half of their range, of each column.
fn cells(runs: &[Figures]) -> String {
    let cell = |(at, (_, digits)): (usize, &(&str, usize))| {
        let values: Vec<f64> = runs.iter().filter_map(|figures| figures[at]).collect();
        if values.is_empty() {
            return "-".to_owned();
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let least = values.iter().copied().fold(f64::MAX, f64::min);
        let most = values.iter().copied().fold(f64::MIN, f64::max);
        let half = (most - least) / 2.0;
        match *digits {
            0 => format!("{mean:.0}"),
            digits => format!("{mean:.digits$} ±{half:.digits$}"),
        }
    };
    let cells: Vec<String> = COLUMNS.iter().enumerate().map(cell).collect();
    cells.join(" | ")
}

fn replay(
    program: &Path,
    (input, out): (&str, &Path),
    settings: &[String],
    seed: u64,
) -> anyhow::Result<()> {
    let mut command = Command::new(program);
    command
        .args(["replay", input, "--preset", "paper"])
        .args(["--geometry", "ground_truth", "--backend", "cpu", "--out"])
        .arg(out)
        .args(["--seed", &seed.to_string()])
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
