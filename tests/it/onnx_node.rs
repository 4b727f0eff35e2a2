//! The whole program with a model that knows the truth, and the commands around models.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use crate::graphs::library;
use crate::ground_truth::{batch, numbered};
use crate::onnx_models::{Computing, description, foundation, open, saved, truthful};
use crate::pair_matches::check;
use splat_geometry::answer::{PairMatches, View};
use splat_geometry::model::GeometryModel as _;
use splat_mapper::eval::trajectory::{TimedPose, read_tum};
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_types::frame::Frame;
use splat_types::transform::{Rigid, extent};

const DEMO: &str = "recordings/demo.mcap";
/// f32 poses, and f32 depths whose ratio gives the scale.
const MAX_OFF: f64 = 1e-4;

fn demo() -> Vec<Frame> {
    let params = Settings::shipped().params().unwrap().source;
    let mut source = open_source::open(DEMO, &params, 0).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}

fn program(library: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args(args).env("ORT_DYLIB_PATH", library);
    command.output().unwrap()
}

fn errors(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Keyframes of a replay of the demo whose poses are left as geometry gave them, and its report.
fn replayed(library: &Path, geometry: &str, out: &Path) -> (Vec<TimedPose>, Value) {
    let out_dir = out.to_str().unwrap();
    let args = ["replay", DEMO, "--geometry", geometry, "--out", out_dir];
    let few = ["--backend", "cpu", "--steps", "10", "--holdout", "0"];
    let settings = [
        "train.pose_opt=fixed",
        // Exact poses can only get worse.
        "align.method=off",
        "train.max_side=160",
        "train.seeds_per_keyframe=100",
        "mvs.backend=cpu",
    ];
    let settings = settings.iter().flat_map(|s| ["--set", s]);
    let more: Vec<&str> = few.into_iter().chain(settings).collect();
    let output = program(library, &[&args[..], &more].concat());
    assert!(output.status.success(), "{}", errors(&output));
    let report = std::fs::read(out.join("report.json")).unwrap();
    let keyframes = read_tum(&out.join("keyframes.tum")).unwrap();
    (keyframes, serde_json::from_slice(&report).unwrap())
}

/// Each pose from the first.
fn from_first(poses: impl Iterator<Item = Rigid>) -> Vec<Rigid> {
    let poses: Vec<Rigid> = poses.collect();
    poses
        .iter()
        .map(|pose| poses[0].inverse() * *pose)
        .collect()
}

/// Largest shift as a share of the extent, and largest turn.
fn largest_off(a: &[Rigid], b: &[Rigid]) -> (f64, f64) {
    let places: Vec<_> = a.iter().map(|pose| pose.translation).collect();
    let pairs = || a.iter().zip(b);
    let shift = pairs().map(|(a, b)| a.translation.distance(b.translation));
    let turn = pairs().map(|(a, b)| a.angle_to(b));
    (
        shift.fold(0.0, f64::max) / extent(&places),
        turn.fold(0.0, f64::max),
    )
}

#[test]
fn a_model_that_knows_the_truth_maps_the_demo_as_known_poses_do() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let model = truthful(folder.path(), &demo());
    let geometry = format!("onnx:{}", model.display());
    let (by_model, report) = replayed(&library, &geometry, &folder.path().join("onnx"));
    let (by_truth, known) = replayed(&library, "ground_truth", &folder.path().join("known"));
    let stamps = |poses: &[TimedPose]| -> Vec<_> { poses.iter().map(|p| p.stamp).collect() };
    assert_eq!(stamps(&by_model), stamps(&by_truth));
    assert!(by_model.len() > 20, "{}", by_model.len());
    let poses = |all: &[TimedPose]| from_first(all.iter().map(|timed| timed.pose));
    let (shift, turn) = largest_off(&poses(&by_truth), &poses(&by_model));
    eprintln!("off by {shift:.1e} of the extent and {turn:.1e} rad");
    assert!(shift < MAX_OFF && turn < MAX_OFF, "{shift} {turn}");
    assert_eq!(report["keyframes"], known["keyframes"]);
    let splats = |report: &Value| report["splats"].as_f64().unwrap();
    let ratio = splats(&report) / splats(&known);
    // Which pixels get seeds depends on the errors left at that moment.
    assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
    let psnr = |report: &Value| report["quality"]["psnr_train"].as_f64().unwrap();
    assert!((psnr(&report) - psnr(&known)).abs() < 0.3);
    assert_eq!(report["scale"]["source"], "depth");
    assert!(
        report["geometry_note"].is_null(),
        "{}",
        report["geometry_note"]
    );
}

#[test]
fn windows_within_a_batch_are_joined_as_one_window_would_be() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<Frame> = demo().into_iter().step_by(8).take(10).collect();
    let model = truthful(folder.path(), &frames);
    let views = |window: &str| -> Vec<View> {
        let setting = format!("onnx.window={window}");
        let settings = [&setting[..], "align.method=off"];
        let mut model = foundation(open(&library, &model).unwrap(), &settings);
        let numbered = numbered(&frames, false);
        let mut views = model.infer(&batch(0, 0, &numbered[..7])).unwrap().views;
        views.extend(model.infer(&batch(1, 3, &numbered[4..])).unwrap().views);
        views
    };
    let poses = |views: &[View]| from_first(views.iter().map(|view| view.submap_from_cam));
    let truth = from_first(frames.iter().map(|frame| frame.truth.unwrap()));
    for window in ["16", "3", "2"] {
        let views = views(window);
        let ids: Vec<u32> = views.iter().map(|view| view.keyframe_id).collect();
        assert_eq!(ids, (0..10).collect::<Vec<_>>(), "window {window}");
        let (shift, turn) = largest_off(&truth, &poses(&views));
        assert!(
            shift < MAX_OFF && turn < MAX_OFF,
            "{window}: {shift} {turn}"
        );
        for (view, frame) in views.iter().zip(&frames) {
            let truth = frame.sensor_depth.as_ref().unwrap();
            assert_eq!(view.depth.depth.len(), truth.depth.len());
            for (at, exact) in truth.depth.iter().enumerate() {
                if let Some((found, confidence)) = view.depth.verified(at) {
                    assert!((found / exact - 1.0).abs() < 1e-5 && confidence == 1.0);
                }
            }
            assert_eq!(
                view.intrinsics,
                frame.intrinsics.unwrap(),
                "the camera is calibrated"
            );
        }
    }
}

#[test]
fn a_model_reports_the_matches_of_its_windows() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<Frame> = demo().into_iter().step_by(8).take(10).collect();
    let model = truthful(folder.path(), &frames);
    let matches = |settings: &[&str]| {
        let mut model = foundation(open(&library, &model).unwrap(), settings);
        let numbered = numbered(&frames, false);
        let mut found = model
            .infer(&batch(0, 0, &numbered[..7]))
            .unwrap()
            .pair_matches;
        found.extend(
            model
                .infer(&batch(1, 3, &numbered[4..]))
                .unwrap()
                .pair_matches,
        );
        found
    };
    let found = matches(&[]);
    check(&found, &frames, "onnx");
    let with_last = |pair: &&PairMatches| pair.keyframe_ids[1] == 9;
    assert!(found.iter().any(|pair| with_last(&pair)));
    assert!(matches(&["align.method=off"]).is_empty());
}

fn checked(library: &Path, model: &Path, more: &[&str]) -> Output {
    let args = ["model", "check", model.to_str().unwrap()];
    program(library, &[&args[..], more].concat())
}

#[test]
fn model_check_reports_the_contract_and_times_windows() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let bytes = Computing::default().bytes();
    let model = saved(folder.path(), &bytes, &description(42, 28, 14));
    let output = checked(&library, &model, &["--json"]);
    assert!(output.status.success(), "{}", errors(&output));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(
        (&report["contract"], &report["family"]),
        (&1.into(), &"mock".into())
    );
    assert_eq!(
        (&report["width"], &report["s_max"]),
        (&42.into(), &8.into())
    );
    let timings = report["timings"].as_array().unwrap();
    let frames: Vec<u64> = timings
        .iter()
        .map(|t| t["frames"].as_u64().unwrap())
        .collect();
    assert_eq!(frames, [1, 2, 4, 8]);
    assert!(timings.iter().all(|t| t["secs"].as_f64().unwrap() > 0.0));
    assert_eq!(report["faults"], serde_json::json!([]));
    let text = checked(&library, &model, &["--set", "onnx.window=3"]);
    let text = String::from_utf8_lossy(&text.stdout).into_owned();
    assert!(
        text.contains("3 frames at once") && text.contains("can be used"),
        "{text}"
    );
}

#[test]
fn model_check_fails_with_one_line_for_a_model_that_cannot_be_used() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let check = |broken: &Computing, word: &str| {
        let model = saved(folder.path(), &broken.bytes(), &description(42, 28, 14));
        let output = checked(&library, &model, &[]);
        assert_eq!(output.status.code(), Some(1), "{word}");
        let text = errors(&output);
        assert!(
            text.lines().count() == 1 && text.contains(word),
            "{word}: {text}"
        );
    };
    let mut blind = Computing::default();
    blind.pose_bias[7] = -1.0;
    check(&blind, "field of view");
    let depth_weights = [f32::NAN; 3];
    check(
        &Computing {
            depth_weights,
            ..Computing::default()
        },
        "depth that is no number",
    );
    check(
        &Computing {
            n_pose: 7,
            ..Computing::default()
        },
        "[S, 9]",
    );
    let wrong = program(
        &library,
        &["model", "check", "x.onnx", "--set", "onnx.window=-1"],
    );
    assert_eq!(wrong.status.code(), Some(2), "{}", errors(&wrong));
}

fn replay_error(library: &Path, geometry: &str) -> String {
    let room = "synthetic:room?frames=4&width=96&height=72&speed=3";
    let output = program(
        library,
        &["replay", room, "--geometry", geometry, "--steps", "5"],
    );
    assert_eq!(output.status.code(), Some(1), "{geometry}");
    errors(&output)
        .lines()
        .last()
        .unwrap_or_default()
        .to_owned()
}

#[test]
fn a_run_without_a_model_or_with_a_broken_one_says_why_it_has_no_map() {
    let Some(library) = library() else { return };
    let gone = replay_error(&library, "onnx:gone.onnx");
    assert!(
        gone.contains("there is no model") && gone.ends_with("gone.onnx"),
        "{gone}"
    );
    let none = replay_error(Path::new("/nonexistent"), "onnx:gone.onnx");
    assert!(none.contains("pip install onnxruntime"), "{none}");
    let folder = tempfile::tempdir().unwrap();
    let depth_weights = [f32::NAN; 3];
    let broken = Computing {
        depth_weights,
        ..Computing::default()
    }
    .bytes();
    let model = saved(folder.path(), &broken, &description(42, 28, 14));
    let error = replay_error(&library, &format!("onnx:{}", model.display()));
    assert!(
        error.contains("no map") && error.contains("depth that is no number"),
        "{error}"
    );
}

#[test]
fn an_onnx_runtime_that_is_too_old_is_refused_with_the_way_out() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let old = with_version(&library, folder.path());
    let model = saved(
        folder.path(),
        &Computing::default().bytes(),
        &description(42, 28, 14),
    );
    let error = replay_error(&old, &format!("onnx:{}", model.display()));
    assert!(
        error.contains("1.24") && error.contains("pip install onnxruntime"),
        "{error}"
    );
}

/// The library with another version written into it: 1.3x becomes 1.1x.
fn with_version(library: &Path, folder: &Path) -> PathBuf {
    let mut bytes = std::fs::read(library).unwrap();
    let is_version = |w: &[u8]| {
        w[0] == 0
            && w[1..3] == *b"1."
            && w[5] == b'.'
            && w[7] == 0
            && w[3..5].iter().chain(&w[6..7]).all(u8::is_ascii_digit)
    };
    let at: Vec<usize> = (0..bytes.len() - 8)
        .filter(|i| is_version(&bytes[*i..*i + 8]))
        .collect();
    assert!(!at.is_empty(), "no version in {}", library.display());
    for i in at {
        bytes[i + 3] = b'1';
    }
    let old = folder.join("libonnxruntime.so");
    std::fs::write(&old, bytes).unwrap();
    old
}
