//! The end of a live run: what a stop saves, what the map does with the time that it is given, and what is said meanwhile.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use serde_json::Value;

use splat_io::queue::{Received, Receiver, WhenFull, queue};
use splat_types::time::Stopwatch;

/// Longer than any test: only a stop ends it.
const ROOM: &str = "synthetic:room?frames=20000&width=160&height=120&speed=1.5";
/// A machine that does other things besides is slow, but not as slow as this.
const PATIENCE_SECS: f64 = 60.0;

/// A live run whose log is read as it is written.
struct LiveRun {
    child: Child,
    lines: Receiver<String>,
}

impl LiveRun {
    fn start(out: &Path, settings: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
            .args(["run", "--source", ROOM, "--out", out.to_str().unwrap()])
            .args([
                "--set",
                "geometry=ground_truth",
                "--set",
                "map.snapshot_secs=0.2",
            ])
            .args(settings.iter().flat_map(|setting| ["--set", setting]))
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let (tx, lines) = queue("log", 100, WhenFull::Wait);
        let stderr = BufReader::new(child.stderr.take().unwrap());
        let read = move || {
            for line in stderr.lines().map_while(Result::ok) {
                if tx.send(line).is_err() {
                    return;
                }
            }
        };
        let reader = std::thread::Builder::new().name("log".to_owned());
        reader.spawn(read).unwrap();
        Self { child, lines }
    }

    /// Reads the log up to a line that says so.
    fn wait_for(&self, is_wanted: impl Fn(&str) -> bool) -> Vec<String> {
        let (start, mut seen) = (Stopwatch::start(), Vec::new());
        while start.secs() < PATIENCE_SECS {
            if let Received::Item(line) = self.lines.recv_timeout(Duration::from_millis(100)) {
                seen.push(line);
                if is_wanted(seen.last().unwrap()) {
                    return seen;
                }
            }
        }
        panic!("it was not said: {seen:#?}");
    }

    fn interrupt(&self) {
        let pid = self.child.id().to_string();
        let killed = Command::new("kill").args(["-INT", &pid]).status().unwrap();
        assert!(killed.success());
    }

    /// Seconds until the process has ended.
    fn end(&mut self) -> (ExitStatus, f64) {
        let start = Stopwatch::start();
        while start.secs() < PATIENCE_SECS {
            if let Some(status) = self.child.try_wait().unwrap() {
                return (status, start.secs());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        panic!("it did not end");
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

fn shows_splats(line: &str) -> bool {
    line.contains(" splats") && !line.contains(" 0 splats")
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

#[test]
fn a_stop_saves_the_map_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = LiveRun::start(folder.path(), &[]);
    run.wait_for(shows_splats);
    run.interrupt();
    let (status, took) = run.end();
    assert!(status.success(), "{status}");
    eprintln!("ended after {took:.2} s");
    let report = report(folder.path());
    assert!(report["splats"].as_u64().unwrap() > 0, "{report}");
    assert!(
        folder.path().join("map.splatmap").is_file() && folder.path().join("map.ply").is_file()
    );
    // A replay would have gone on to train.steps.
    let planned = report["parameters"]["train.steps"].as_u64().unwrap();
    assert!(report["steps"].as_u64().unwrap() < planned, "{report}");
}

#[test]
fn a_map_that_is_given_time_gets_better_after_the_stop_and_another_stop_ends_that() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = LiveRun::start(folder.path(), &["map.finish_secs=3600"]);
    run.wait_for(shows_splats);
    run.interrupt();
    let step_of = |line: &str| -> Option<u64> {
        let after = line.split("step ").nth(1)?;
        after.split(',').next()?.parse().ok()
    };
    let seen = run.wait_for(|line| line.contains("finishing, ") && line.contains("of 3600 s"));
    let first = step_of(seen.last().unwrap()).unwrap();
    let finishing = |line: &str| line.contains("finishing, ");
    let seen = run.wait_for(|line| finishing(line) && step_of(line) > Some(first));
    assert!(seen.iter().any(|line| finishing(line)));
    run.interrupt();
    let (status, _) = run.end();
    assert!(status.success(), "{status}");
    let report = report(folder.path());
    assert!(report["steps"].as_u64().unwrap() > first, "{report}");
    assert!(folder.path().join("map.splatmap").is_file());
}

#[test]
fn the_last_frame_of_a_recording_ends_a_live_run_in_the_given_time() {
    let folder = tempfile::tempdir().unwrap();
    let short = ROOM.replace("frames=20000", "frames=60");
    let output = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args([
            "run",
            "--source",
            &short,
            "--out",
            folder.path().to_str().unwrap(),
        ])
        .args([
            "--set",
            "geometry=ground_truth",
            "--set",
            "map.finish_secs=1",
        ])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    for said in [
        "finishing, ",
        "was the last one; writing the map",
        "comparing the map with images",
    ] {
        assert!(text.contains(said), "{said}: {text}");
    }
    assert!(report(folder.path())["quality"]["psnr_holdout"].is_number());
}
