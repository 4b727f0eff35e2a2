//! A second run that finds its place in the map of a first one.

use std::path::Path;
use std::process::Command;

use splat_geometry::similarity;
use splat_mapper::eval::trajectory::{TimedPose, read_tum};
use splat_mapper::node::open_source::open;
use splat_mapper::params::params::Params;
use splat_mapper::params::settings::Settings;
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::track::tracker::Tracker;
use splat_types::frame::Frame;
use splat_types::transform::{Rigid, Similarity};

/// Starts without a hint, and how many must find the place within the first second.
const N_STARTS: usize = 20;
const MIN_FOUND: usize = 18;
/// A place is right within this share of the median depth, about 2 m, and this angle.
const MAX_OFF: f64 = 0.1;
const MAX_TURN_DEG: f64 = 2.0;

fn params() -> Params {
    Settings::shipped().params().unwrap()
}

pub fn run(args: &[&str]) -> std::process::Output {
    Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(args)
        .output()
        .unwrap()
}

/// Maps the room once; returns world_from_gt.
fn mapped(out: &Path) -> Similarity {
    let room = "synthetic:room?frames=80&width=320&height=240";
    let out = out.to_str().unwrap();
    let output = run(&[
        "replay",
        room,
        "--out",
        out,
        "--geometry",
        "sfm",
        "--steps",
        "1",
    ]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    let keyframes = read_tum(&Path::new(out).join("keyframes.tum")).unwrap();
    let truth = frames(room);
    let pairs: Vec<(Rigid, Rigid)> = keyframes
        .iter()
        .filter_map(|k: &TimedPose| {
            let frame = truth.iter().find(|f| f.stamp == k.stamp)?;
            Some((k.pose, frame.truth?))
        })
        .collect();
    similarity::of_poses(&pairs).unwrap()
}

fn frames(uri: &str) -> Vec<Frame> {
    let mut source = open(uri, &params().source, 0).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}

#[test]
fn a_second_session_finds_its_place_without_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("first");
    let world_from_gt = mapped(&out);
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    // Another day: the hand trembles otherwise, the camera is noisier and the light drifts.
    let again = "synthetic:room?frames=80&width=320&height=240&seed=5&noise=3&exposure=0.3";
    let second = frames(again);
    let mut found = 0;
    for start in 0..N_STARTS {
        let mut tracker = Tracker::in_saved(&map.landmarks, &params().track).unwrap();
        let first = (start * 37 + 11) % (second.len() - 10);
        let measured = second[first..first + 10].iter().find_map(|frame| {
            let tracked = tracker.track(frame);
            Some((frame, tracked.pose.filter(|_| tracked.is_measured())?))
        });
        let Some((frame, pose)) = measured else {
            continue;
        };
        let exact = world_from_gt.transform_pose(&frame.truth.unwrap());
        let off =
            (pose.world_from_cam.translation - exact.translation).length() / world_from_gt.scale;
        let turn = pose.world_from_cam.angle_to(&exact).to_degrees();
        assert!(
            off < 2.0 * MAX_OFF && turn < MAX_TURN_DEG,
            "start {first}: sure of a wrong place, off by {off:.3} m and {turn:.2} deg"
        );
        found += 1;
    }
    eprintln!("{found} of {N_STARTS} starts found their place");
    assert!(found >= MIN_FOUND, "{found}");

    let splatmap = out.join("map.splatmap");
    let before = std::fs::read(&splatmap).unwrap();
    let reported = folder.path().join("second");
    let (map_file, given_dir) = (splatmap.to_str().unwrap(), reported.to_str().unwrap());
    let output = run(&["localise", map_file, again, "--out", given_dir, "--json"]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let tracked = summary["tracked"].as_u64().unwrap();
    eprintln!("{summary}");
    assert!(tracked >= 76, "{tracked} of 80 frames");
    let poses = read_tum(&reported.join("trajectory.tum")).unwrap();
    assert!(poses.len() as u64 >= tracked);
    assert!(reported.join("frames.csv").exists() && reported.join("localisation.json").exists());
    assert_eq!(
        std::fs::read(&splatmap).unwrap(),
        before,
        "the map stays as it is"
    );

    let elsewhere = "synthetic:facade?frames=12&width=320&height=240";
    let output = run(&["localise", map_file, elsewhere]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("was not found in the map"), "{said}");
    check_damage(&map.landmarks);
}

/// Landmarks that were cut or changed are refused or harmless, never a panic.
fn check_damage(landmarks: &[u8]) {
    let track = params().track;
    for cut in (0..landmarks.len()).step_by(landmarks.len() / 50) {
        assert!(
            Tracker::in_saved(&landmarks[..cut], &track).is_err(),
            "cut at {cut}"
        );
    }
    for at in (0..landmarks.len()).step_by(landmarks.len() / 200) {
        let mut changed = landmarks.to_vec();
        changed[at] ^= 0xff;
        drop(Tracker::in_saved(&changed, &track));
    }
    // A number of keyframes that nothing stands behind.
    assert!(Tracker::in_saved(&[0xff; 64], &track).is_err());
}
