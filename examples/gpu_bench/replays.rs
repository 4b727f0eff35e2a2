//! Whole replays of recordings on the GPU and on the CPU.

use std::path::Path;
use std::process::Command;

use anyhow::Context as _;
use serde_json::Value;

use crate::Args;

/// Backends and options of the runs.
const RUNS: [(&str, &[&str]); 4] = [
    ("CPU", &["--backend", "cpu"]),
    ("GPU", &["--backend", "wgpu"]),
    (
        "GPU, sums in any order",
        &["--backend", "wgpu", "--set", "deterministic=false"],
    ),
    (
        "GPU, `--preset paper`",
        &["--backend", "wgpu", "--preset", "paper"],
    ),
];

/// Prints time, quality and memory of each run.
pub(crate) fn table(args: &Args) {
    if args.replays.is_empty() {
        return;
    }
    println!("Whole replays:\n");
    println!(
        "| recording | on | wall, s | optimising, s | steps | splats | held-out PSNR, dB | RSS, MiB | GPU, MiB |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for recording in &args.replays {
        for (ix, (name, options)) in RUNS.iter().enumerate() {
            if args.gpu_only && *name == "CPU" {
                continue;
            }
            let label = recording.file_name().unwrap_or_default().to_string_lossy();
            let out = args.out.join(format!("{label}-{ix}"));
            match run(args, recording, options, &out) {
                Ok(cells) => println!("| {label} | {name} | {cells} |"),
                Err(error) => println!("| {label} | {name} | failed: {error:#} |"),
            }
        }
    }
    println!();
}

fn run(args: &Args, recording: &Path, options: &[&str], out: &Path) -> anyhow::Result<String> {
    let status = Command::new(&args.binary)
        .arg("replay")
        .arg(recording)
        .args(options)
        .arg("--out")
        .arg(out)
        .output()
        .with_context(|| format!("{} does not start", args.binary.display()))?;
    let said = String::from_utf8_lossy(&status.stderr);
    anyhow::ensure!(
        status.status.success(),
        "{}",
        said.lines().last().unwrap_or_default()
    );
    let text = std::fs::read_to_string(out.join("report.json"))?;
    let report: Value = serde_json::from_str(&text)?;
    let at = |path: &str, places: usize| match report.pointer(path).and_then(Value::as_f64) {
        Some(number) => format!("{number:.places$}"),
        None => "-".to_owned(),
    };
    Ok([
        at("/timing_s/wall", 1),
        at("/timing_s/optimise", 1),
        at("/steps", 0),
        at("/splats", 0),
        at("/quality/psnr_holdout", 2),
        at("/peak_rss_mib", 0),
        at("/peak_gpu_mib", 0),
    ]
    .join(" | "))
}
