//! LPIPS by a network that the user supplies: the way through ONNX Runtime, with a network small enough to write here.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::graphs::{self, INPUT, OUTPUT, int, library, node, tensor};
use splat_mapper::eval::lpips::Lpips;
use splat_types::image::RgbImage;

const ROOM: &str = "synthetic:room?frames=12&width=96&height=72&speed=3";

/// Mean of |a - b| over `inputs` images named a, b, ...: with one input, of |a|.
pub(crate) fn network(inputs: &[&str]) -> Vec<u8> {
    let mut graph = match inputs {
        [one] => node("Abs", &[one], "size", &[]),
        _ => [
            node("Sub", &inputs[..2], "difference", &[]),
            node("Abs", &["difference"], "size", &[]),
        ]
        .concat(),
    };
    graph.extend(node("ReduceMean", &["size"], "mean", &int("keepdims", 0)));
    for name in inputs {
        graph.extend(tensor(INPUT, name, &["1", "3", "H", "W"]));
    }
    graph.extend(tensor(OUTPUT, "mean", &[]));
    graphs::model(&[graph])
}

pub(crate) fn saved(folder: &Path, content: &[u8]) -> PathBuf {
    let path = folder.join("lpips.onnx");
    std::fs::write(&path, content).unwrap();
    path
}

#[test]
fn a_network_of_two_images_gives_their_distance() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let model = saved(folder.path(), &network(&["shown", "seen"]));
    let mut lpips = Lpips::open(&library, &model).unwrap();
    let photo = RgbImage {
        width_px: 5,
        height_px: 4,
        pixels: [255, 0, 51].repeat(20),
    };
    let rendered: Vec<f32> = [1.0, 0.5, 0.0].repeat(20);
    // Doubled by the range from -1 to 1: 0, 1.0 and 0.4.
    let distance = lpips.distance(&rendered, &photo).unwrap();
    assert!((distance - 1.4 / 3.0).abs() < 1e-6, "{distance}");
    let same: Vec<f32> = photo.pixels.iter().map(|v| f32::from(*v) / 255.0).collect();
    assert!(lpips.distance(&same, &photo).unwrap() < 1e-6);
    let one = saved(folder.path(), &network(&["shown"]));
    let error = Lpips::open(&library, &one).unwrap_err().to_string();
    assert!(error.contains("1 inputs, expected two"), "{error}");
    let broken = saved(folder.path(), b"no protobuf at all");
    let error = Lpips::open(&library, &broken).unwrap_err().to_string();
    assert!(
        error.contains("docs/FORMATS.md") && error.lines().count() == 1,
        "{error}"
    );
}

fn replay(model: &str, library: Option<&Path>, out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat-mapper"));
    let model = format!("eval.lpips_model={model}");
    command
        .args([
            "replay",
            ROOM,
            "--geometry",
            "ground_truth",
            "--steps",
            "20",
            "--set",
            &model,
        ])
        .args(["--holdout", "4", "--out", out.to_str().unwrap()])
        .env(
            "ORT_DYLIB_PATH",
            library.unwrap_or(Path::new("/nonexistent")),
        );
    command.output().unwrap()
}

#[test]
fn a_run_reports_lpips_of_its_held_out_views() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    let model = saved(folder.path(), &network(&["a", "b"]));
    let output = replay(model.to_str().unwrap(), Some(&library), folder.path());
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let report = std::fs::read(folder.path().join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
    let distance = report["quality"]["lpips_holdout"].as_f64().unwrap();
    assert!(distance > 0.0 && distance < 1.0, "{distance}");
}

#[test]
fn without_the_library_the_error_says_how_to_get_it() {
    let folder = tempfile::tempdir().unwrap();
    let output = replay("any.onnx", None, folder.path());
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("pip install onnxruntime"), "{text}");
    assert!(text.contains("ORT_DYLIB_PATH"), "{text}");
}
