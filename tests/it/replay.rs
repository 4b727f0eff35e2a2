//! The whole program: runs of the binary over synthetic and real recordings, good and bad.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use crate::scenes::scene;
use splat_mapper::eval::evaluation::compare;
use splat_mapper::eval::trajectory::read_tum;

/// A small room, rendered in a second or two.
const ROOM: &str = "synthetic:room?frames=24&width=192&height=144&speed=3";
const DEMO: &str = "recordings/demo.mcap";

pub(crate) fn program(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args(args);
    command
}

fn replay(input: &str, out: &Path, more: &[&str]) -> Output {
    let out = out.to_str().unwrap();
    program(&["replay", input, "--out", out])
        .args(more)
        .output()
        .unwrap()
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

/// The last line of stderr is what a person reads first.
pub(crate) fn last_line(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr)
        .lines()
        .last()
        .unwrap_or_default()
        .to_owned()
}

#[test]
fn a_replay_writes_a_whole_run_directory() {
    let folder = tempfile::tempdir().unwrap();
    let output = replay(
        ROOM,
        folder.path(),
        &["--geometry", "ground_truth", "--steps", "150"],
    );
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    for name in [
        "trajectory.tum",
        "trajectory_live.tum",
        "frames.csv",
        "keyframes.tum",
        "map.ply",
        "map.splatmap",
        "report.json",
        "report.html",
        "run.log",
    ] {
        assert!(
            folder
                .path()
                .join(name)
                .metadata()
                .is_ok_and(|m| m.len() > 0),
            "{name}"
        );
    }
    let report = report(folder.path());
    assert_eq!(report["frames"]["received"], 24);
    assert_eq!(report["keyframes"]["components"], 1);
    assert_eq!(
        report["keyframes"]["selected"],
        report["keyframes"]["registered"]
    );
    assert_eq!(report["steps"], 150);
    assert!(
        report["quality"]["psnr_holdout"]
            .as_f64()
            .is_some_and(|psnr| psnr > 15.0),
        "{}",
        report["quality"]
    );
    assert_eq!(report["scale"]["source"], "given");
    let trajectory = read_tum(&folder.path().join("trajectory.tum")).unwrap();
    let keyframes = read_tum(&folder.path().join("keyframes.tum")).unwrap();
    assert!(trajectory.len() > keyframes.len());
    for keyframe in &keyframes {
        assert!(
            trajectory.iter().any(|t| t == keyframe),
            "every keyframe is a frame"
        );
    }
}

#[test]
fn quality_is_measured_on_the_way_where_it_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, more: &[&str]| {
        let few = [
            "--geometry",
            "ground_truth",
            "--steps",
            "60",
            "--backend",
            "cpu",
        ];
        let out = folder.path().join(name);
        let output = replay(ROOM, &out, &[&few[..], more].concat());
        (output.status.code(), last_line(&output), out)
    };
    let (code, line, out) = run(
        "both",
        &[
            "--set",
            "eval.at_steps=60,40",
            "--set",
            "eval.train_views=0",
        ],
    );
    assert_eq!(code, Some(0), "{line}");
    let report = report(&out);
    let at = report["quality_at"].as_array().unwrap();
    let steps: Vec<u64> = at.iter().map(|q| q["steps"].as_u64().unwrap()).collect();
    assert_eq!(steps, [40, 60]);
    let psnr = |quality: &Value| quality["psnr_holdout"].as_f64().unwrap();
    assert!(psnr(&at[0]["quality"]) < psnr(&at[1]["quality"]) + 1.0);
    // Poses of held-out views begin anew each time, and no step of training lies between.
    assert!((psnr(&at[1]["quality"]) - psnr(&report["quality"])).abs() < 1e-6);
    let count = |key: &str| report["quality"][key].as_u64().unwrap();
    let registered = report["keyframes"]["registered"].as_u64().unwrap();
    assert_eq!(count("views_train") + count("views_holdout"), registered);
    assert!(report["quality"]["ssim_train"].as_f64().unwrap() > 0.3);
    let seconds: Vec<f64> = at.iter().map(|q| q["wall_s"].as_f64().unwrap()).collect();
    assert!(0.0 < seconds[0] && seconds[0] <= seconds[1], "{seconds:?}");

    let (code, line, _) = run("bad", &["--set", "eval.at_steps=4k"]);
    assert_ne!(code, Some(0));
    assert!(
        line.contains("eval.at_steps") && line.contains("4000,7000"),
        "{line}"
    );
}

#[test]
fn held_out_poses_are_fitted_by_edges_where_that_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let psnr = |name: &str, more: &[&str]| {
        let noise = [
            "ground_truth.rotation_noise_deg=0.5",
            "train.pose_opt=fixed",
        ];
        let noise = noise.iter().flat_map(|s| ["--set", s]);
        let few = [
            "--geometry",
            "ground_truth",
            "--steps",
            "150",
            "--backend",
            "cpu",
        ];
        let more = more.iter().flat_map(|s| ["--set", s]);
        let args: Vec<&str> = few.into_iter().chain(noise).chain(more).collect();
        let out = folder.path().join(name);
        let output = replay(ROOM, &out, &args);
        assert!(output.status.success(), "{}", last_line(&output));
        report(&out)["quality"]["psnr_holdout"].as_f64().unwrap()
    };
    let held = psnr("held", &["eval.pose_steps=0"]);
    let whole = psnr("whole", &[]);
    let edges = psnr(
        "edges",
        &[
            "eval.pose_loss=masked_l1",
            "eval.pose_steps=100",
            "eval.pose_rate=0.0008",
        ],
    );
    assert!(
        whole > held + 0.3 && edges > held + 0.3,
        "{held} {whole} {edges}"
    );
}

#[test]
fn threads_and_sequence_give_the_same_map_and_a_seed_another() {
    let run = |more: &[&str]| {
        let folder = tempfile::tempdir().unwrap();
        let output = replay(
            ROOM,
            folder.path(),
            &[&["--geometry", "ground_truth", "--steps", "80"], more].concat(),
        );
        assert!(output.status.success(), "{}", last_line(&output));
        report(folder.path())["map_sha256"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    let on_threads = run(&[]);
    assert_eq!(on_threads, run(&["--set", "sequential=true"]));
    assert_ne!(on_threads, run(&["--seed", "1"]));
}

#[test]
fn structure_from_motion_finds_the_room_from_images_alone() {
    let folder = tempfile::tempdir().unwrap();
    let wide = "synthetic:room?frames=16&width=480&height=360&speed=2";
    let output = replay(wide, folder.path(), &["--steps", "40"]);
    assert!(output.status.success(), "{}", last_line(&output));
    assert_eq!(report(folder.path())["scale"]["source"], "depth");
    let truth = replay(
        wide,
        &folder.path().join("known"),
        &["--geometry", "ground_truth", "--steps", "0"],
    );
    assert!(truth.status.success());
    let evaluation = compare(
        &read_tum(&folder.path().join("keyframes.tum")).unwrap(),
        &read_tum(&folder.path().join("known/keyframes.tum")).unwrap(),
    );
    let ate = evaluation.ate_percent_of_extent.unwrap();
    assert!(ate < 0.5, "ATE {ate} % of the extent");
}

#[test]
fn a_camera_at_rest_ends_with_exit_1_and_the_reason() {
    let Some(scene) = scene("static_euroc") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let output = replay(scene.to_str().unwrap(), folder.path(), &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        last_line(&output).contains("no parallax was seen"),
        "{}",
        last_line(&output)
    );
    assert!(
        report(folder.path())["keyframes"]["selected"]
            .as_u64()
            .unwrap()
            <= 2
    );
}

/// The first part of the shipped recording.
fn cut_recording(folder: &Path, share: f64) -> PathBuf {
    let bytes = std::fs::read(DEMO).unwrap();
    let path = folder.join("cut.mcap");
    std::fs::write(&path, &bytes[..(bytes.len() as f64 * share) as usize]).unwrap();
    path
}

#[test]
fn a_recording_that_is_cut_off_is_used_up_to_the_fault() {
    let folder = tempfile::tempdir().unwrap();
    let cut = cut_recording(folder.path(), 0.2);
    let out = folder.path().join("out");
    let output = replay(
        cut.to_str().unwrap(),
        &out,
        &[
            "--geometry",
            "ground_truth",
            "--steps",
            "20",
            "--max-side",
            "160",
        ],
    );
    assert!(output.status.success(), "{}", last_line(&output));
    let report = report(&out);
    assert!(report["source_fault"].is_string());
    assert!(
        (15..40).contains(&report["frames"]["received"].as_u64().unwrap()),
        "{}",
        report["frames"]
    );
    assert!(report["splats"].as_u64().unwrap() > 100);
}

#[test]
fn a_stage_that_fails_keeps_what_was_gathered_and_says_so() {
    // Images without ground truth: known geometry cannot answer.
    let folder = tempfile::tempdir().unwrap();
    let images = tempfile::tempdir().unwrap();
    for name in ["1.png", "2.png"] {
        let image = image::RgbImage::new(64, 48);
        image.save(images.path().join(name)).unwrap();
    }
    let output = replay(
        images.path().to_str().unwrap(),
        folder.path(),
        &["--geometry", "ground_truth"],
    );
    assert_eq!(output.status.code(), Some(1));
    let line = last_line(&output);
    assert!(
        line.contains("ground_truth") && line.contains("--geometry sfm"),
        "{line}"
    );
    assert!(report(folder.path())["error"].is_string());
}

#[test]
fn bad_arguments_end_with_one_line_and_their_code() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, b"x").unwrap();
    let below_a_file = file.join("out");
    let check = |args: &[&str], code: i32, words: &[&str]| {
        let output = program(args).output().unwrap();
        let line = last_line(&output);
        assert_eq!(output.status.code(), Some(code), "{args:?}: {line}");
        assert!(
            words.iter().all(|word| line.contains(word)),
            "{args:?}: {line}"
        );
    };
    check(
        &["replay", DEMO, "--set", "map.step=3"],
        2,
        &["map.step", "train.steps"],
    );
    check(
        &["replay", DEMO, "--set", "train.sh_degree=9"],
        2,
        &["train.sh_degree", "9", "[0, 3]"],
    );
    check(&["replay", DEMO, "--rate", "fast"], 2, &["--rate", "fast"]);
    check(
        &["replay", DEMO, "--backend", "cuda"],
        2,
        &["backend", "cuda"],
    );
    check(
        &["replay", DEMO, "--out", below_a_file.to_str().unwrap()],
        1,
        &["cannot write the run directory"],
    );
    check(&["replay", "/nowhere/at.all"], 1, &["/nowhere/at.all"]);
    check(
        &["replay", file.to_str().unwrap()],
        1,
        &[file.to_str().unwrap()],
    );
    check(
        &["run", "--source", "v4l2:/dev/video9"],
        1,
        &["no camera is there"],
    );
    check(
        &["replay", DEMO, "--geometry", "onnx:model.onnx"],
        1,
        &["ONNX"],
    );
    assert_eq!(program(&["bogus"]).output().unwrap().status.code(), Some(2));
}

/// A limit on file size stands for a full disk: the kernel refuses the write the same way, and needs no root.
#[test]
#[cfg(unix)]
fn a_full_disk_ends_with_exit_1_and_leaves_no_half_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let script = format!(
        "trap '' XFSZ; ulimit -f 16; exec {} replay '{ROOM}' --geometry ground_truth --steps 10 --out {}",
        env!("CARGO_BIN_EXE_splat-mapper"),
        out.display()
    );
    let output = Command::new("sh").args(["-c", &script]).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", last_line(&output));
    assert!(
        last_line(&output).contains("cannot write the map"),
        "{}",
        last_line(&output)
    );
    // What fits is there, what does not is not there by half.
    assert!(out.join("keyframes.tum").exists());
    assert!(!out.join("map.splatmap").exists() && !out.join("map.ply").exists());
}

#[test]
fn eval_render_and_export_use_what_a_replay_wrote() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    assert!(
        replay(ROOM, &out, &["--geometry", "ground_truth", "--steps", "40"])
            .status
            .success()
    );
    let text = |name: &str| out.join(name).to_str().unwrap().to_owned();
    let run = out.to_str().unwrap();
    let output = program(&[
        "eval",
        run,
        "--reference",
        &text("trajectory.tum"),
        "--json",
    ])
    .output()
    .unwrap();
    let evaluation: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(
        evaluation["ate_rmse"].as_f64().unwrap() < 1e-6,
        "{evaluation}"
    );

    let intrinsics = folder.path().join("intrinsics.json");
    let camera = r#"{"width": 96, "height": 72, "fx": 80.0, "fy": 80.0, "cx": 47.5, "cy": 35.5}"#;
    std::fs::write(&intrinsics, camera).unwrap();
    let frames = folder.path().join("frames");
    let render = |map: &str| {
        let args = [
            "render",
            map,
            "--poses",
            &text("keyframes.tum"),
            "--intrinsics",
            intrinsics.to_str().unwrap(),
        ];
        let output = program(&args)
            .args(["--out", frames.to_str().unwrap(), "--depth"])
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", last_line(&output));
        std::fs::read(frames.join("000000.png")).unwrap()
    };
    let of_checkpoint = render(&text("map.splatmap"));
    assert_eq!(
        of_checkpoint,
        render(&text("map.ply")),
        "both files hold the same splats"
    );
    let copy = folder.path().join("copy.ply");
    let output = program(&["export", &text("map.splatmap"), copy.to_str().unwrap()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", last_line(&output));
    assert!(std::fs::read(copy).unwrap() == std::fs::read(text("map.ply")).unwrap());
}
