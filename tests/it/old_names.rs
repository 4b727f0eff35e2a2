//! Parameters by their names of earlier versions, through the whole program.

use std::process::Command;

use serde_json::Value;

const ROOM: &str = "synthetic:room?frames=24&width=192&height=144&speed=3";

#[test]
fn old_names_of_parameters_give_the_same_map_and_one_warning_each() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("old.yaml");
    let old = "splat_mapper:\n  ros__parameters:\n    select: {all: true}\n    map: {pose: shared, seeds_per_keyframe: 600}\n";
    std::fs::write(&file, old).unwrap();
    let run = |more: &[&str]| {
        let out = folder.path().join("out");
        let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
        command.args(["replay", ROOM, "--out"]).arg(&out).args(more);
        let output = command.output().unwrap();
        let log = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{log}");
        let report = std::fs::read(out.join("report.json")).unwrap();
        let report: Value = serde_json::from_slice(&report).unwrap();
        assert_eq!(report["parameters"]["train.pose_opt"], "network");
        let warnings = log.lines().filter(|line| line.contains("is now called"));
        let warnings: Vec<String> = warnings.map(str::to_owned).collect();
        (report["map_sha256"].to_string(), warnings)
    };
    let (by_old, warnings) = run(&[
        &["--geometry", "known", "--steps", "20", "--params"][..],
        &[file.to_str().unwrap(), "--set", "map.mcmc=true"],
    ]
    .concat());
    let expected = [
        ("geometry", "ground_truth"),
        ("map.mcmc", "mcmc.enabled"),
        ("map.pose", "train.pose_opt"),
        ("map.seeds_per_keyframe", "train.seeds_per_keyframe"),
        ("select.all", "select.every_frame"),
        ("train.pose_opt", "network"),
    ];
    assert_eq!(warnings.len(), expected.len(), "{warnings:#?}");
    for (old, new) in expected {
        let is_named = |w: &&String| w.contains(&format!("{old} ")) && w.contains(new);
        assert_eq!(
            warnings.iter().filter(is_named).count(),
            1,
            "{old}: {warnings:#?}"
        );
    }
    let (by_new, warnings) = run(&[
        &["--geometry", "ground_truth", "--steps", "20"][..],
        &[
            "--set",
            "select.every_frame=true",
            "--set",
            "train.pose_opt=network",
        ],
        &[
            "--set",
            "train.seeds_per_keyframe=600",
            "--set",
            "mcmc.enabled=true",
        ],
    ]
    .concat());
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(by_old, by_new);
}
