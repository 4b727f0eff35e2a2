//! An image -> points and descriptors by a network that the user supplies (XFeat, Potje 2024).
//!
//! The contract stands in docs/FORMATS.md: one image of 640x480 in; descriptors, point scores and reliability of every
//! cell of 8x8 pixels out. Images of another size are scaled to it, and points back.

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use glam::DVec2;

use crate::error::FeaturesError;
use crate::features::descriptor::{Descriptors, Features, XFEAT_LENGTH, resized};
use crate::features::scale_space::Grey;
use crate::inference::{Network, NetworkOptions, OnnxError, Tensor, network};

const WIDTH: usize = 640;
const HEIGHT: usize = 480;
const CELL: usize = 8;
const ACROSS: usize = WIDTH / CELL;
const DOWN: usize = HEIGHT / CELL;
const CHANNELS: usize = 64;
/// Scores of the 64 pixels of a cell, and of there being no point at all.
const CLASSES: usize = CELL * CELL + 1;
/// Lowest probability of a point, and how far around it no other may be (Potje 2024).
const MIN_PROBABILITY: f32 = 0.05;
const APART: usize = 2;
/// The network has seen only images; from fewer pixels than its smallest cell there is nothing to scale up.
const MIN_SIDE_PX: usize = CELL;

/// Name and shape of the input and the outputs.
const INPUT: [i64; 4] = [1, 3, HEIGHT as i64, WIDTH as i64];
const OUTPUTS: [(&str, [i64; 4]); 3] = [
    ("feats", [1, CHANNELS as i64, DOWN as i64, ACROSS as i64]),
    ("keypoints", [1, CLASSES as i64, DOWN as i64, ACROSS as i64]),
    ("heatmap", [1, 1, DOWN as i64, ACROSS as i64]),
];

/// A loaded network. Images take turns: ONNX Runtime uses all cores for one.
#[derive(Debug)]
pub struct Xfeat {
    network: Mutex<Network>,
    /// Where the three outputs stand among those of the network.
    order: [usize; 3],
}

/// What comes out of the network, channel after channel, row after row.
#[derive(Debug, Clone, PartialEq)]
pub struct Raw {
    pub feats: Vec<f32>,
    pub keypoints: Vec<f32>,
    pub heatmap: Vec<f32>,
}

impl Xfeat {
    pub fn open(model: &Path) -> Result<Self, FeaturesError> {
        Self::of(network(model, &NetworkOptions::default()).map_err(refused)?)
    }

    /// `library`: see `onnx::onnx_runtime`.
    pub fn open_by(library: &Path, model: &Path) -> Result<Self, FeaturesError> {
        let network = Network::open(library, model, &NetworkOptions::default());
        Self::of(network.map_err(refused)?)
    }

    fn of(network: Network) -> Result<Self, FeaturesError> {
        let fail = |reason: String| FeaturesError::Model {
            reason,
            path: network.path().to_owned(),
        };
        let inputs = network.inputs();
        let shapes: Vec<&Vec<i64>> = inputs.iter().map(|port| &port.shape).collect();
        if shapes != [&INPUT.to_vec()] {
            return Err(fail(format!(
                "inputs {shapes:?}, expected one of {INPUT:?}"
            )));
        }
        let outputs = network.outputs();
        let mut order = [0; 3];
        for (place, (name, shape)) in order.iter_mut().zip(OUTPUTS) {
            *place = outputs
                .iter()
                .position(|port| port.name == name && port.shape[..] == shape)
                .ok_or_else(|| {
                    let found: Vec<String> = outputs.iter().map(ToString::to_string).collect();
                    fail(format!("outputs {found:?}, expected {name:?} {shape:?}"))
                })?;
        }
        Ok(Self {
            network: Mutex::new(network),
            order,
        })
    }

    /// At most `max_features` points, the surest first. None where the network fails, which is logged.
    pub fn features(&self, image: &Grey, max_features: usize) -> Features {
        let (w, h) = (image.width, image.height);
        if w.min(h) < MIN_SIDE_PX || !image.is_whole() {
            return Features::default();
        }
        let raw = self
            .raw(image)
            .inspect_err(|e| tracing::warn!("an image stays without features: {e}"));
        let Ok(raw) = raw else {
            return Features::default();
        };
        let mut found = points(&raw, max_features);
        let scale = DVec2::new(w as f64 / WIDTH as f64, h as f64 / HEIGHT as f64);
        found.pixels.iter_mut().for_each(|pixel| *pixel *= scale);
        found
    }

    /// What the network says of an image of any size.
    pub fn raw(&self, image: &Grey) -> Result<Raw, OnnxError> {
        let is_right = (image.width, image.height) == (WIDTH, HEIGHT);
        let scaled = (!is_right).then(|| resized(image, WIDTH as u32, HEIGHT as u32));
        let pixels = scaled
            .flatten()
            .map_or_else(|| image.pixels.clone(), |p| p.pixels);
        let input = Tensor {
            shape: INPUT.to_vec(),
            values: pixels.repeat(3),
        };
        // A thread that panicked while it held the network has left nothing half done in it.
        let mut network = self.network.lock().unwrap_or_else(PoisonError::into_inner);
        let mut outputs = network.run(vec![input])?;
        let mut take = |place: usize| std::mem::take(&mut outputs[place].values);
        Ok(Raw {
            feats: take(self.order[0]),
            keypoints: take(self.order[1]),
            heatmap: take(self.order[2]),
        })
    }
}

fn refused(error: OnnxError) -> FeaturesError {
    match error {
        OnnxError::Network { reason, path } => FeaturesError::Model { reason, path },
        other => FeaturesError::Onnx(other),
    }
}

/// Points of what the network said, in pixels of its own image.
pub fn points(raw: &Raw, max_features: usize) -> Features {
    let heat = probabilities(&raw.keypoints);
    let mut found: Vec<(f32, usize, usize)> = peaks(&heat)
        .into_iter()
        .map(|(x, y)| {
            let sure = sampled(&raw.heatmap, 1, (x, y))[0];
            (heat[y * WIDTH + x] * sure, x, y)
        })
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.retain(|point| point.0 > 0.0);
    found.truncate(max_features);
    Features {
        pixels: found.iter().map(|&(_, x, y)| summit(&heat, x, y)).collect(),
        sigmas: vec![1.0; found.len()],
        descriptors: Descriptors::Xfeat(
            found
                .iter()
                .map(|&(_, x, y)| descriptor(&raw.feats, (x, y)))
                .collect(),
        ),
    }
}

/// Probability of a point at every pixel: the softmax over its cell, without the share of no point.
fn probabilities(scores: &[f32]) -> Vec<f32> {
    let mut heat = vec![0.0; WIDTH * HEIGHT];
    for cell in 0..DOWN * ACROSS {
        let score = |class: usize| scores[class * DOWN * ACROSS + cell];
        let highest = (0..CLASSES).map(score).fold(f32::NEG_INFINITY, f32::max);
        let powers: [f32; CLASSES] = std::array::from_fn(|class| (score(class) - highest).exp());
        let sum: f32 = powers.iter().sum();
        for (class, power) in powers.iter().enumerate().take(CELL * CELL) {
            let (x, y) = (
                cell % ACROSS * CELL + class % CELL,
                cell / ACROSS * CELL + class / CELL,
            );
            heat[y * WIDTH + x] = power / sum;
        }
    }
    heat
}

/// Pixels that beat all others within `APART`; of equals all stay.
fn peaks(heat: &[f32]) -> Vec<(usize, usize)> {
    let beats_all = |&(x, y): &(usize, usize)| {
        let c = heat[y * WIDTH + x];
        c > MIN_PROBABILITY
            && (y.saturating_sub(APART)..=(y + APART).min(HEIGHT - 1)).all(|row| {
                let (from, to) = (x.saturating_sub(APART), (x + APART).min(WIDTH - 1));
                heat[row * WIDTH + from..=row * WIDTH + to]
                    .iter()
                    .all(|&v| c >= v)
            })
    };
    let all = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x, y)));
    all.filter(beats_all).collect()
}

/// Centre of the probability within a pixel around a peak.
fn summit(heat: &[f32], x: usize, y: usize) -> DVec2 {
    let (mut sum, mut at) = (0.0, DVec2::ZERO);
    for row in y.saturating_sub(1)..=(y + 1).min(HEIGHT - 1) {
        for column in x.saturating_sub(1)..=(x + 1).min(WIDTH - 1) {
            let weight = f64::from(heat[row * WIDTH + column]);
            sum += weight;
            at += weight * DVec2::new(column as f64, row as f64);
        }
    }
    at / sum + 0.5
}

/// Channels at a pixel, linear between the centres of four cells.
fn sampled(planes: &[f32], n: usize, (x, y): (usize, usize)) -> Vec<f32> {
    let place = |at: usize, cells: usize| {
        let along = ((at as f32 + 0.5) / CELL as f32 - 0.5).clamp(0.0, (cells - 1) as f32);
        let low = (along as usize).min(cells - 2);
        (low, along - low as f32)
    };
    let ((left, part_x), (top, part_y)) = (place(x, ACROSS), place(y, DOWN));
    let corners = [
        (0, (1.0 - part_x) * (1.0 - part_y)),
        (1, part_x * (1.0 - part_y)),
        (ACROSS, (1.0 - part_x) * part_y),
        (ACROSS + 1, part_x * part_y),
    ];
    let first = top * ACROSS + left;
    (0..n)
        .map(|channel| {
            let plane = &planes[channel * DOWN * ACROSS..][..DOWN * ACROSS];
            corners
                .iter()
                .map(|(by, weight)| weight * plane[first + by])
                .sum()
        })
        .collect()
}

fn descriptor(feats: &[f32], at: (usize, usize)) -> [i16; CHANNELS] {
    let values = sampled(feats, CHANNELS, at);
    let length = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    std::array::from_fn(|i| (XFEAT_LENGTH * values[i] / length).round() as i16)
}
