//! Killed while it writes: the old map or the new one is there, whole.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use rand::{RngExt as _, SeedableRng as _};

use crate::formats::random_snapshot;
use splat_mapper::node::save_map::{MapFile, save_map};
use splat_slam::mapper::map_file::checkpoint::{self, Checkpoint};
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;

/// Where the saving child writes; without it the test that is the child does nothing.
const PLACE: &str = "SPLAT_MAPPER_TEST_CRASH";
const N_KILLS: usize = 100;
/// Splats of the two maps that are written in turn: some 2 MB each, so that most kills fall into a write.
const N_SPLATS: [usize; 2] = [20_000, 20_001];

fn map(which: usize) -> Snapshot {
    random_snapshot(N_SPLATS[which], 5, 1, which as u32)
}

/// Not a test by itself: the process that is killed.
#[test]
fn a_child_that_saves_until_it_is_killed() {
    let Some(path) = std::env::var_os(PLACE) else {
        return;
    };
    let maps = [0, 1].map(|which| Checkpoint::of(map(which), 1, 1));
    loop {
        for checkpoint in &maps {
            save_map(MapFile::Checkpoint(checkpoint), Path::new(&path)).unwrap();
        }
    }
}

fn child(path: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "crash::a_child_that_saves_until_it_is_killed"])
        .env(PLACE, path)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn after_a_kill_at_any_moment_the_old_map_or_the_new_one_loads() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    let maps = [0, 1].map(map);
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let (mut found, mut n_cut) = ([0; 2], 0);
    for _ in 0..N_KILLS {
        let mut child = child(&path);
        // The first write of all makes the file; later children replace it from their start on.
        while !path.exists() {
            std::thread::sleep(Duration::from_millis(1));
        }
        let partial = folder.path().join("map.splatmap.partial");
        while !partial.exists() {
            std::thread::yield_now();
        }
        std::thread::sleep(Duration::from_micros(rng.random_range(0..25_000)));
        child.kill().unwrap();
        child.wait().unwrap();
        n_cut += usize::from(partial.exists());
        let back = checkpoint::read(&path).unwrap().snapshot;
        let which = maps.iter().position(|map| *map == back);
        found[which.expect("one of the two maps, bit for bit")] += 1;
        std::fs::remove_file(&partial).ok();
    }
    eprintln!("{n_cut} of {N_KILLS} kills cut a write short; {found:?} of the two maps");
    assert!(n_cut > N_KILLS / 10, "the kills miss the writes");
}

#[test]
fn a_run_that_dies_leaves_the_last_autosave() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let map = out.join("map.splatmap");
    let mut child = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["replay", "synthetic:endless?frames=100000", "--out"])
        .arg(&out)
        .args(["--geometry", "ground_truth", "--backend", "cpu"])
        .args(["--set", "map.autosave_secs=0.2", "--steps", "1000000"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let watch = Stopwatch::start();
    let load = || {
        checkpoint::read(&map)
            .ok()
            .filter(|c| !c.landmarks.is_empty())
    };
    let mut loaded = None;
    while loaded.is_none() && watch.secs() < 50.0 {
        std::thread::sleep(Duration::from_millis(20));
        loaded = load();
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let last = load().expect("an autosave with landmarks within 50 s");
    let snapshot: Arc<Snapshot> = Arc::new(last.snapshot);
    assert!(!snapshot.splats.is_empty() && !snapshot.poses.is_empty());
    assert!(!out.join("report.json").exists(), "the run did not end");
}
