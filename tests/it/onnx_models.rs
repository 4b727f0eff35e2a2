//! Models of the contract in docs/MODELS.md, small enough to write here: one that computes, good or broken in a stated
//! way, and one that knows the truth.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value, json};

use crate::graphs::{
    INPUT, OUTPUT, floats, int, ints, model, node, tensor, tensor_of, whole_numbers,
};
use splat_geometry::alignment::aligner::Aligner;
use splat_geometry::foundation::estimator::FoundationModel;
use splat_geometry::foundation::model::Model;
use splat_geometry::foundation::params::OnnxParams;
use splat_geometry::foundation::preprocess::Fit;
use splat_mapper::params::settings::Settings;
use splat_types::depth::DepthMap;
use splat_types::frame::Frame;
use splat_types::transform::Rigid;

/// Weights from the mean red, green and blue of a frame to its pose, and what is added.
pub const POSE_WEIGHTS: [[f32; 9]; 3] = [
    [0.5, 0.1, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.0, 0.4, 0.2, 0.0, 0.03, 0.0, 0.0, 0.0, 0.0],
    [0.2, 0.0, 0.3, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0],
];
pub const POSE_BIAS: [f32; 9] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.8, 1.0];
/// From a pixel's colours to the logarithm of its depth, and of its confidence less 1.
pub const DEPTH_WEIGHTS: [f32; 3] = [1.0, -0.5, 0.25];
pub const CONFIDENCE_WEIGHTS: [f32; 3] = [0.5, 0.5, 0.5];

/// A graph of the contract; a test changes what it wants broken. Black frames get poses that are no number: the
/// logarithm of their mean, times 0, is added.
pub struct Computing {
    pub names: [&'static str; 4],
    pub sides: [&'static str; 2],
    pub n_pose: usize,
    pub pose_bias: [f32; 9],
    pub depth_weights: [f32; 3],
    pub confidence_weights: [f32; 3],
    pub pose_is_f64: bool,
    /// Bytes are declared that are not there.
    pub huge: bool,
}

impl Default for Computing {
    fn default() -> Self {
        Self {
            names: ["images", "pose_enc", "depth", "depth_conf"],
            sides: ["28", "42"],
            n_pose: 9,
            pose_bias: POSE_BIAS,
            depth_weights: DEPTH_WEIGHTS,
            confidence_weights: CONFIDENCE_WEIGHTS,
            pose_is_f64: false,
            huge: false,
        }
    }
}

impl Computing {
    pub fn bytes(&self) -> Vec<u8> {
        let [images, pose_enc, depth, depth_conf] = self.names;
        let [h, w] = self.sides;
        let n = self.n_pose as u64;
        let cut = |row: &[f32; 9]| row[..self.n_pose].to_vec();
        let mean = [ints("axes", &[2, 3]), int("keepdims", 0)].concat();
        let mut parts = vec![
            node("ReduceMean", &[images], "mean", &mean),
            node("Log", &["mean"], "log", &[]),
            node("MatMul", &["log", "zeros"], "nothing", &[]),
            node("MatMul", &["mean", "pose_weights"], "moved", &[]),
            node("Add", &["moved", "pose_bias"], "registered", &[]),
            node("Conv", &[images, "depth_weights"], "log_depth", &[]),
            node("Exp", &["log_depth"], "depths", &[]),
            node("Squeeze", &["depths", "one"], depth, &[]),
            node("Conv", &[images, "conf_weights"], "log_conf", &[]),
            node("Exp", &["log_conf"], "conf_less_1", &[]),
            node("Add", &["conf_less_1", "unit"], "confs", &[]),
            node("Squeeze", &["confs", "one"], depth_conf, &[]),
            floats(
                "pose_weights",
                &[3, n],
                &POSE_WEIGHTS.iter().flat_map(cut).collect::<Vec<_>>(),
            ),
            floats("zeros", &[3, n], &vec![0.0; 3 * self.n_pose]),
            floats("pose_bias", &[n], &cut(&self.pose_bias)),
            floats("depth_weights", &[1, 3, 1, 1], &self.depth_weights),
            floats("conf_weights", &[1, 3, 1, 1], &self.confidence_weights),
            floats("unit", &[1], &[1.0]),
            whole_numbers("one", &[1]),
            tensor(INPUT, images, &["S", "3", h, w]),
            tensor(OUTPUT, depth, &["S", h, w]),
            tensor(OUTPUT, depth_conf, &["S", h, w]),
        ];
        // ONNX: type 11 is f64.
        let (sum, element) = if self.pose_is_f64 {
            ("sum", 11)
        } else {
            (pose_enc, 1)
        };
        parts.push(node("Add", &["registered", "nothing"], sum, &[]));
        if self.pose_is_f64 {
            parts.push(node("Cast", &[sum], pose_enc, &int("to", 11)));
        }
        let n_pose = n.to_string();
        parts.push(tensor_of(OUTPUT, pose_enc, &["S", &n_pose], element));
        if self.huge {
            parts.push(floats("huge", &[50_000, 50_000], &[1.0]));
            parts.push(node("Add", &["huge", "huge"], "huger", &[]));
            parts.push(tensor(OUTPUT, "world_points", &["50000", "50000"]));
        }
        model(&parts)
    }
}

pub fn description(width: u32, height: u32, patch: u32) -> Value {
    json!({
        "contract": 1, "family": "mock", "height": height, "width": width, "patch": patch, "input_norm": "unit",
        "pose": "w2c", "quat": "xyzw", "ref_frame": "first", "s_min": 1, "s_max": 8, "precision": "f32",
        "licence": "none", "preprocess": "ratio",
    })
}

/// The file of a model with its description beside it.
pub fn saved(folder: &Path, bytes: &[u8], description: &Value) -> PathBuf {
    let path = folder.join("model.onnx");
    std::fs::write(&path, bytes).unwrap();
    let text = serde_json::to_vec(description).unwrap();
    std::fs::write(path.with_extension("json"), text).unwrap();
    path
}

/// The shipped parameters after these settings.
pub fn params(settings: &[&str]) -> OnnxParams {
    let mut all = Settings::shipped();
    settings.iter().for_each(|s| all.merge_setting(s).unwrap());
    all.params().unwrap().onnx
}

/// The model with the shipped parameters after these settings.
pub fn foundation(model: Model, settings: &[&str]) -> FoundationModel {
    let mut all = Settings::shipped();
    settings.iter().for_each(|s| all.merge_setting(s).unwrap());
    let params = all.params().unwrap();
    let aligner = Aligner::new(&params.align, &params.sfm, params.seed).unwrap();
    FoundationModel::of(model, &params.onnx, aligner, None)
}

pub fn open(library: &Path, path: &Path) -> Result<Model, String> {
    Model::open_by(library, path, &params(&[])).map_err(|e| e.to_string())
}

/// Side of the cells whose mean colours distinguish one frame from another.
const CELL: usize = 8;

/// Mean of every cell of every plane: what `AveragePool` gives.
fn signature(planes: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut means = Vec::new();
    for plane in planes.chunks_exact(width * height) {
        for y in (0..height).step_by(CELL) {
            for x in (0..width).step_by(CELL) {
                let rows = (y..y + CELL).flat_map(|y| &plane[y * width + x..y * width + x + CELL]);
                means.push(rows.sum::<f32>() / (CELL * CELL) as f32);
            }
        }
    }
    means
}

/// A model that answers with the true pose and depth of the frame that its image looks most like. Its images have
/// the size of the depth that the frames carry.
pub fn truthful(folder: &Path, frames: &[Frame]) -> PathBuf {
    let depths: Vec<Arc<DepthMap>> = frames
        .iter()
        .filter_map(|f| f.sensor_depth.clone())
        .collect();
    assert_eq!(depths.len(), frames.len());
    let (w, h) = (depths[0].width_px as usize, depths[0].height_px as usize);
    let mut description = description(w as u32, h as u32, 16);
    description["s_max"] = 16.into();
    let sidecar = serde_json::from_value(description.clone()).unwrap();
    let signature_of =
        |frame: &Frame| signature(&Fit::new(&frame.image, &sidecar).planes(&frame.image), w, h);
    let signatures: Vec<Vec<f32>> = frames.iter().map(signature_of).collect();
    let (n, length) = (frames.len(), signatures[0].len());
    let mean = |i: usize| signatures.iter().map(|s| s[i]).sum::<f32>() / n as f32;
    let mean: Vec<f32> = (0..length).map(mean).collect();
    // The nearest has the largest a.b - b.b / 2.
    let centred = |i: usize, k: usize| signatures[k][i] - mean[i];
    let columns = (0..length).flat_map(|i| (0..n).map(move |k| (i, k)));
    let table: Vec<f32> = columns.map(|(i, k)| centred(i, k)).collect();
    let half = |k: usize| (0..length).map(|i| centred(i, k).powi(2)).sum::<f32>() / 2.0;
    let halves: Vec<f32> = (0..n).map(half).collect();
    let poses: Vec<f32> = frames.iter().flat_map(pose_enc).collect();
    let all = || {
        depths
            .iter()
            .flat_map(|d| d.depth.iter().zip(&d.confidence))
    };
    let is_verified = |(d, c): (&f32, &f32)| *d > 0.0 && *c > 0.0;
    let depth: Vec<f32> = all()
        .map(|p| if is_verified(p) { *p.0 } else { 1.0 })
        .collect();
    let conf: Vec<f32> = all()
        .map(|p| if is_verified(p) { 3.0 } else { 1.0 })
        .collect();
    let (n, h, w) = (n as u64, h as u64, w as u64);
    let pool = [ints("kernel_shape", &[8, 8]), ints("strides", &[8, 8])].concat();
    let argmax = [int("axis", 1), int("keepdims", 0)].concat();
    let (high, wide) = (h.to_string(), w.to_string());
    let bytes = model(&[
        node("AveragePool", &["images"], "cells", &pool),
        node("Reshape", &["cells", "flat"], "seen", &[]),
        node("Sub", &["seen", "mean"], "centred", &[]),
        node("MatMul", &["centred", "table"], "products", &[]),
        node("Sub", &["products", "halves"], "nearness", &[]),
        node("ArgMax", &["nearness"], "frame", &argmax),
        node("Gather", &["poses", "frame"], "pose_enc", &[]),
        node("Gather", &["depths", "frame"], "depth", &[]),
        node("Gather", &["confs", "frame"], "depth_conf", &[]),
        whole_numbers("flat", &[0, -1]),
        floats("mean", &[length as u64], &mean),
        floats("table", &[length as u64, n], &table),
        floats("halves", &[n], &halves),
        floats("poses", &[n, 9], &poses),
        floats("depths", &[n, h, w], &depth),
        floats("confs", &[n, h, w], &conf),
        tensor(INPUT, "images", &["S", "3", &high, &wide]),
        tensor(OUTPUT, "pose_enc", &["S", "9"]),
        tensor(OUTPUT, "depth", &["S", &high, &wide]),
        tensor(OUTPUT, "depth_conf", &["S", &high, &wide]),
    ]);
    saved(folder, &bytes, &description)
}

fn pose_enc(frame: &Frame) -> [f32; 9] {
    let lens = frame.intrinsics.unwrap();
    let Rigid {
        rotation: q,
        translation: t,
    } = frame.truth.unwrap().inverse();
    let fov = |side: u32, focal: f64| 2.0 * (0.5 * f64::from(side) / focal).atan();
    let fov = [fov(lens.height_px, lens.fy), fov(lens.width_px, lens.fx)];
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w, fov[0], fov[1]].map(|v| v as f32)
}
