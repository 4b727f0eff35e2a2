//! Tracking inside the whole program: the same poses however the stages run, and files that say how each is known.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

use splat_mapper::eval::trajectory::read_tum;

/// Small batches, so that the map indicates its keyframes several times.
const ROOM: &str = "synthetic:room?frames=30&width=192&height=144&speed=1.5";
const SETTINGS: [&str; 10] = [
    "--geometry",
    "ground_truth",
    "--steps",
    "30",
    "--holdout",
    "0",
    "--set",
    "select.batch_size=4",
    "--set",
    "select.batch_overlap=2",
];

fn replay(out: &Path, more: &[&str]) -> Output {
    let output = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["replay", ROOM, "--out", out.to_str().unwrap()])
        .args(SETTINGS)
        .args(more)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    output
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

#[test]
fn threads_and_sequence_track_alike_and_every_pose_says_how_it_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let (threads, sequence) = (
        folder.path().join("threads"),
        folder.path().join("sequence"),
    );
    replay(&threads, &[]);
    replay(&sequence, &["--set", "sequential=true"]);
    for name in ["trajectory_live.tum", "trajectory.tum", "frames.csv"] {
        let read = |out: &Path| std::fs::read_to_string(out.join(name)).unwrap();
        assert!(read(&threads) == read(&sequence), "{name} differs");
    }
    let figures = &report(&threads)["tracking"];
    let count = |key: &str| figures[key].as_u64().unwrap();
    assert_eq!((count("frames"), count("dropped")), (30, 0), "{figures}");
    assert!(count("tracked") >= 20 && count("posed") >= 28, "{figures}");
    let live = read_tum(&threads.join("trajectory_live.tum")).unwrap();
    assert_eq!(live.len() as u64, count("tracked"));
    let table = std::fs::read_to_string(threads.join("frames.csv")).unwrap();
    let n_of = |how: &str| {
        table
            .lines()
            .filter(|line| line.split(',').nth(1) == Some(how))
            .count()
    };
    let n_measured = n_of("keyframe") + n_of("tracked") + n_of("late");
    assert_eq!(n_measured as u64, count("posed"));
    // The first frames came before the map.
    assert!(n_of("late") > 0, "{table}");
    let poses = read_tum(&threads.join("trajectory.tum")).unwrap();
    assert_eq!(poses.len(), n_measured + n_of("interpolated"));
}

#[test]
fn a_live_run_counts_each_frame_once_and_states_its_latency() {
    let folder = tempfile::tempdir().unwrap();
    replay(folder.path(), &["--rate", "4"]);
    let report = report(folder.path());
    let figures = &report["tracking"];
    let seen = figures["frames"].as_u64().unwrap() + figures["dropped"].as_u64().unwrap();
    assert_eq!(seen, 30, "{figures}");
    let is_tracked = figures["tracked"].as_u64().unwrap() > 0;
    assert_eq!(
        report["latency_ms"]["frame_to_pose_p95"].is_number(),
        is_tracked
    );
}

#[test]
fn without_the_tracker_frames_lie_between_keyframes_and_say_so() {
    let folder = tempfile::tempdir().unwrap();
    replay(folder.path(), &["--set", "track.enabled=false"]);
    assert_eq!(report(folder.path())["tracking"]["frames"], 0);
    let table = std::fs::read_to_string(folder.path().join("frames.csv")).unwrap();
    assert!(table.contains(",interpolated,") && !table.contains(",tracked,"));
}
