//! `synth`, `eval`, `render`, `export`, `model`, `doctor`: arguments -> one call each.

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, bail};

use crate::cli::{
    CompareArgs, EvalArgs, ExportArgs, ModelCheckArgs, RenderArgs, SynthArgs, Usage, mapping, say,
};
use crate::compare::rows::{Row, Shared};
use crate::compare::run::{self, Comparison};
use crate::compare::table;
use crate::doctor::check::State;
use crate::doctor::checks;
use crate::doctor::model_check::Report;
use crate::eval::{evaluation, render, trajectory};
use crate::formats::file::{self, SplatFormat};
use crate::formats::planner_map::{self, PlannerFile};
use crate::formats::scene::{self, SceneLayout};
use crate::formats::spz::SpzVersion;
use crate::node::engines::Engines;
use crate::node::run_dir;
use crate::node::save_map::{MapFile, save_map};
use splat_geometry::foundation::model::Model;
use splat_gpu::backend::Backend;
use splat_slam::mapper::map_file::checkpoint;
use splat_synth::layouts::{FolderLayout, write_folder};
use splat_synth::record::write_recording;
use splat_synth::settings::SynthSettings;
use splat_types::splats::splats::Splats;

pub(crate) fn synth(args: &SynthArgs) -> anyhow::Result<ExitCode> {
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
    if let Some(name) = &args.layout {
        return synth_folder(&settings, name, &args.out);
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

fn synth_folder(settings: &SynthSettings, name: &str, out: &Path) -> anyhow::Result<ExitCode> {
    let known = FolderLayout::NAMES.iter().find(|(known, _)| *known == name);
    let Some((_, layout)) = known else {
        let names = FolderLayout::NAMES.map(|(name, _)| name).join(", ");
        return Err(Usage(format!("--layout {name} is none of {names}")).into());
    };
    write_folder(settings, *layout, out, |_| {})?;
    say(format!(
        "{} images in the layout of {name}: {}",
        settings.n_frames,
        out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn eval(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let evaluation = evaluation::evaluate(&args.run_dir, &args.reference)?;
    if args.json {
        say(serde_json::to_string_pretty(&evaluation)?);
    } else {
        say(evaluation);
    }
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn compare(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let row = |name: &String| {
        let names = Row::ALL.map(Row::name).join(", ");
        let unknown = || Usage(format!("--rows {name} is none of {names}"));
        Row::by_name(name).ok_or_else(unknown)
    };
    let comparison = Comparison {
        scene: args.scene.clone(),
        out: args.out.clone(),
        rows: args.rows.iter().map(row).collect::<Result<_, _>>()?,
        shared: Shared {
            steps: args.steps,
            max_side: args.max_side,
            max_splats: args.max_splats,
            images: args.images,
            geometry: args.geometry.clone(),
            backend: args.backend.clone(),
            seed: args.seed,
            holdout: args.holdout,
            lpips_model: args.lpips.clone(),
        },
        reference: args.reference.clone(),
    };
    let rows = run::run(&comparison, &mut |line| {
        writeln!(std::io::stderr(), "{line}").ok();
    })?;
    if args.json {
        say(serde_json::to_string_pretty(&rows)?);
    } else {
        say(table::markdown(&rows));
    }
    let has_failed = rows.iter().any(|row| row.error.is_some());
    Ok(if has_failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

pub(crate) fn render(args: &RenderArgs) -> anyhow::Result<ExitCode> {
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
    let mut engine = Engines::default().best(backend, true)?;
    let n = render::render_poses(
        &splats,
        engine.as_mut(),
        &poses,
        &intrinsics,
        &args.out,
        args.depth,
    )?;
    say(format!(
        "{n} images of {} splats: {}",
        splats.len(),
        args.out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn export(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let is_folder = args.layout.is_some() || args.out.to_string_lossy().ends_with('/');
    if is_folder {
        return export_scene(args);
    }
    if let Some(file) = PlannerFile::of(&args.out) {
        return export_for_planners(args, file);
    }
    let splats = read_map(&args.map)?;
    let spz = match args.spz_version {
        3 => SpzVersion::V3,
        4 => SpzVersion::V4,
        other => return Err(Usage(format!("--spz-version {other} is neither 3 nor 4")).into()),
    };
    let Some(format) = SplatFormat::of(&args.out, spz) else {
        return Err(Usage(file::unknown_ending(&args.out)).into());
    };
    save_map(MapFile::As(format, &splats), &args.out)?;
    say(format!("{} splats: {}", splats.len(), args.out.display()));
    Ok(ExitCode::SUCCESS)
}

fn export_for_planners(args: &ExportArgs, file: PlannerFile) -> anyhow::Result<ExitCode> {
    let params = mapping::settings(&args.params)?.params()?.grid;
    let map = checkpoint::read(&args.map)?;
    let mut volume = planner_map::volume(&map, &params)?;
    let found = file.write(&map, &mut volume, &args.out)?;
    say(format!("{found}: {}", args.out.display()));
    Ok(ExitCode::SUCCESS)
}

fn export_scene(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let name = args.layout.as_deref().unwrap_or("colmap");
    let known = SceneLayout::NAMES.iter().find(|(known, _)| *known == name);
    let Some((_, layout)) = known else {
        let names = SceneLayout::NAMES.map(|(name, _)| name).join(", ");
        return Err(Usage(format!("--layout {name} is none of {names}")).into());
    };
    let map = checkpoint::read(&args.map)?;
    let n = scene::write(&map, *layout, &args.out)?;
    let left_out = map.snapshot.poses.len().saturating_sub(n);
    say(format!(
        "{n} images in the layout of {name}, {left_out} keyframes without an image left out: {}",
        args.out.display()
    ));
    Ok(ExitCode::SUCCESS)
}

pub(crate) fn model_check(args: &ModelCheckArgs) -> anyhow::Result<ExitCode> {
    let mut settings = mapping::settings(&args.params)?;
    let params = settings.params()?.onnx;
    run_dir::start_warnings()?;
    settings.log_warnings();
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

pub(crate) fn doctor() -> ExitCode {
    let found = checks::doctor();
    say(checks::format_checks(&found).trim_end());
    let is_missing = found.iter().any(|check| check.state == State::Missing);
    if is_missing {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}

fn read_map(path: &Path) -> anyhow::Result<Splats> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("ply" | "spz") => Ok(file::read(path)?),
        Some("splatmap") => {
            let checkpoint = checkpoint::read(path)?;
            Ok(std::sync::Arc::unwrap_or_clone(checkpoint.snapshot.splats))
        }
        _ => Err(Usage(format!(
            "a map is a .splatmap, .ply or .spz file: {}",
            path.display()
        )))
        .context("cannot read the map"),
    }
}
