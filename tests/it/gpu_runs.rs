//! The whole program on a GPU, which may be software: it maps, twice the same, and says when there is none.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use splat_engine::wgpu::engine::WgpuEngine;
use splat_gpu::device::Wanted;

const DEMO: &str = "recordings/demo.mcap";

/// On lavapipe where there is no GPU; `scripts/setup test` installs it.
pub fn gpu_engine() -> WgpuEngine {
    let wanted = Wanted {
        any_kind: true,
        subgroups: true,
        float_atomics: false,
        lanes: None,
    };
    WgpuEngine::new(wanted).unwrap_or_else(|error| panic!("run scripts/setup test: {error}"))
}

/// A small replay; its report and what it said last.
fn replay(out: &Path, drivers: Option<&str>) -> (Option<i32>, Option<Value>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args([
        "replay",
        DEMO,
        "--backend",
        "wgpu",
        "--geometry",
        "ground_truth",
    ]);
    command.args([
        "--max-side",
        "96",
        "--steps",
        "40",
        "--set",
        "mcmc.enabled=true",
    ]);
    command.args(["--set", "source.max_frames=12", "--set", "mcmc.every=20"]);
    command.arg("--out").arg(out);
    if let Some(drivers) = drivers {
        command.env("VK_DRIVER_FILES", drivers);
        command.env("VK_ICD_FILENAMES", drivers);
    }
    let output = command.output().unwrap();
    let report = std::fs::read(out.join("report.json")).ok();
    let stderr = String::from_utf8_lossy(&output.stderr);
    (
        output.status.code(),
        report.and_then(|text| serde_json::from_slice(&text).ok()),
        stderr.lines().last().unwrap_or_default().to_owned(),
    )
}

#[test]
fn a_replay_on_a_gpu_gives_the_same_map_twice() {
    let reports = [0, 1].map(|_| {
        let out = tempfile::tempdir().unwrap();
        let (code, report, line) = replay(out.path(), None);
        assert_eq!(code, Some(0), "{line}");
        report.unwrap()
    });
    let [first, second] = &reports;
    assert!(first["adapter"].as_str().unwrap().starts_with("wgpu"));
    assert!(first["splats"].as_u64().unwrap() > 100);
    assert!(first["peak_gpu_mib"].as_f64().unwrap() > 1.0);
    assert_eq!(first["map_sha256"], second["map_sha256"]);
}

#[test]
fn depth_that_must_be_matched_on_a_gpu_says_when_there_is_none() {
    let out = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    command.args(["replay", DEMO, "--backend", "cpu", "--geometry", "sfm"]);
    command.args(["--set", "mvs.backend=wgpu"]);
    command.arg("--out").arg(out.path());
    command.env("VK_DRIVER_FILES", "/nowhere.json");
    command.env("VK_ICD_FILENAMES", "/nowhere.json");
    let output = command.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    let line = stderr.lines().last().unwrap_or_default();
    assert_eq!(output.status.code(), Some(1), "{line}");
    assert!(
        line.contains("mvs.backend=cpu") && line.contains("no GPU adapter answers"),
        "{line}"
    );
}

#[test]
fn without_a_driver_one_line_says_what_to_install() {
    let out = tempfile::tempdir().unwrap();
    let (code, _, line) = replay(out.path(), Some("/nowhere.json"));
    assert_eq!(code, Some(1), "{line}");
    assert!(
        line.contains("no GPU adapter answers") && line.contains("--backend cpu"),
        "{line}"
    );
}
