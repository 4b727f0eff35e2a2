//! `report.html`: one file that shows a run to people: figures, renders beside photos, curves, path, times.
//!
//! Self-contained: images are embedded, nothing is fetched, and there is no script but the viewer's where a small map is embedded, begun by a
//! button; the page says so to the browser by its content policy. All text goes through maud and is escaped.

use std::collections::BTreeMap;
use std::path::Path;

use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::Value;

use crate::eval::alignment::align;
use crate::eval::error::{EvalError, write_atomically};
use crate::eval::evaluation::{Evaluation, compare};
use crate::eval::numbers::{count, decibels, figure, mebibytes, milliseconds, ordinal};
use crate::eval::report_json::{Quality, Report};
use crate::eval::trajectory::{TOLERANCE_SECS, TimedPose, associate};
use crate::report::charts::{Curve, Paths, View, bars, curve_chart, trajectory_chart};
use crate::report::comparisons::{Comparison, comparisons};
use crate::report::top_view::{self, TopView};
use crate::report::walk;
use splat_types::transform::Rigid;

/// What the page shows; empty lists leave their section out.
#[derive(Debug, Clone, Copy)]
pub struct ReportInputs<'a> {
    /// For example the name of the recording.
    pub title: &'a str,
    pub report: &'a Report,
    /// Defaults of the parameters by dotted key.
    pub defaults: &'a BTreeMap<String, Value>,
    /// At most twelve are shown, held-out views first, even over the run.
    pub comparisons: &'a [Comparison],
    /// (step, mean training loss).
    pub loss: &'a [(u64, f64)],
    /// (step, dB).
    pub psnr: &'a [(u64, f64)],
    /// `world_from_cam` of the keyframes, in order of time.
    pub keyframes: &'a [TimedPose],
    /// The same of every frame.
    pub trajectory: &'a [TimedPose],
    /// Truth in a frame of its own; it is aligned to the keyframes here.
    pub reference: &'a [TimedPose],
    /// Messages of the viewer; `None` where the map is too large, or has no splats.
    pub walk: Option<&'a [u8]>,
    /// `None` where no ground was seen.
    pub top_view: Option<&'a TopView>,
}

pub fn write_html(inputs: &ReportInputs<'_>, path: &Path) -> Result<(), EvalError> {
    let page =
        page(inputs).map_err(|e| EvalError::writing("the images of the report", &e, path))?;
    write_atomically("the report page", page.into_string().as_bytes(), path)
}

fn page(inputs: &ReportInputs<'_>) -> image::ImageResult<Markup> {
    let report = inputs.report;
    let evaluation =
        (!inputs.reference.is_empty()).then(|| compare(inputs.keyframes, inputs.reference));
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta http-equiv="Content-Security-Policy" content=(walk::policy(inputs.walk.is_some()));
                title { (inputs.title) " - splat-mapper report" }
                style { (PreEscaped(include_str!("report.css"))) }
            }
            body {
                main {
                    header {
                        h1 { (inputs.title) }
                        p.soft { "splat-mapper " (report.version) " · " (report.adapter) " · seed " (report.seed) }
                    }
                    (notices(report, evaluation.as_ref()))
                    (tiles(report, evaluation.as_ref()))
                    @if let Some(frames) = inputs.walk { (walk::section(frames)?) }
                    @if let Some(view) = inputs.top_view { (top_view::section(view)?) }
                    (comparisons(inputs.comparisons)?)
                    (curves(inputs))
                    (paths(inputs, evaluation.as_ref()))
                    (times(report))
                    (figures(report, evaluation.as_ref()))
                    (parameters(report, inputs.defaults))
                }
            }
        }
    })
}

/// What a reader must not miss, worst first.
fn notices(report: &Report, evaluation: Option<&Evaluation>) -> Markup {
    let missing = report
        .keyframes
        .selected
        .saturating_sub(report.keyframes.registered);
    let lost = [
        (
            report.frames.dropped,
            "dropped because mapping could not keep up",
        ),
        (report.frames.undecodable, "could not be decoded"),
        (
            report.frames.out_of_order,
            "came out of order and were left out",
        ),
    ];
    html! {
        @if let Some(error) = &report.error { p.notice.bad { "The run failed: " (error) } }
        @if let Some(fault) = &report.source_fault { p.notice.bad { "The input ended early: " (fault) } }
        @if missing > 0 { p.notice.warn { (count(missing)) " of " (count(report.keyframes.selected)) " keyframes have no pose." } }
        @if let Some(note) = &report.geometry_note { p.notice.warn { "Geometry: " (note) } }
        @if report.keyframes.submaps > 1 {
            p.notice.warn { "The keyframes fell into " (report.keyframes.submaps) " groups without a known relation; the map is the largest that was mapped." (other_submaps(report)) }
        }
        @for (n, what) in lost {
            @if n > 0 { p.notice.warn { (count(n)) " of " (count(report.frames.received)) " frames " (what) "." } }
        }
        @if let Some(note) = evaluation.and_then(|evaluation| evaluation.note.as_ref()) { p.notice.warn { "Reference: " (note) "." } }
    }
}

/// What became of the groups that are not the map.
fn other_submaps(report: &Report) -> String {
    let others = report.submaps.iter().filter(|submap| !submap.active);
    let files = others.filter_map(|submap| {
        let (file, n) = (submap.file.as_ref()?, count(submap.splats));
        Some(format!(
            "{file} ({} keyframes, {n} splats)",
            count(submap.keyframes)
        ))
    });
    match files.collect::<Vec<_>>().join(", ") {
        files if files.is_empty() => String::new(),
        files => format!(" Others are mapped, each in a frame of its own: {files}."),
    }
}

fn tiles(report: &Report, evaluation: Option<&Evaluation>) -> Markup {
    let quality = &report.quality;
    let tile = |name: &str, value: String, more: String| {
        html! { div.card.tile { span.name { (name) } b { (value) } span.soft { (more) } } }
    };
    let held_out = format!(
        "SSIM {}; every {} keyframe held out",
        figure(quality.ssim_holdout),
        ordinal(quality.holdout_every)
    );
    let steps = format!(
        "after {} steps, {} per second",
        count(report.steps),
        figure(report.steps_per_s)
    );
    html! {
        section.tiles {
            @if quality.holdout_every > 0 {
                (tile("Held-out PSNR", format!("{} dB", decibels(quality.psnr_holdout)), held_out))
            } @else {
                (tile("Training PSNR", format!("{} dB", decibels(quality.psnr_train)), "no view was held out".to_owned()))
            }
            @if let Some(evaluation) = evaluation {
                (tile("Trajectory error", format!("{} %", figure(evaluation.ate_percent_of_extent)),
                    format!("of the extent; rotation {}° mean", figure(evaluation.rotation_mean_deg))))
            }
            (tile("Keyframes registered", format!("{} of {}", count(report.keyframes.registered), count(report.keyframes.selected)),
                format!("from {} frames", count(report.frames.received))))
            (tile("Splats", count(report.splats), steps))
            (tile("Wall time", format!("{} s", figure(Some(report.timing_s.wall))), format!("optimising {} s", figure(Some(report.timing_s.optimise)))))
            (tile("Keyframe to pose", milliseconds(report.latency_ms.keyframe_to_pose_p50),
                format!("median; 95 % within {}", milliseconds(report.latency_ms.keyframe_to_pose_p95))))
        }
    }
}

fn curves(inputs: &ReportInputs<'_>) -> Markup {
    let loss = curve_chart(&Curve {
        title: "Training loss",
        unit: "",
        points: inputs.loss,
        from_zero: true,
    });
    let psnr = curve_chart(&Curve {
        title: "PSNR",
        unit: "dB",
        points: inputs.psnr,
        from_zero: false,
    });
    html! {
        @if loss.is_some() || psnr.is_some() {
            section {
                h2 { "Optimisation" }
                div.two {
                    @if let Some(chart) = loss { div.card { h3 { "Training loss" } (chart) } }
                    @if let Some(chart) = psnr { div.card { h3 { "PSNR in dB" } (chart) } }
                }
            }
        }
    }
}

fn paths(inputs: &ReportInputs<'_>, evaluation: Option<&Evaluation>) -> Markup {
    let reference = reference_in_world(inputs.keyframes, inputs.reference);
    let paths = Paths {
        keyframes: inputs.keyframes,
        frames: inputs.trajectory,
        reference: &reference,
    };
    let charts = (
        trajectory_chart(&paths, View::Above),
        trajectory_chart(&paths, View::Side),
    );
    let (Some(above), Some(side)) = charts else {
        return html! {};
    };
    let unit = if inputs.report.scale.metres_per_unit == Some(1.0) {
        "metres"
    } else {
        "map units (scale unknown)"
    };
    html! {
        section {
            h2 { "Trajectory" }
            div.two {
                div.card { h3 { "From above" } (above) }
                div.card { h3 { "From the side" } (side) }
            }
            p.legend {
                span { i.dot {} "keyframes, with viewing direction" }
                span { i {} @if inputs.trajectory.len() > 1 { "all frames" } @else { "path" } }
                @if !reference.is_empty() { span { i.b {} "reference, aligned" } }
                span { "in " (unit) }
            }
            @if let Some(evaluation) = evaluation.filter(|evaluation| evaluation.ate_rmse.is_some()) {
                p.soft {
                    "Over " (evaluation.registered) " keyframes with a reference: ATE " (figure(evaluation.ate_rmse)) " RMSE in units of the reference, after one Sim(3) alignment "
                    "(scale " (figure(evaluation.aligned_scale)) "); from keyframe to keyframe " (figure(evaluation.rpe_translation)) " and " (figure(evaluation.rpe_rotation_deg)) "°."
                }
            }
        }
    }
}

fn times(report: &Report) -> Markup {
    let timing = &report.timing_s;
    let seconds = |value: f64| format!("{} s", figure(Some(value)));
    let rows = [
        ("decode", timing.decode),
        ("geometry", timing.geometry),
        ("optimise", timing.optimise),
        ("wall", timing.wall),
    ];
    let rows = rows.map(|(name, value)| (name, value, seconds(value)));
    html! {
        section {
            h2 { "Time" }
            div.card {
                (bars(&rows, timing.wall))
                p.soft style="margin:12px 0 0" { "Stages run side by side, so they need not add up to the wall time." }
            }
        }
    }
}

fn figures(report: &Report, evaluation: Option<&Evaluation>) -> Markup {
    let (frames, latency, scale) = (&report.frames, &report.latency_ms, &report.scale);
    let mut rows = vec![
        ("frames received", count(frames.received)),
        ("frames dropped", count(frames.dropped)),
        ("frames undecodable", count(frames.undecodable)),
        ("frames out of order", count(frames.out_of_order)),
        ("keyframes selected", count(report.keyframes.selected)),
        ("keyframes registered", count(report.keyframes.registered)),
        ("components", count(report.keyframes.submaps)),
        (
            "keyframes hurried",
            count(report.load_shed.hurried_keyframes),
        ),
        (
            "keyframes not compared with places of long ago",
            count(report.load_shed.unsought_keyframes),
        ),
        (
            "depth and steps waited for poses",
            format!(
                "{:.1} s, {:.1} s",
                report.load_shed.depth_s, report.load_shed.steps_s
            ),
        ),
    ];
    rows.extend(quality_figures(&report.quality));
    rows.extend([
        (
            "keyframe to pose, 50 % and 95 %",
            format!(
                "{}, {}",
                milliseconds(latency.keyframe_to_pose_p50),
                milliseconds(latency.keyframe_to_pose_p95)
            ),
        ),
        (
            "keyframe to snapshot, 50 % and 95 %",
            format!(
                "{}, {}",
                milliseconds(latency.keyframe_to_snapshot_p50),
                milliseconds(latency.keyframe_to_snapshot_p95)
            ),
        ),
        ("peak memory", mebibytes(report.peak_rss_mib)),
        ("peak GPU memory", mebibytes(report.peak_gpu_mib)),
        ("scale", scale.source.replace('_', " ")),
        ("metres per unit", figure(scale.metres_per_unit)),
        ("SHA-256 of map.ply", report.map_sha256.clone()),
    ]);
    if let Some(evaluation) = evaluation {
        rows.push(("reference poses", count(evaluation.reference as u64)));
    }
    html! {
        section {
            h2 { "All figures" }
            div.card.columns { table { @for (name, value) in &rows { tr { th scope="row" { (name) } td.num { (value) } } } } }
        }
    }
}

fn quality_figures(quality: &Quality) -> [(&'static str, String); 6] {
    [
        (
            "PSNR of training views",
            format!("{} dB", decibels(quality.psnr_train)),
        ),
        (
            "PSNR of held-out views",
            format!("{} dB", decibels(quality.psnr_holdout)),
        ),
        ("SSIM of held-out views", figure(quality.ssim_holdout)),
        (
            "right halves of held-out views, PSNR and SSIM",
            format!(
                "{} dB, {}",
                decibels(quality.psnr_holdout_half),
                figure(quality.ssim_holdout_half)
            ),
        ),
        (
            "the same with the exposure of the left halves",
            format!(
                "{} dB, {}",
                decibels(quality.psnr_holdout_exposed),
                figure(quality.ssim_holdout_exposed)
            ),
        ),
        ("LPIPS of held-out views", figure(quality.lpips_holdout)),
    ]
}

/// Those that differ from their defaults stand first and open.
fn parameters(report: &Report, defaults: &BTreeMap<String, Value>) -> Markup {
    let is_default = |key: &str, value: &Value| defaults.get(key).is_some_and(|v| same(v, value));
    let (unchanged, changed): (Vec<_>, Vec<_>) = report
        .parameters
        .iter()
        .partition(|(key, value)| is_default(key, value));
    let rows = |rows: &[(&String, &Value)]| {
        html! { @for (key, value) in rows { tr { th scope="row" { code { (key) } } td.num { code { (value) } } } } }
    };
    html! {
        @if !report.parameters.is_empty() {
            section {
                h2 { "Parameters" }
                div.card {
                    @if changed.is_empty() { p.soft { "All as shipped." } }
                    @else { p.soft { "Changed from the shipped values:" } table.changed { (rows(&changed)) } }
                    details {
                        summary { "The other " (unchanged.len()) ", as shipped" }
                        div.columns { table { (rows(&unchanged)) } }
                    }
                }
            }
        }
    }
}

/// 10 and 10.0 are one value.
fn same(a: &Value, b: &Value) -> bool {
    a == b || a.as_f64().zip(b.as_f64()).is_some_and(|(a, b)| a == b)
}

/// The reference in the frame of the map; empty when it cannot be aligned.
fn reference_in_world(keyframes: &[TimedPose], reference: &[TimedPose]) -> Vec<Rigid> {
    let pairs = associate(keyframes, reference, TOLERANCE_SECS);
    let estimated: Vec<Rigid> = pairs.iter().map(|&(ix, _)| keyframes[ix].pose).collect();
    let truth: Vec<Rigid> = pairs.iter().map(|&(_, ix)| reference[ix].pose).collect();
    let Ok(alignment) = align(&estimated, &truth) else {
        return Vec::new();
    };
    let world_from_reference = alignment.reference_from_estimate.inverse();
    reference
        .iter()
        .map(|timed| world_from_reference.transform_pose(&timed.pose))
        .collect()
}
