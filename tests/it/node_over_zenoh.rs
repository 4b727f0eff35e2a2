//! The node as a client sees it: a subscriber before its start and one after its end get the map of `map.ply`.
#![cfg(feature = "zenoh")]

use std::process::{Child, Command, Stdio};

use zenoh::Wait;

use crate::over_zenoh::{MAX_BYTES, PATIENCE, ask, client, free_endpoint, take};
use splat_msgs::client::assembler::Assembler;
use splat_types::snapshot::Snapshot;
use splat_types::splats::ply;

/// Ends the node with the test, whatever happens.
struct Node(Child);

impl Drop for Node {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

#[test]
fn early_and_late_subscribers_get_the_map_of_the_run_directory() {
    let folder = tempfile::tempdir().unwrap();
    let (node_end, early_end) = (free_endpoint(), free_endpoint());
    let early = client(&early_end, "");
    let samples = early
        .declare_subscriber("0/splat_mapper/**")
        .wait()
        .unwrap();
    let child = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args([
            "replay",
            "synthetic:room?frames=12&width=160&height=120&speed=3",
            "--geometry",
            "ground_truth",
        ])
        .args([
            "--steps",
            "30",
            "--out",
            folder.path().to_str().unwrap(),
            "--set",
            "publish.zenoh=true",
        ])
        .args([
            "--set",
            "publish.scouting=false",
            "--set",
            "publish.shutdown_delay=120",
        ])
        .args(["--set", "publish.full_map_period=0"])
        .args(["--set", &format!("publish.zenoh_listen={node_end}")])
        .args(["--set", &format!("publish.zenoh_connect={early_end}")])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let _node = Node(child);

    // The early one receives every revision; the newest is whole when the run directory is.
    let mut assembler = Assembler::new(MAX_BYTES);
    let mut newest: Option<Snapshot> = None;
    let map = folder.path().join("map.ply");
    let is_newest = |newest: &Option<Snapshot>| {
        map.exists()
            && newest
                .as_ref()
                .is_some_and(|s| ply::read(&map).is_ok_and(|file| same(&file, s)))
    };
    while !is_newest(&newest) {
        let sample = samples.recv_timeout(PATIENCE).unwrap();
        match sample {
            Some(sample) => newest = take(&mut assembler, &sample).or(newest),
            None => assert!(map.exists(), "silence, and no map"),
        }
    }
    let late =
        ask(&client("", &node_end), "0/splat_mapper/**").expect("no snapshot for a late joiner");
    assert!(newest == Some(late));
}

/// Splat for splat; anchors do not travel in PLY.
fn same(file: &splat_types::splats::splats::Splats, snapshot: &Snapshot) -> bool {
    let sent = &snapshot.splats;
    file.means == sent.means
        && file.log_scales == sent.log_scales
        && file.quats == sent.quats
        && file.opacity_logits == sent.opacity_logits
        && file.sh == sent.sh
}
