//! The outcome of a run -> its directory: trajectories, map, checkpoint, report, log.
//!
//! Every file is written whole or not at all, and one that fails keeps none of the others from being written.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::Mutex;

use anyhow::Context;
use tracing_subscriber::filter::EnvFilter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, fmt as log_format};

use crate::eval::frames::{self, FrameRow, Source as Known};
use crate::eval::lpips::Lpips;
use crate::eval::report_json::{
    FrameCounts, KeyframeCounts, Latency, LoadShedding, Quality, Report, Resumed, SubmapEntry,
    Timing, TrackingFigures, percentile,
};
use crate::eval::trajectory::{TimedPose, write_tum};
use crate::machine::memory::peak_rss_mib;
use crate::node::job::{Activity, Outcome, Progress};
use crate::node::quality::{MeasuredViews, measure_quality};
use crate::node::save_map::{MapFile, SaveError, save_map};
use crate::node::top_view::top_view;
use crate::node::track_thread::TrackingSummary;
use crate::params::params::Params;
use crate::params::settings::{Settings, defaults};
use crate::report::comparisons::Comparison;
use crate::report::html::{ReportInputs, write_html};
use crate::report::pose_quality::write_health;
use crate::report::top_view::TopView;
use splat_slam::mapper::mapper::reports::SubmapReport;
use splat_types::splats::layout::map_sha256;
use splat_view::embedded;
use splat_view::view_map::Published;

/// Of a map that its report holds, before it is packed.
const MAX_WALK_BYTES: usize = 10 << 20;

/// Makes the directory and checks, before any work is done, that it can be written to.
pub fn prepare(out: &Path) -> anyhow::Result<()> {
    let probe = out.join(".writable");
    fs::create_dir_all(out)
        .and_then(|()| fs::write(&probe, b"x"))
        .and_then(|()| fs::remove_file(&probe))
        .with_context(|| {
            format!(
                "cannot write the run directory; name another with --out: {}",
                out.display()
            )
        })
}

/// Warnings alone to stderr, for commands whose result is one line.
pub fn start_warnings() -> anyhow::Result<()> {
    let is_terminal = std::io::IsTerminal::is_terminal(&std::io::stderr());
    let layer = log_format::layer()
        .with_writer(std::io::stderr)
        .with_ansi(is_terminal)
        .with_target(false)
        .with_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn")));
    let registry = tracing_subscriber::registry().with(layer);
    registry.try_init().context("the log is already in use")
}

/// Log lines go to `run.log` and to stderr; a terminal with a progress bar gets warnings only.
pub fn start_log(out: Option<&Path>, is_terminal: bool) -> anyhow::Result<()> {
    let filter = |level: &str| {
        EnvFilter::try_from_default_env()
            .unwrap_or_else(|_| EnvFilter::new(format!("warn,splat_={level}")))
    };
    let stderr = log_format::layer()
        .with_writer(std::io::stderr)
        .with_ansi(is_terminal)
        .with_target(false)
        .with_filter(filter(if is_terminal { "warn" } else { "info" }));
    let file = match out {
        None => None,
        Some(out) => {
            let path = out.join("run.log");
            let file = fs::File::create(&path)
                .with_context(|| format!("cannot write the log: {}", path.display()))?;
            let layer = log_format::layer()
                .with_writer(Mutex::new(file))
                .with_ansi(false)
                .with_target(false);
            Some(layer.with_filter(filter("info")))
        }
    };
    // A second start in one process (tests) keeps the first log.
    tracing_subscriber::registry()
        .with(stderr)
        .with(file)
        .try_init()
        .ok();
    Ok(())
}

/// Writes the directory and measures quality; returns what to show the user. The map and the poses are written first: what was
/// gathered must not wait for figures.
pub fn finish(
    outcome: &mut Outcome,
    settings: &Settings,
    lpips: Option<Lpips>,
    (out, input): (Option<&Path>, &str),
    on_progress: &mut dyn FnMut(Progress),
) -> anyhow::Result<String> {
    let params = settings.params()?;
    let tracks = &outcome.tracking.tracks.frames;
    let keyframes = timed_keyframes(outcome);
    let rows = frames::rows(&keyframes, tracks, &outcome.input.frame_stamps);
    let written = out.map_or(Ok(()), |out| write_map(outcome, (&keyframes, &rows), out));
    let from_above = out.and_then(|_| top_view(outcome, &params.grid));
    let (quality, comparisons) = match out {
        Some(_) => quality_at_end(outcome, &params, lpips, on_progress),
        None => (Quality::default(), Vec::new()),
    };
    let report = Report {
        tracking: tracking_figures(&outcome.tracking, &rows),
        ..report(outcome, settings, quality)
    };
    let reported = out.map_or(Ok(()), |out| {
        let poses = (&keyframes[..], &rows[..]);
        let shown = (&report, &comparisons[..], from_above.as_ref());
        write_report(outcome, shown, poses, (out, input))
    });
    written.and(reported)?;
    Ok(summary(&report, out))
}

fn write_map(
    outcome: &mut Outcome,
    (keyframes, rows): (&[TimedPose], &[FrameRow]),
    out: &Path,
) -> anyhow::Result<()> {
    let health = outcome.map.health();
    let landmarks = std::mem::take(&mut outcome.tracking.landmarks);
    let checkpoint = outcome.map.checkpoint(landmarks);
    let live = frames::live_trajectory(&outcome.tracking.tracks.frames);
    let results: [anyhow::Result<()>; 8] = [
        save(MapFile::Checkpoint(&checkpoint), &out.join("map.splatmap")),
        save(MapFile::Ply(&outcome.snapshot.splats), &out.join("map.ply")),
        write_tum(keyframes, &out.join("keyframes.tum")).map_err(Into::into),
        write_health(&health, &out.join("keyframes.csv")).map_err(Into::into),
        write_tum(&frames::trajectory(rows), &out.join("trajectory.tum")).map_err(Into::into),
        write_tum(&live, &out.join("trajectory_live.tum")).map_err(Into::into),
        frames::write_frames(rows, &out.join("frames.csv")).map_err(Into::into),
        write_submaps(outcome, out),
    ];
    results.into_iter().collect()
}

/// Splats of submaps that are not the map, each in a frame of its own.
fn write_submaps(outcome: &Outcome, out: &Path) -> anyhow::Result<()> {
    let reports = outcome.map.submap_reports().into_iter();
    let parked = reports.filter_map(|submap| Some((submap.id, submap.parked?)));
    parked
        .filter(|(_, parked)| !parked.splats.is_empty())
        .try_for_each(|(id, parked)| save(MapFile::Ply(&parked.splats), &out.join(submap_file(id))))
}

fn submap_file(id: u32) -> String {
    format!("submap_{id}.ply")
}

fn submap_entries(outcome: &Outcome) -> Vec<SubmapEntry> {
    let entry = |submap: SubmapReport| {
        let parked = submap.parked.map_or(0, |parked| parked.splats.len());
        let (n_splats, file) = if submap.is_active {
            let n_splats = outcome.snapshot.splats.len();
            (n_splats, "map.ply".to_owned())
        } else {
            (parked, submap_file(submap.id))
        };
        SubmapEntry {
            id: u64::from(submap.id),
            keyframes: submap.n_keyframes as u64,
            splats: n_splats as u64,
            file: (n_splats > 0).then_some(file),
            active: submap.is_active,
        }
    };
    outcome
        .map
        .submap_reports()
        .into_iter()
        .map(entry)
        .collect()
}

fn write_report(
    outcome: &Outcome,
    (report, comparisons, top_view): (&Report, &[Comparison], Option<&TopView>),
    (keyframes, rows): (&[TimedPose], &[FrameRow]),
    (out, input): (&Path, &str),
) -> anyhow::Result<()> {
    let truth = outcome.input.truth.iter().map(|(stamp, pose)| TimedPose {
        stamp: *stamp,
        pose: *pose,
    });
    let truth: Vec<TimedPose> = truth.collect();
    let published = Published::at_first_keyframe(Arc::clone(&outcome.snapshot));
    let has_splats = !outcome.snapshot.splats.is_empty();
    let walk = has_splats.then(|| embedded::frames(&published, input, MAX_WALK_BYTES));
    let walk = walk.flatten();
    let page = ReportInputs {
        title: input,
        report,
        defaults: &defaults(),
        comparisons,
        loss: outcome.map.loss_curve(),
        psnr: &[],
        keyframes,
        trajectory: &frames::trajectory(rows),
        reference: &truth,
        walk: walk.as_deref(),
        top_view,
    };
    let results: [anyhow::Result<()>; 2] = [
        report.write(&out.join("report.json")).map_err(Into::into),
        write_html(&page, &out.join("report.html")).map_err(Into::into),
    ];
    results.into_iter().collect()
}

/// A map of an earlier run that stays, since this one has no splats, is no failure of this one's directory.
fn save(file: MapFile<'_>, path: &Path) -> anyhow::Result<()> {
    match save_map(file, path) {
        Err(kept @ SaveError::Empty { .. }) => {
            tracing::warn!("{kept}");
            Ok(())
        }
        saved => Ok(saved?),
    }
}

fn report(outcome: &Outcome, settings: &Settings, quality: Quality) -> Report {
    let snapshot = &outcome.snapshot;
    let parameters: BTreeMap<String, serde_json::Value> = settings
        .entries()
        .map(|(key, value)| (key.to_owned(), value.clone()))
        .collect();
    let optimise = outcome.secs.optimise;
    let steps = outcome.map.n_steps();
    Report {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        frames: FrameCounts::of(&outcome.input.counts, outcome.input.n_dropped),
        keyframes: KeyframeCounts {
            selected: outcome.input.n_selected as u64,
            registered: outcome.own_poses().len() as u64,
            before: outcome.map.continuation().map_or(0, |c| c.keyframes as u64),
            submaps: outcome.map.submaps().len() as u64,
        },
        submaps: submap_entries(outcome),
        splats: snapshot.splats.len() as u64,
        steps,
        adapter: outcome.map.adapter(),
        seed: parameters
            .get("seed")
            .and_then(serde_json::Value::as_u64)
            .unwrap_or_default(),
        map_sha256: map_sha256(&snapshot.splats),
        timing_s: Timing {
            wall: outcome.secs.wall,
            decode: outcome.secs.decode,
            geometry: outcome.secs.geometry,
            optimise,
            track: outcome.secs.track,
        },
        steps_per_s: (steps > 0 && optimise > 0.0).then(|| steps as f64 / optimise),
        latency_ms: Latency::of(
            &outcome.latency.to_pose_secs,
            &outcome.latency.to_snapshot_secs,
            &outcome.tracking.latency_secs,
        ),
        load_shed: {
            let known = &outcome.latency.load_shed;
            LoadShedding {
                hurried_keyframes: known.hurried_keyframes,
                unsought_keyframes: known.unsought_keyframes,
                depth_s: known.depth_secs,
                steps_s: known.steps_secs,
            }
        },
        tracking: TrackingFigures::default(),
        peak_rss_mib: peak_rss_mib(),
        peak_gpu_mib: match outcome.map.peak_gpu_bytes() {
            0 => None,
            n_bytes => Some(n_bytes as f64 / (1 << 20) as f64),
        },
        quality,
        quality_at: outcome.quality_at.clone(),
        budgets: outcome.map.budgets(),
        resume_report: outcome.map.continuation().map(|c| Resumed {
            map_keyframes: c.keyframes as u64,
            asked: c.asked as u64,
            found: c.found as u64,
            joined: c.is_joined,
        }),
        scale: snapshot.scale.into(),
        source_fault: outcome.input.counts.fault.clone(),
        geometry_note: outcome.geometry_note.clone(),
        engine_faults: outcome.n_engine_faults,
        error: outcome.error.clone(),
        parameters,
    }
}

/// The figures and the images for the report; a fault of the engine leaves none.
fn quality_at_end(
    outcome: &mut Outcome,
    params: &Params,
    mut lpips: Option<Lpips>,
    on_progress: &mut dyn FnMut(Progress),
) -> (Quality, Vec<Comparison>) {
    let views = MeasuredViews {
        holdout_every: params.map.holdout,
        max_train: params.eval.train_views,
        was_stopped: outcome.was_stopped,
    };
    let progress = outcome.progress();
    let mut on_view = |done, of| {
        let activity = Activity::Quality { done, of };
        on_progress(Progress {
            activity,
            ..progress
        });
    };
    let measured = measure_quality(&mut outcome.map, views, &mut lpips, &mut on_view);
    measured.unwrap_or_else(|error| {
        tracing::error!("engine: {error}; quality is not measured");
        // Of a run that has failed before, the first reason counts.
        outcome.error.get_or_insert(format!("engine: {error}"));
        (Quality::default(), Vec::new())
    })
}

/// Of this run: those of a saved map have stamps of another recording.
fn timed_keyframes(outcome: &Outcome) -> Vec<TimedPose> {
    let timed = |pose: &splat_types::snapshot::KeyframePose| TimedPose {
        stamp: pose.stamp,
        pose: pose.world_from_cam,
    };
    outcome.own_poses().iter().map(timed).collect()
}

/// `rows` are those of the same run.
pub(crate) fn tracking_figures(tracking: &TrackingSummary, rows: &[FrameRow]) -> TrackingFigures {
    let n_known = |wanted: &[Known]| {
        let found = rows.iter().filter(|row| wanted.contains(&row.source));
        found.count() as u64
    };
    let work_ms = |share| percentile(&tracking.frame_secs, share).map(|secs| secs * 1e3);
    TrackingFigures {
        frames: tracking.tracks.n_frames,
        dropped: tracking.n_dropped,
        tracked: tracking.tracks.n_tracked,
        posed: n_known(&[Known::Keyframe, Known::Tracked, Known::Late]),
        interpolated: n_known(&[Known::Interpolated]),
        lost: tracking.tracks.n_lost,
        relocalised: tracking.tracks.n_relocalised,
        fitted: tracking.tracks.n_fitted,
        work_ms_p50: work_ms(0.5),
        work_ms_p95: work_ms(0.95),
    }
}

fn summary(report: &Report, out: Option<&Path>) -> String {
    let keyframes = &report.keyframes;
    let quality = report
        .quality
        .psnr_holdout
        .map(|psnr| format!(", {psnr:.2} dB on held-out views"))
        .unwrap_or_default();
    let place = out
        .map(|out| format!(": {}", out.join("report.html").display()))
        .unwrap_or_default();
    format!(
        "{} of {} keyframes in {} submap(s), {} splats, {} steps in {:.0} s{quality}{place}",
        keyframes.registered,
        keyframes.selected,
        keyframes.submaps,
        report.splats,
        report.steps,
        report.timing_s.wall
    )
}
