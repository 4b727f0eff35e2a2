//! Foundation models through ONNX Runtime: good ones answer as a plain computation does, broken ones are refused at
//! start or lose what is broken.

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use serde_json::json;

use crate::graphs::library;
use crate::onnx_models::{
    CONFIDENCE_WEIGHTS, Computing, DEPTH_WEIGHTS, POSE_BIAS, POSE_WEIGHTS, description, open,
    params, saved,
};
use splat_geometry::answer::GeometryBatch;
use splat_geometry::foundation::decode::Answer;
use splat_geometry::foundation::estimator::FoundationModel;
use splat_geometry::model::GeometryModel as _;
use splat_types::frame::{Batch, Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};

const WIDTH: usize = 42;
const HEIGHT: usize = 28;
/// f32 sums of a few numbers in another order.
const CLOSE: f32 = 1e-5;

fn images(n: usize) -> Vec<f32> {
    let value = |i: usize| 0.5 + 0.4 * ((i % 1009) as f32 * 0.37).sin();
    (0..n * 3 * WIDTH * HEIGHT).map(value).collect()
}

/// What `Computing` computes, in plain Rust.
fn expected(planes: &[f32]) -> Answer {
    let n_pixels = WIDTH * HEIGHT;
    let n_frames = planes.len() / (3 * n_pixels);
    let mut answer = Answer {
        n_frames,
        width: WIDTH,
        height: HEIGHT,
        pose_enc: Vec::new(),
        depth: Vec::new(),
        depth_conf: Vec::new(),
    };
    for frame in planes.chunks_exact(3 * n_pixels) {
        let mean =
            |c: usize| frame[c * n_pixels..][..n_pixels].iter().sum::<f32>() / n_pixels as f32;
        let mean = [mean(0), mean(1), mean(2)];
        for (i, bias) in POSE_BIAS.iter().enumerate() {
            let sum: f32 = (0..3).map(|c| mean[c] * POSE_WEIGHTS[c][i]).sum();
            answer.pose_enc.push(sum + bias);
        }
        let weighted = |at: usize, weights: [f32; 3]| -> f32 {
            (0..3).map(|c| weights[c] * frame[c * n_pixels + at]).sum()
        };
        for at in 0..n_pixels {
            answer.depth.push(weighted(at, DEPTH_WEIGHTS).exp());
            answer
                .depth_conf
                .push(1.0 + weighted(at, CONFIDENCE_WEIGHTS).exp());
        }
    }
    answer
}

fn assert_close(found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!((a - b).abs() < CLOSE, "{i}: {a}, {b}");
    }
}

#[test]
fn a_model_of_the_contract_answers_for_any_number_of_frames() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let bytes = Computing::default().bytes();
    for norm in ["unit", "imagenet"] {
        let mut description = description(42, 28, 14);
        description["input_norm"] = norm.into();
        let mut model = open(&library, &saved(folder.path(), &bytes, &description)).unwrap();
        for n in [1, 2, 3, 7] {
            let images = images(n);
            let mut seen = images.clone();
            if norm == "imagenet" {
                let scale = [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)];
                for (i, value) in seen.iter_mut().enumerate() {
                    let (mean, deviation) = scale[i / (WIDTH * HEIGHT) % 3];
                    *value = (*value - mean) / deviation;
                }
            }
            let (found, expected) = (model.answer(images).unwrap(), expected(&seen));
            assert_eq!(
                (found.n_frames, found.width, found.height),
                (n, WIDTH, HEIGHT)
            );
            assert_close(&found.depth, &expected.depth);
            assert_close(&found.depth_conf, &expected.depth_conf);
            if norm == "unit" {
                assert_close(&found.pose_enc, &expected.pose_enc);
            }
        }
        let error = model.answer(vec![0.5; 100]).unwrap_err().to_string();
        assert!(error.contains("100 numbers"), "{error}");
    }
}

fn refusal(library: &Path, bytes: &[u8], description: &serde_json::Value) -> String {
    let folder = tempfile::tempdir().unwrap();
    let error = open(library, &saved(folder.path(), bytes, description)).unwrap_err();
    assert_eq!(error.lines().count(), 1, "{error}");
    error
}

#[test]
fn a_model_with_wrong_names_shapes_or_numbers_is_refused_at_start() {
    let Some(library) = library() else { return };
    let whole = || description(42, 28, 14);
    let cases: [(Computing, &str); 8] = [
        (
            Computing {
                names: ["pixels", "pose_enc", "depth", "depth_conf"],
                ..Computing::default()
            },
            "images f32",
        ),
        (
            Computing {
                names: ["images", "poses", "depth", "depth_conf"],
                ..Computing::default()
            },
            "no output pose_enc",
        ),
        (
            Computing {
                names: ["images", "pose_enc", "z", "depth_conf"],
                ..Computing::default()
            },
            "no output depth",
        ),
        (
            Computing {
                names: ["images", "pose_enc", "depth", "sure"],
                ..Computing::default()
            },
            "no output depth_conf",
        ),
        (
            Computing {
                n_pose: 7,
                ..Computing::default()
            },
            "[S, 9]",
        ),
        (
            Computing {
                sides: ["28", "56"],
                ..Computing::default()
            },
            "[S, 3, 28, 42]",
        ),
        (
            Computing {
                pose_is_f64: true,
                ..Computing::default()
            },
            "pose_enc f64",
        ),
        (
            Computing {
                sides: ["50000", "50000"],
                ..Computing::default()
            },
            "50000",
        ),
    ];
    for (broken, word) in cases {
        let error = refusal(&library, &broken.bytes(), &whole());
        assert!(
            error.contains(word) && error.contains("docs/MODELS.md"),
            "{word}: {error}"
        );
    }
}

#[test]
fn a_file_that_is_no_whole_model_is_refused_at_start() {
    let Some(library) = library() else { return };
    let (bytes, whole) = (Computing::default().bytes(), description(42, 28, 14));
    let huge = Computing {
        huge: true,
        ..Computing::default()
    }
    .bytes();
    let truncated = &bytes[..bytes.len() / 2];
    for broken in [truncated, b"", b"no model at all", &huge] {
        let error = refusal(&library, broken, &whole);
        assert!(
            error.contains("ONNX Runtime refuses") || error.contains("no model"),
            "{error}"
        );
    }
}

#[test]
fn a_description_that_is_missing_long_or_wrong_is_refused_with_the_way_out() {
    let Some(library) = library() else { return };
    let bytes = Computing::default().bytes();
    let folder = tempfile::tempdir().unwrap();
    let path = saved(folder.path(), &bytes, &description(42, 28, 14));
    let beside = path.with_extension("json");
    let check = |word: &str| {
        let error = open(&library, &path).unwrap_err();
        assert!(
            error.contains(word) && error.contains("export_model.py"),
            "{error}"
        );
    };
    std::fs::write(&beside, vec![b' '; 1 << 20]).unwrap();
    check("longer than");
    std::fs::write(&beside, b"{\"contract\": 7}").unwrap();
    check("contract is 7, expected 1");
    std::fs::remove_file(&beside).unwrap();
    check("No such file");
    std::fs::remove_file(&path).unwrap();
    let error = open(&library, &path).unwrap_err();
    assert!(error.contains("there is no model"), "{error}");
    let mut other = description(42, 28, 14);
    other["height"] = json!(56);
    assert!(refusal(&library, &bytes, &other).contains("[S, 3, 56, 42]"));
}

#[test]
fn a_provider_that_is_not_there_is_passed_over_unless_it_is_the_only_one() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = saved(
        folder.path(),
        &Computing::default().bytes(),
        &description(42, 28, 14),
    );
    let by = |providers: &str| {
        let setting = format!("onnx.providers={providers}");
        splat_geometry::foundation::model::Model::open_by(&library, &path, &params(&[&setting]))
            .map(|model| model.provider().name())
            .map_err(|e| e.to_string())
    };
    assert_eq!(by("cpu"), Ok("cpu"));
    assert!(by("auto").is_ok());
    let error = by("cpu,npu").unwrap_err();
    assert!(error.contains("\"npu\""), "{error}");
    // A machine with a GPU has it.
    if let Err(error) = by("cuda") {
        assert!(
            error.contains("cuda") && error.contains("cpu among them"),
            "{error}"
        );
    }
}

/// Frames of noise around a level; level 0 is black.
fn batch(id: u32, levels: &[u8]) -> Batch {
    let keyframe = |(ix, level): (usize, &u8)| {
        let pixel = |i: usize| level.saturating_add((*level > 0) as u8 * (i * 37 % 91) as u8);
        let frame = Frame {
            seq: ix as u64,
            stamp: Stamp::from_secs(ix as f64),
            image: Arc::new(RgbImage {
                width_px: 84,
                height_px: 56,
                pixels: (0..84 * 56 * 3).map(pixel).collect(),
            }),
            intrinsics: None,
            truth: None,
            odometry: None,
            imu: None,
            sensor_depth: None,
            second: None,
            is_held_out: false,
        };
        Arc::new(Keyframe {
            id: 100 * id + ix as u32,
            frame,
            age: Stopwatch::start(),
        })
    };
    Batch {
        id,
        n_shared: 0,
        keyframes: levels.iter().enumerate().map(keyframe).collect(),
    }
}

fn foundation(library: &Path, broken: &Computing) -> FoundationModel {
    let folder = tempfile::tempdir().unwrap();
    let path = saved(folder.path(), &broken.bytes(), &description(42, 28, 14));
    crate::onnx_models::foundation(open(library, &path).unwrap(), &[])
}

fn assert_finite(geometry: &GeometryBatch) {
    for view in &geometry.views {
        assert!(view.submap_from_cam.is_finite() && view.intrinsics.is_plausible());
        let mut values = view.depth.depth.iter().chain(&view.depth.confidence);
        assert!(values.all(|v| v.is_finite() && *v >= 0.0));
    }
}

#[test]
fn a_frame_without_a_pose_is_dropped_and_the_others_stay() {
    let Some(library) = library() else { return };
    let mut model = foundation(&library, &Computing::default());
    let answer = model.infer(&batch(0, &[90, 100, 0, 120])).unwrap();
    assert_finite(&answer);
    let ids: Vec<u32> = answer.views.iter().map(|v| v.keyframe_id).collect();
    assert_eq!(ids, [0, 1, 3]);
    let note = answer.note.unwrap();
    assert!(
        note.contains("1 of 4 frames dropped for a pose that is no number"),
        "{note}"
    );
    let first = &answer.views[0];
    assert_eq!((first.intrinsics.width_px, first.depth.width_px), (84, 42));
    // fov 1 rad across 84 px.
    assert!((first.intrinsics.fx - 42.0 / 0.5f64.tan()).abs() < 1e-4);
}

#[test]
fn a_window_without_poses_is_dropped_and_what_follows_is_joined_over_the_gap() {
    let Some(library) = library() else { return };
    let mut model = foundation(&library, &Computing::default());
    let levels = [90, 100, 110, 120];
    let first = model.infer(&batch(0, &levels)).unwrap().views;
    let lost = model.infer(&batch(1, &[0; 4])).unwrap();
    assert!(lost.views.is_empty());
    let note = lost.note.unwrap();
    // The two frames that link the batch to the one before are good, and known.
    assert!(note.contains("4 of 10 frames dropped"), "{note}");
    let after = model.infer(&batch(2, &levels)).unwrap();
    assert_finite(&after);
    assert_eq!(after.views.len(), 4);
    for (old, new) in first.iter().zip(&after.views) {
        let shift: DVec3 = old.submap_from_cam.translation - new.submap_from_cam.translation;
        assert!(
            shift.length() < 1e-5,
            "equal images have equal places: {shift}"
        );
        assert_eq!(new.submap, 0);
    }
}

#[test]
fn answers_that_say_nothing_drop_their_window_with_the_reason() {
    let Some(library) = library() else { return };
    let bias = |at: usize, value: f32| {
        let mut bias = POSE_BIAS;
        bias[at] = value;
        Computing {
            pose_bias: bias,
            ..Computing::default()
        }
    };
    let mut no_turn = Computing::default();
    no_turn.pose_bias[3..7].fill(f32::NAN);
    let depth = |weight: f32| Computing {
        depth_weights: [weight; 3],
        ..Computing::default()
    };
    let sure = |weight: f32| Computing {
        confidence_weights: [weight; 3],
        ..Computing::default()
    };
    for (broken, word) in [
        (bias(7, 0.0), "field of view"),
        (bias(8, 4.0), "field of view"),
        (bias(0, f32::NAN), "a pose that is no number"),
        (bias(2, f32::INFINITY), "a pose that is no number"),
        (bias(1, 1e30), "a length beyond"),
        (no_turn, "a pose that is no number"),
        (depth(f32::NAN), "depth that is no number above 0"),
        (depth(200.0), "depth that is no number above 0"),
        (depth(-200.0), "depth that is no number above 0"),
        (depth(0.0), "depth is the same everywhere"),
        (sure(f32::NAN), "confidence that is no number"),
        (sure(200.0), "confidence that is no number"),
    ] {
        let mut model = foundation(&library, &broken);
        let answer = model.infer(&batch(0, &[90, 100, 110])).unwrap();
        assert!(answer.views.is_empty(), "{word}");
        let note = model.finish().unwrap().note.unwrap();
        assert!(
            note.contains("1 of 1 windows dropped") && note.contains(word),
            "{word}: {note}"
        );
    }
}
