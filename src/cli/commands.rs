//! `synth`, `eval`, `render`, `export`, `model`, `doctor`: arguments -> one call each.

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, bail};

use crate::cli::{
    EvalArgs, ExportArgs, ModelCheckArgs, RenderArgs, SynthArgs, Usage, mapping, say,
};
use crate::config::Backend;
use crate::eval::{doctor as checks, evaluation, render, trajectory};
use crate::export::ply;
use crate::geometry::onnx::check::Report;
use crate::geometry::onnx::model::Model;
use crate::map::checkpoint;
use crate::node;
use crate::source::synthetic::SynthSettings;
use crate::source::synthetic::record::write_recording;
use crate::splat::Splats;

pub(super) fn synth(args: &SynthArgs) -> anyhow::Result<ExitCode> {
    let mut settings = SynthSettings::parse(&args.scene)?;
    let flags = [
        ("frames", args.frames.map(|v| v.to_string())),
        ("width", args.width.map(|v| v.to_string())),
        ("height", args.height.map(|v| v.to_string())),
        ("fov", args.fov.map(|v| v.to_string())),
        ("lens", args.lens.clone()),
        ("seed", args.seed.map(|v| v.to_string())),
    ];
    for (key, value) in flags {
        if let Some(value) = value {
            settings.set(key, &value)?;
        }
    }
    for option in &args.set {
        let (key, value) = option
            .split_once('=')
            .ok_or_else(|| Usage(format!("--set {option} is not key=value")))?;
        settings.set(key, value)?;
    }
    let summary = write_recording(&settings, &args.out)?;
    say(format!(
        "{} frames, {} messages, {:.1} MB: {}",
        summary.n_frames,
        summary.n_messages,
        summary.bytes as f64 * 1e-6,
        args.out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

pub(super) fn eval(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let evaluation = evaluation::evaluate(&args.run_dir, &args.reference)?;
    if args.json {
        say(serde_json::to_string_pretty(&evaluation)?);
    } else {
        say(evaluation);
    }
    Ok(ExitCode::SUCCESS)
}

pub(super) fn render(args: &RenderArgs) -> anyhow::Result<ExitCode> {
    let backend = match args.backend.as_str() {
        "auto" => Backend::Auto,
        "cpu" => Backend::Cpu,
        "wgpu" => Backend::Wgpu,
        other => return Err(Usage(format!("--backend {other} is none of auto, wgpu, cpu")).into()),
    };
    let splats = read_map(&args.map)?;
    let intrinsics = render::read_intrinsics(&args.intrinsics)?;
    let poses: Vec<_> = trajectory::read_tum(&args.poses)?
        .into_iter()
        .map(|timed| (timed.stamp, timed.pose))
        .collect();
    let mut engine = node::engine(backend, true)?;
    let n = render::render_poses(
        &splats,
        engine.as_mut(),
        &poses,
        &intrinsics,
        &args.out,
        args.depth,
    )?;
    say(format!(
        "{n} pictures of {} splats: {}",
        splats.len(),
        args.out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

pub(super) fn export(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let splats = read_map(&args.map)?;
    match args.out.extension().and_then(|e| e.to_str()) {
        Some("ply") => ply::write(&splats, &args.out)?,
        other => bail!(
            "this build exports .ply, not {:?}: {}",
            other.unwrap_or(""),
            args.out.display()
        ),
    }
    say(format!("{} splats: {}", splats.len(), args.out.display()));
    Ok(ExitCode::SUCCESS)
}

pub(super) fn model_check(args: &ModelCheckArgs) -> anyhow::Result<ExitCode> {
    let params = mapping::settings(&args.params)?.params()?.onnx;
    let report = Report::of(Model::open(&args.file, &params)?, &params)?;
    if args.json {
        say(serde_json::to_string_pretty(&report)?);
    } else {
        say(&report);
    }
    if let Some(fault) = report.faults.first() {
        bail!(
            "the model's answers cannot be used, {} faults: {fault}: {}",
            report.faults.len(),
            args.file.display()
        );
    }
    Ok(ExitCode::SUCCESS)
}

pub(super) fn doctor() -> ExitCode {
    let found = checks::doctor();
    say(checks::format_checks(&found).trim_end());
    let is_missing = found
        .iter()
        .any(|check| check.state == checks::State::Missing);
    if is_missing {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}

fn read_map(path: &Path) -> anyhow::Result<Splats> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("ply") => Ok(ply::read(path)?),
        Some("splatmap") => {
            let checkpoint = checkpoint::read(path)?;
            Ok(std::sync::Arc::unwrap_or_clone(checkpoint.snapshot.splats))
        }
        _ => Err(Usage(format!(
            "a map is a .splatmap or .ply file: {}",
            path.display()
        )))
        .context("cannot read the map"),
    }
}
