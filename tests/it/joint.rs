//! Steps on splats and poses together -> poses nearer the truth than the model gave them, by whole runs of the program.

use std::path::Path;
use std::process::Command;

use splat_mapper::eval::evaluation::compare;
use splat_mapper::eval::trajectory::read_tum;

/// Of the error that the model's noise leaves, what may be left after the steps.
const MAX_LEFT: f64 = 0.7;

fn run(scene: &str, out: &Path, sets: &[&str], steps: u32) {
    let steps = steps.to_string();
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args(["replay", scene, "--out", out.to_str().unwrap()]);
    command.args([
        "--geometry",
        "ground_truth",
        "--steps",
        &steps,
        "--max-side",
        "160",
    ]);
    sets.iter().for_each(|set| {
        command.args(["--set", set]);
    });
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

fn check(scene: &str) {
    let folder = tempfile::tempdir().unwrap();
    let noise = [
        "ground_truth.rotation_noise_deg=0.5",
        "ground_truth.translation_noise=0.01",
        "track.enabled=false",
    ];
    let at = |name: &str| folder.path().join(name);
    run(scene, &at("truth"), &["track.enabled=false"], 0);
    run(scene, &at("before"), &noise, 0);
    run(scene, &at("after"), &noise, 900);
    let poses = |name: &str| read_tum(&at(name).join("keyframes.tum")).unwrap();
    let ate = |name: &str| {
        let evaluation = compare(&poses(name), &poses("truth"));
        evaluation.ate_percent_of_extent.unwrap()
    };
    let (before, after) = (ate("before"), ate("after"));
    eprintln!("{scene}: ATE {before:.3} % -> {after:.3} % of the extent");
    assert!(after <= MAX_LEFT * before, "{before:.3} % -> {after:.3} %");
}

#[test]
fn steps_bring_the_poses_of_a_room_nearer_the_truth() {
    check("synthetic:room?frames=40&width=160&height=120&speed=2.4");
}

#[test]
fn steps_bring_the_poses_of_a_street_nearer_the_truth() {
    check("synthetic:facade?frames=40&width=160&height=120&speed=2.4");
}
