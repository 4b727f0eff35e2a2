//! What comes after a foundation model's answer, measured with the stated noise on real and synthetic scenes.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use crate::scenes::scene;
use crate::sfm::shown;
use splat_geometry::alignment::aligner::Aligner;
use splat_geometry::alignment::matched::InitialPoses;
use splat_geometry::alignment::params::{AlignMethod, AlignParams, Registration};
use splat_geometry::answer::{PoseQuality, PoseUpdate, View};
use splat_geometry::ground_truth::model::GroundTruthModel;
use splat_geometry::ground_truth::noise::{Noise, answer};
use splat_geometry::model::GeometryModel as _;
use splat_mapper::eval::alignment::align;
use splat_mapper::eval::evaluation::compare;
use splat_mapper::eval::report_json::Report;
use splat_mapper::eval::trajectory::read_tum;
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::camera::Intrinsics;
use splat_types::frame::{Batch, Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::time::Stopwatch;
use splat_types::transform::Rigid;

/// Asked for: median epipolar error after, and errors of place and orientation after over before, by `epipolar` and by `bundle`.
const MAX_AFTER_PX: f64 = 1.0;
const MAX_LEFT: [(f64, f64); 2] = [(0.5, 0.9), (0.4, 0.4)];
/// Of the depth error before.
const MAX_DEPTH_LEFT: f64 = 1.1;
/// Of the extent, as the alignment leaves it.
const MAX_ATE_PERCENT: f64 = 0.3;
/// Of views that are held out, after few steps on depth and poses with the errors of a network, dB.
const MIN_PSNR: f64 = 20.0;
/// Of the error of place that windows leave, when their submap was corrected as a whole.
const MAX_LEFT_WHOLE: f64 = 0.85;
/// Set, the tests measure every figure of docs/ALIGNMENT.md, which takes a quarter of an hour.
const ALL_FIGURES: &str = "SPLAT_MAPPER_ALL_FIGURES";
/// `both` starts from what `epipolar` gives and ends where `bundle` does.
const METHODS: [AlignMethod; 2] = [AlignMethod::Epipolar, AlignMethod::Bundle];
/// Of the path, after 100 windows.
const MAX_DRIFT: f64 = 0.01;

fn params() -> Params {
    Settings::shipped().params().unwrap()
}

/// True views with their images.
struct Filmed {
    views: Vec<View>,
    images: BTreeMap<u32, Arc<RgbImage>>,
}

fn film(kind: SceneKind, frames: impl Iterator<Item = u32>) -> Filmed {
    let settings = SynthSettings {
        width_px: 320,
        height_px: 240,
        ..SynthSettings::of(kind)
    };
    let lens: Intrinsics = settings.lens().intrinsics;
    let take = Take::new(settings).unwrap();
    let mut filmed = Filmed {
        views: Vec::new(),
        images: BTreeMap::new(),
    };
    for ix in frames {
        let keyframe_id = filmed.views.len() as u32;
        filmed.images.insert(keyframe_id, Arc::new(take.image(ix)));
        filmed.views.push(View {
            keyframe_id,
            submap: 0,
            intrinsics: lens,
            lens: None,
            submap_from_cam: take.pose(ix),
            depth: take.depth(ix, &lens.resized(160, 120)),
            health: PoseQuality::default(),
        });
    }
    filmed
}

/// The fox at its reference poses, depth by stereo.
fn fox() -> Option<Filmed> {
    let shown = shown(&scene("fox")?, 640, 1, true);
    let params = params();
    let mut known =
        GroundTruthModel::new(params.ground_truth, (&params.sfm, &params.mvs), None, 0).unwrap();
    let keyframes: Vec<Arc<Keyframe>> = (shown.keyframes.iter().zip(&shown.truth))
        .take(12)
        .map(|(k, truth)| {
            Arc::new(Keyframe {
                id: k.id,
                frame: Frame {
                    truth: Some(*truth),
                    ..k.frame.clone()
                },
                age: Stopwatch::start(),
            })
        })
        .collect();
    let images = keyframes.iter().map(|k| (k.id, Arc::clone(&k.frame.image)));
    let images = images.collect();
    let batch = Batch {
        id: 0,
        n_shared: 0,
        keyframes,
    };
    let views = known.infer(&batch).unwrap().views;
    Some(Filmed { views, images })
}

/// Root mean square of place after the best similarity, and of orientation in degrees after the best turn.
fn pose_error(found: &[View], truth: &[View]) -> (f64, f64) {
    let poses = |views: &[View]| {
        views
            .iter()
            .map(|v| v.submap_from_cam)
            .collect::<Vec<Rigid>>()
    };
    let (found, truth) = (poses(found), poses(truth));
    let similarity = align(&found, &truth).unwrap().reference_from_estimate;
    let pairs: Vec<(Rigid, Rigid)> = truth.iter().copied().zip(found.iter().copied()).collect();
    // Places of a short path say little of its turn, and orientations enough.
    let turn = splat_geometry::similarity::of_poses(&pairs).unwrap();
    let root_mean = |squares: Vec<f64>| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    let places = pairs.iter().map(|(exact, pose)| {
        let laid = similarity.transform_pose(pose);
        laid.translation.distance_squared(exact.translation)
    });
    let orientations = pairs.iter().map(|(exact, pose)| {
        let angle = turn.transform_pose(pose).angle_to(exact).to_degrees();
        angle * angle
    });
    (
        root_mean(places.collect()),
        root_mean(orientations.collect()),
    )
}

/// Median relative depth error after the best common factor, as a share.
fn depth_error(found: &[View], truth: &[View]) -> f64 {
    let mut logs = Vec::new();
    for (a, b) in found.iter().zip(truth) {
        for at in (0..a.depth.depth.len()).step_by(7) {
            if let (Some((d, _)), Some((e, _))) = (a.depth.verified(at), b.depth.verified(at)) {
                logs.push(f64::from(d / e).ln());
            }
        }
    }
    logs.sort_by(f64::total_cmp);
    let middle = logs[logs.len() / 2];
    logs.iter_mut().for_each(|l| *l = (*l - middle).abs());
    logs.sort_by(f64::total_cmp);
    logs[logs.len() / 2]
}

#[derive(Debug, Default)]
struct Sums {
    before_px: f64,
    after_px: f64,
    place_before: f64,
    place_after: f64,
    turn_before: f64,
    turn_after: f64,
    depth_before: f64,
    depth_after: f64,
}

/// Windows of eight, disturbed and corrected: means.
fn corrected(filmed: &Filmed, params: &AlignParams, noise: &Noise) -> Sums {
    let mut sums = Sums::default();
    let starts: Vec<usize> = (0..filmed.views.len() - 7).step_by(4).collect();
    let share = 1.0 / starts.len() as f64;
    for from in starts {
        let truth = &filmed.views[from..from + 8];
        let mut views = answer(truth, noise, 77 + from as u64);
        let mut aligner = Aligner::new(params, &self::params().sfm, 1).unwrap();
        let before = pose_error(&views, truth);
        sums.depth_before += share * depth_error(&views, truth);
        let refined = aligner.refine(&mut views, &filmed.images, InitialPoses::default());
        let after = pose_error(&views, truth);
        sums.depth_after += share * depth_error(&views, truth);
        sums.before_px += share * refined.before_px.unwrap();
        sums.after_px += share * refined.after_px.unwrap();
        sums.place_before += share * before.0;
        sums.turn_before += share * before.1;
        sums.place_after += share * after.0;
        sums.turn_after += share * after.1;
    }
    sums
}

/// The focal length is free, as a network does not know it either. Poses get better by both methods, and depth no worse.
fn check_corrected(name: &str, filmed: &Filmed) {
    let noises = [("independent", Noise::STATED), ("network", Noise::NETWORK)];
    for (errors, noise) in noises {
        for method in METHODS {
            let params = AlignParams {
                method,
                ..params().align
            };
            let sums = corrected(filmed, &params, &noise);
            let of = format!("{name} {method:?}, {errors} errors");
            eprintln!("{of}: {sums:.4?}");
            assert!(sums.after_px < MAX_AFTER_PX, "{of}");
            let place = sums.place_after / sums.place_before;
            let turn = sums.turn_after / sums.turn_before;
            let depth = sums.depth_after / sums.depth_before;
            let (place_left, turn_left) = MAX_LEFT[usize::from(method == AlignMethod::Bundle)];
            assert!(
                place < place_left && turn < turn_left,
                "{of}: place {place:.2}, orientation {turn:.2} of before"
            );
            assert!(depth < MAX_DEPTH_LEFT, "{of}: depth {depth:.2} of before");
        }
    }
}

#[test]
fn a_noisy_window_of_a_room_is_corrected() {
    check_corrected("room", &film(SceneKind::Room, (0..32).step_by(2).take(12)));
}

#[test]
fn a_noisy_window_of_a_facade_is_corrected() {
    check_corrected(
        "facade",
        &film(SceneKind::Facade, (0..32).step_by(2).take(12)),
    );
}

#[test]
fn a_noisy_window_of_the_fox_is_corrected() {
    if let Some(filmed) = fox() {
        check_corrected("fox", &filmed);
    }
}

/// `n` windows of 6 new and 2 shared keyframes as they are known at the end, and their truth.
fn laid(
    filmed: &Filmed,
    n: u32,
    params: &AlignParams,
    max_features: usize,
) -> (Vec<View>, Vec<View>) {
    let lap = filmed.views.len();
    let mut sfm = self::params().sfm;
    sfm.max_features = max_features;
    let mut aligner = Aligner::new(params, &sfm, 1).unwrap();
    let mut found: BTreeMap<u32, View> = BTreeMap::new();
    let truth = |id: u32| View {
        keyframe_id: id,
        ..filmed.views[id as usize % lap].clone()
    };
    let revise = |found: &mut BTreeMap<u32, View>, revised: Vec<PoseUpdate>| {
        for update in revised {
            let view = found.get_mut(&update.keyframe_id).unwrap();
            view.submap_from_cam = update.submap_from_cam;
        }
    };
    for window in 0..n {
        let ids = 6 * window..6 * window + 8;
        let truths: Vec<View> = ids.clone().map(truth).collect();
        let views = answer(&truths, &Noise::STATED, u64::from(window));
        let image = |id: u32| (id, Arc::clone(&filmed.images[&(id % lap as u32)]));
        let joined = aligner.place(views, &ids.map(image).collect(), true);
        for view in joined.views {
            found.entry(view.keyframe_id).or_insert(view);
        }
        revise(&mut found, joined.revised);
    }
    revise(&mut found, aligner.finish());
    found
        .into_values()
        .map(|v| (truth(v.keyframe_id), v))
        .unzip()
}

/// Where windows end: error of the last place and largest error, over the length of the path, and submaps. The
/// frame is that of the first window. Round after round the camera sees the same images; nothing in windows reaches that
/// far back.
fn drift(filmed: &Filmed, n: u32, params: &AlignParams) -> (f64, f64, u32) {
    let windows_only = AlignParams {
        global_ba_keyframes: 0,
        ..params.clone()
    };
    let (truths, found) = laid(filmed, n, &windows_only, 400);
    let pairs: Vec<(Rigid, Rigid)> = truths
        .iter()
        .zip(&found)
        .map(|(exact, v)| (exact.submap_from_cam, v.submap_from_cam))
        .collect();
    let steps = pairs.windows(2);
    let path: f64 = steps
        .map(|two| two[0].0.translation.distance(two[1].0.translation))
        .sum();
    let similarity = splat_geometry::similarity::of_poses(&pairs[..8]).unwrap();
    let off = |(exact, pose): &(Rigid, Rigid)| {
        let laid = similarity.transform_pose(pose);
        laid.translation.distance(exact.translation)
    };
    let worst = pairs.iter().map(off).fold(0.0, f64::max);
    let last = off(pairs.last().unwrap());
    let submaps = found.iter().map(|v| v.submap).max().unwrap() + 1;
    (last / path, worst / path, submaps)
}

fn check_drift(kind: SceneKind) {
    let filmed = film(kind, (0..120).step_by(2));
    let base = params().align;
    let mut ways = vec![(base.method, base.registration, base.fixed_keyframes)];
    // Figures of docs/ALIGNMENT.md.
    if std::env::var_os(ALL_FIGURES).is_some() {
        ways.extend([
            (base.method, Registration::Poses, 0),
            (base.method, Registration::Points, 0),
            (base.method, Registration::Points, 6),
            (base.method, Registration::Poses, 12),
            (AlignMethod::Epipolar, Registration::Poses, 6),
            (AlignMethod::Off, Registration::Poses, 0),
            (AlignMethod::Off, Registration::Points, 0),
        ]);
    }
    for (ix, (method, registration, fixed_keyframes)) in ways.into_iter().enumerate() {
        let params = AlignParams {
            method,
            registration,
            fixed_keyframes,
            ..base.clone()
        };
        let (last, worst, submaps) = drift(&filmed, 100, &params);
        let (last, worst) = (100.0 * last, 100.0 * worst);
        eprintln!(
            "{kind:?} {method:?} {registration:?} {fixed_keyframes}: last {last:.3} %, worst {worst:.3} %, {submaps} submaps"
        );
        if ix == 0 {
            assert!(
                last < 100.0 * MAX_DRIFT && submaps == 1,
                "{kind:?}: {last:.3} %"
            );
        }
    }
}

#[test]
fn a_hundred_windows_of_a_facade_drift_by_less_than_a_percent_of_the_path() {
    check_drift(SceneKind::Facade);
    if std::env::var_os(ALL_FIGURES).is_some() {
        check_drift(SceneKind::Room);
    }
}

#[test]
fn a_submap_that_is_corrected_as_a_whole_ends_nearer_the_truth() {
    let filmed = film(SceneKind::Corridor, (0..88).step_by(2));
    let base = params().align;
    let error = |whole: usize| {
        let params = AlignParams {
            global_ba_keyframes: whole,
            ..base.clone()
        };
        let (truths, found) = laid(&filmed, 7, &params, 1200);
        pose_error(&found, &truths)
    };
    let (windows, whole, some) = (error(0), error(base.global_ba_keyframes), error(20));
    eprintln!("corridor: windows {windows:.4?}, whole {whole:.4?}, the newest 20 {some:.4?}");
    assert!(whole.0 < MAX_LEFT_WHOLE * windows.0, "place");
    assert!(whole.1 < MAX_LEFT_WHOLE * windows.1, "heading");
    assert!(some.0 < windows.0, "what is forgotten, too, holds the rest");
}

/// The errors of `Noise::STATED` and of `Noise::NETWORK` as parameters.
const INDEPENDENT: [&str; 5] = [
    "ground_truth.windows=true",
    "ground_truth.rotation_noise_deg=1",
    "ground_truth.translation_noise=0.02",
    "ground_truth.depth_noise=0.05",
    "ground_truth.depth_outliers=0.05",
];
const NETWORK: [&str; 11] = [
    "ground_truth.windows=true",
    "ground_truth.window_jumps=0.1",
    "ground_truth.rotation_noise_deg=0.3",
    "ground_truth.translation_noise=0.005",
    "ground_truth.walk_deg=0.5",
    "ground_truth.walk_translation=0.01",
    "ground_truth.depth_noise=0.03",
    "ground_truth.depth_outliers=0.02",
    "ground_truth.depth_warp=0.04",
    "ground_truth.edge_bleed_px=2",
    "ground_truth.focal_error=0.02",
];

/// The whole program on the noise of a foundation model, 6 new and 2 shared keyframes a window: windows, alignment, splats and joint poses.
#[test]
fn a_replay_of_noisy_windows_ends_near_the_truth() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let room = "synthetic:room?frames=40&width=320&height=240&speed=2";
    let run = |to: &str, more: &[&str]| {
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
            .args(["replay", room, "--out", to, "--geometry", "ground_truth"])
            .args(["--set", "select.batch_overlap=2"])
            .args(more)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        read_tum(&Path::new(to).join("keyframes.tum")).unwrap()
    };
    let truth = run(&format!("{out}/truth"), &["--steps", "0"]);
    for (name, steps, noise) in [
        ("independent", "0", INDEPENDENT.as_slice()),
        ("network", "0", NETWORK.as_slice()),
        ("network, joint", "150", NETWORK.as_slice()),
    ] {
        let mut more = vec!["--steps", steps, "--backend", "cpu"];
        noise.iter().for_each(|set| more.extend(["--set", set]));
        let found = run(&format!("{out}/found"), &more);
        let evaluation = compare(&found, &truth);
        let ate = evaluation.ate_percent_of_extent.unwrap();
        eprintln!(
            "replay, {name} errors: ATE {ate:.3} % of the extent, {:?} deg",
            evaluation.rotation_mean_deg
        );
        assert!(ate < MAX_ATE_PERCENT, "{name}: {ate:.3} %");
        let report = Report::read(&Path::new(out).join("found/report.json")).unwrap();
        if steps != "0" {
            let psnr = report.quality.psnr_holdout.unwrap();
            eprintln!("{psnr:.2} dB held out");
            assert!(psnr > MIN_PSNR, "{name}: {psnr:.2} dB");
        }
    }
}
