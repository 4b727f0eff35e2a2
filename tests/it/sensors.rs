//! Recordings with a depth camera or a stereo pair: poses in metres, judged without freedom of scale.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

use crate::scenes::scene;

fn replay(bag: &Path, out: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .arg("replay")
        .arg(bag)
        .args(["--steps", "5", "--backend", "cpu", "--out"])
        .arg(out)
        .args(args)
        .output()
        .unwrap()
}

struct Found {
    /// Metres of the reference per metre of the run.
    scale: f64,
    /// RMSE after the best rigid motion, in metres.
    ate_m: f64,
    n_keyframes: u64,
    log: String,
    report: Value,
}

/// A replay of the scene that trains next to nothing, against its reference.
fn mapped(scene: &Path, args: &[&str]) -> Found {
    let folder = tempfile::tempdir().unwrap();
    let output = replay(&scene.join("rosbag2"), folder.path(), args);
    let log = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{log}");
    let eval = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["eval", "--json", "--reference"])
        .arg(scene.join("poses_tum.txt"))
        .arg(folder.path())
        .output()
        .unwrap();
    let figures: Value = serde_json::from_slice(&eval.stdout).unwrap();
    let report = std::fs::read(folder.path().join("report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let metres = report["scale"]["metres_per_unit"].as_f64().unwrap();
    Found {
        scale: figures["aligned_scale"].as_f64().unwrap() / metres,
        ate_m: figures["ate_se3_rmse"].as_f64().unwrap(),
        n_keyframes: figures["registered"].as_u64().unwrap(),
        log,
        report,
    }
}

#[test]
fn a_depth_camera_gives_poses_in_metres() {
    let Some(scene) = scene("kitchen7s_rgbd") else {
        return;
    };
    let found = mapped(&scene, &["--set", "source.max_frames=120"]);
    assert!(found.log.contains("geometry rgbd"), "{}", found.log);
    assert_eq!(found.report["scale"]["source"], "depth");
    assert_eq!(found.report["frames"]["without_depth"], 0);
    assert!(found.n_keyframes >= 30, "{}", found.n_keyframes);
    // Within 1 %, and 1 % of the 1.9 m that the path extends.
    assert!((found.scale - 1.0).abs() < 0.01, "scale {}", found.scale);
    assert!(found.ate_m < 0.019, "{} m", found.ate_m);
}

#[test]
fn a_rectified_pair_gives_poses_in_metres() {
    let Some(scene) = scene("kitti_vo1_stereo") else {
        return;
    };
    let found = mapped(&scene, &[]);
    assert!(found.log.contains("geometry stereo"), "{}", found.log);
    assert_eq!(found.report["scale"]["source"], "stereo");
    assert_eq!(found.report["frames"]["without_second"], 0);
    assert!((found.scale - 1.0).abs() < 0.01, "scale {}", found.scale);
    // 1 % of a way of 60 m.
    assert!(found.ate_m < 0.6, "{} m", found.ate_m);
}

#[test]
fn a_raw_pair_is_as_good_though_an_image_of_it_is_missing() {
    let Some(scene) = scene("euroc_mh01") else {
        return;
    };
    let found = mapped(&scene, &["--set", "source.max_frames=160"]);
    assert_eq!(found.report["scale"]["source"], "stereo");
    assert!((found.scale - 1.0).abs() < 0.01, "scale {}", found.scale);
    assert!(found.ate_m < 0.01, "{} m", found.ate_m);
}

#[test]
fn sensors_that_are_not_there_are_named() {
    let Some(scene) = scene("fox_clean") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    for (geometry, key) in [
        ("rgbd", "source.depth_topic"),
        ("stereo", "source.second_image_topic"),
    ] {
        let bag = scene.join("rosbag2");
        let output = replay(&bag, folder.path(), &["--geometry", geometry]);
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success());
        assert!(text.contains(key), "{text}");
    }
}
