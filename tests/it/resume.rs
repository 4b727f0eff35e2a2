//! A run that goes on from the map of an earlier one: better where both have looked, larger where only the second has.

use std::path::Path;
use std::process::Command;
use std::sync::{Arc, LazyLock};

use glam::{DQuat, DVec3};

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::traits::{Renderer as _, SplatBuffers as _};
use splat_geometry::similarity;
use splat_io::frame_source::{Source, SourceCounts};
use splat_mapper::node::engines::Engines;
use splat_mapper::node::job::{Job, Outcome};
use splat_mapper::node::open_source::open;
use splat_mapper::node::pipeline;
use splat_mapper::node::save_map::{MapFile, save_map};
use splat_mapper::node::stop::Stop;
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::map_file::checkpoint;
use splat_types::depth::DepthMap;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::transform::{Rigid, Similarity};

/// Fast enough for a test, sharp enough to be recognised.
const ROOM: &str = "synthetic:room?frames=42&width=192&height=144&speed=1.3";
const STEPS: u64 = 240;

/// Frames that are given one by one, as a camera of another session gives them.
struct Frames {
    all: std::vec::IntoIter<Frame>,
    n_given: u64,
}

impl Source for Frames {
    fn next(&mut self) -> Option<Frame> {
        let seq = self.n_given;
        let frame = self.all.next()?;
        self.n_given += 1;
        Some(Frame { seq, ..frame })
    }

    fn counts(&self) -> SourceCounts {
        SourceCounts {
            received: self.n_given,
            ..SourceCounts::default()
        }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.all.len() as u64)
    }

    fn truth_extent(&self) -> Option<f64> {
        Some(1.0)
    }
}

/// Made once: the tests share the images.
fn room() -> &'static [Frame] {
    static FRAMES: LazyLock<Vec<Frame>> = LazyLock::new(|| {
        let params = Settings::shipped().params().unwrap();
        let mut source = open(ROOM, &params.source, 0).unwrap();
        std::iter::from_fn(|| source.next()).collect()
    });
    &FRAMES
}

/// The same as seen by a session with a frame and a unit of its own.
fn elsewhere(frames: &[Frame]) -> Vec<Frame> {
    let there = Similarity {
        scale: 0.4,
        rotation: DQuat::from_scaled_axis(DVec3::new(0.3, 1.1, -0.5)),
        translation: DVec3::new(7.0, -3.0, 2.0),
    };
    let moved = |frame: &Frame| {
        let depth = frame.sensor_depth.as_ref().map(|depth| {
            Arc::new(DepthMap {
                depth: depth.depth.iter().map(|z| z * 0.4).collect(),
                ..(**depth).clone()
            })
        });
        Frame {
            truth: frame.truth.map(|pose| there.transform_pose(&pose)),
            sensor_depth: depth,
            second: None,
            ..frame.clone()
        }
    };
    frames.iter().map(moved).collect()
}

fn params(sets: &[&str]) -> Params {
    let mut settings = Settings::shipped();
    let usual = [
        "backend=cpu",
        "geometry=ground_truth",
        "select.every_frame=true",
        "map.max_splats=20000",
        "train.seeds_per_keyframe=900",
        "ground_truth.rotation_noise_deg=0.2",
        "ground_truth.translation_noise=0.005",
    ];
    let steps = format!("train.steps={STEPS}");
    for setting in usual.iter().chain([&steps.as_str()]).chain(sets) {
        settings.merge_setting(setting).unwrap();
    }
    settings.params().unwrap()
}

fn map(frames: &[Frame], sets: &[&str]) -> Outcome {
    let job = Job {
        source: Box::new(Frames {
            all: Vec::from(frames).into_iter(),
            n_given: 0,
        }),
        params: params(sets),
        is_live: false,
        stop: Stop::default(),
        out: None,
        output: None,
        engines: Engines::default(),
    };
    let outcome = pipeline::run(job, &mut |_| ()).unwrap();
    assert_eq!(outcome.error, None);
    outcome
}

fn saved(outcome: &mut Outcome, path: &Path) -> String {
    let landmarks = outcome.tracking.landmarks.clone();
    outcome.map.snapshot().unwrap();
    let whole = outcome.map.checkpoint(landmarks);
    save_map(MapFile::Checkpoint(&whole), path).unwrap();
    format!("map.resume={}", path.display())
}

/// Mean over what keyframes show of their frames, by the snapshot alone.
fn quality(outcome: &Outcome, keyframes: &[(u32, &RgbImage)]) -> f64 {
    let mut engine = CpuEngine::new();
    engine.append(&outcome.snapshot.splats).unwrap();
    let at = |(id, photo): &(u32, &RgbImage)| {
        let pose = outcome.snapshot.poses.iter();
        let pose = pose.clone().find(|p| p.keyframe_id == *id).unwrap();
        let photo = photo.shrunk(pose.intrinsics.width_px.max(pose.intrinsics.height_px));
        let shown = engine
            .render(
                &pose.intrinsics,
                &pose.world_from_cam.inverse(),
                outcome.snapshot.splats.sh_degree,
            )
            .unwrap();
        shown.psnr(&photo)
    };
    keyframes
        .iter()
        .map(at)
        .collect::<Vec<f64>>()
        .iter()
        .sum::<f64>()
        / keyframes.len() as f64
}

/// Held-out keyframes of a run whose first keyframe has this id.
fn held_out(frames: &[Frame], first_id: u32) -> Vec<(u32, &RgbImage)> {
    let numbered = (first_id..).zip(frames);
    let held_out = numbered.filter(|(id, _)| id % 8 == 4);
    held_out.map(|(id, frame)| (id, &*frame.image)).collect()
}

/// RMSE of the places of this run's keyframes after alignment with the truth, in metres of the truth.
fn ate(outcome: &Outcome, frames: &[Frame]) -> f64 {
    let first = outcome.map.first_id();
    let pairs: Vec<(Rigid, Rigid)> = outcome
        .own_poses()
        .iter()
        .map(|pose| {
            let truth = frames[(pose.keyframe_id - first) as usize].truth.unwrap();
            (truth, pose.world_from_cam)
        })
        .collect();
    let gt_from_world = similarity::of_poses(&pairs).unwrap();
    let off = pairs.iter().map(|(truth, found)| {
        (gt_from_world.transform_point(found.translation) - truth.translation).length_squared()
    });
    (off.sum::<f64>() / pairs.len() as f64).sqrt()
}

#[test]
fn going_on_with_the_same_recording_makes_the_map_better() {
    let folder = tempfile::tempdir().unwrap();
    let frames = &room()[..24];
    let mut first = map(frames, &[]);
    let load = saved(&mut first, &folder.path().join("first.splatmap"));
    let again = elsewhere(frames);
    let mut second = map(&again, &[&load]);
    let joined = second.map.continuation().unwrap();
    eprintln!("{joined:?}");
    assert!(joined.is_joined && joined.keyframes == 24);
    assert_eq!(second.snapshot.poses.len(), 48, "ids go on");
    assert_eq!(second.snapshot.map_id, first.snapshot.map_id);
    assert_eq!(second.map.n_steps_in_all(), 2 * STEPS);

    let views = held_out(frames, 0);
    let (before, after) = (quality(&first, &views), quality(&second, &views));
    let [ate_before, ate_after] = [ate(&first, frames), ate(&second, frames)];
    eprintln!("{before:.2} dB, then {after:.2} dB; ATE {ate_before:.4} m, then {ate_after:.4} m");
    assert!(after > before + 0.3, "{before} {after}");
    // FIXME: keyframes that come to a map that is there settle less than its own did (28 mm beside 12 mm).
    assert!(ate_after < 3.0 * ate_before, "{ate_before} {ate_after}");

    // What was saved of both is one map again.
    let path = folder.path().join("second.splatmap");
    saved(&mut second, &path);
    let back = checkpoint::read(&path).unwrap();
    assert!(back.snapshot.splats == second.snapshot.splats);
    assert_eq!(back.update_counts.len(), back.snapshot.splats.len());
    assert!(back.update_counts.iter().any(|age| *age > 60));
    assert_eq!(back.views.len(), 48);
    let bytes: usize = back.views.iter().map(|v| v.packed().unwrap().len()).sum();
    eprintln!("{} KiB an image with depth", bytes / 48 / 1024);
}

#[test]
fn another_part_joins_and_both_parts_keep_their_quality() {
    let folder = tempfile::tempdir().unwrap();
    let room = room();
    let (here, there) = (&room[..24], elsewhere(&room[18..42]));
    let mut first = map(here, &[]);
    let load = saved(&mut first, &folder.path().join("first.splatmap"));
    let alone = map(&there, &[]);
    let both = map(&there, &[&load]);
    assert!(both.map.continuation().unwrap().is_joined);
    let (of_first, of_second) = (held_out(here, 0), held_out(&there, 24));
    let [first_before, first_after] = [&first, &both].map(|map| quality(map, &of_first));
    let second_before = quality(&alone, &held_out(&there, 0));
    let second_after = quality(&both, &of_second);
    eprintln!("first part {first_before:.2} dB, then {first_after:.2} dB");
    eprintln!("second part alone {second_before:.2} dB, together {second_after:.2} dB");
    assert!(first_after > first_before - 1.0);
    assert!(second_after > second_before - 1.0);

    // A map file without images: what the second run does not see is held all the same.
    let bare = folder.path().join("bare.splatmap");
    let mut checkpoint = checkpoint::read(Path::new(load.split_once('=').unwrap().1)).unwrap();
    checkpoint.views.clear();
    save_map(MapFile::Checkpoint(&checkpoint), &bare).unwrap();
    let load = format!("map.resume={}", bare.display());
    let held = map(&there, &[&load]);
    assert!(held.map.continuation().unwrap().is_joined);
    let unseen = &of_first[..of_first.len() / 2];
    let [before, after] = [&first, &held].map(|map| quality(map, unseen));
    eprintln!("without images {before:.2} dB, then {after:.2} dB where the second run never was");
    // FIXME: what the second run never sees loses 5.7 dB, from 29.3 dB: the splats are held, their keyframes' poses are not, and the
    // sharper the map, the more a shift costs.
    assert!(after > before - 6.0);
}

#[test]
fn a_recording_of_another_place_stays_beside_the_map_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("first");
    let replay = |input: &str, out: &Path, more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
            .args(["replay", input, "--out", out.to_str().unwrap()])
            .args([
                "--geometry",
                "ground_truth",
                "--steps",
                "20",
                "--backend",
                "cpu",
            ])
            .args(more)
            .output()
            .unwrap()
    };
    let room = "synthetic:room?frames=24&width=192&height=144";
    let output = replay(room, &out, &[]);
    assert!(output.status.success());
    let saved = out.join("map.splatmap");
    let second = folder.path().join("second");
    let output = replay(
        "synthetic:facade?frames=24&width=192&height=144",
        &second,
        &["--resume", saved.to_str().unwrap()],
    );
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("has no place in the map"), "{said}");
    let report = std::fs::read(second.join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
    assert_eq!(report["continued"]["joined"], false);
    assert_eq!(report["keyframes"]["registered"], 0);
    assert!(report["keyframes"]["components"].as_u64().unwrap() >= 2);
    let [before, after] =
        [&saved, &second.join("map.splatmap")].map(|path| checkpoint::read(path).unwrap());
    assert!(before.snapshot.splats == after.snapshot.splats);
    assert_eq!(before.snapshot.poses.len(), after.snapshot.poses.len());
    let missing = replay(room, &second, &["--map", "no/such.splatmap"]);
    assert_eq!(missing.status.code(), Some(1));
}
