//! True views -> what a foundation model might say of them: its own frame and unit for each window, poses and depth
//! that are a little off, depth that is now and then far off, and a confidence that half knows where.
//!
//! docs/ALIGNMENT.md states the model. For tests and for `ground_truth.windows`.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::answer::View;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Cells of the smooth part of a depth map's error: networks err by surface, not by pixel.
const CELLS: (usize, usize) = (8, 6);
/// An outlier lies between this factor and its inverse.
const OUTLIER: f64 = 2.0;
/// Confidence falls by e for an error of so many standard deviations.
const TELLTALE: f64 = 2.0;
/// Standard deviation of the logarithm of confidence that has nothing to do with the error.
const GUESSWORK: f64 = 0.3;
const MIN_CONFIDENCE: f64 = 0.02;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// The unit of a window is drawn between this and its inverse, even in the logarithm.
    pub scale: f64,
    /// Standard deviation about each axis.
    pub rotation_deg: f64,
    /// Standard deviation along each axis, share of the median depth.
    pub translation: f64,
    /// Relative standard deviation, half of its variance smooth over the image.
    pub depth: f64,
    /// Share of the pixels.
    pub outliers: f64,
}

impl Noise {
    /// What the figures in docs/ALIGNMENT.md are measured with.
    pub const STATED: Self = Self {
        scale: 1.25,
        rotation_deg: 1.0,
        translation: 0.02,
        depth: 0.05,
        outliers: 0.05,
    };
}

/// The views of one window in a frame of their own, that of the first one.
pub fn answer(truth: &[View], noise: &Noise, seed: u64) -> Vec<View> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let log_scale = noise.scale.max(1.0).ln() * (2.0 * rng.random::<f64>() - 1.0);
    let scale = log_scale.exp();
    let mut views: Vec<View> = truth.to_vec();
    for view in &mut views {
        let median = view.depth.median().map_or(1.0, f64::from);
        let theta = normal3(&mut rng) * noise.rotation_deg.to_radians();
        let rho = normal3(&mut rng) * noise.translation * median;
        view.submap_from_cam = view.submap_from_cam * Rigid::exp(rho, theta);
        disturb(&mut view.depth, noise, scale, &mut rng);
        view.submap = 0;
    }
    if let Some(first) = views.first().map(|view| view.submap_from_cam.inverse()) {
        for view in &mut views {
            let mut pose = (first * view.submap_from_cam).renormalized();
            pose.translation *= scale;
            view.submap_from_cam = pose;
        }
    }
    views
}

fn disturb(depth: &mut DepthMap, noise: &Noise, scale: f64, rng: &mut Pcg64Mcg) {
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    let cells: Vec<f64> = (0..(CELLS.0 + 1) * (CELLS.1 + 1))
        .map(|_| normal(rng))
        .collect();
    for at in 0..w * h {
        let (x, y) = (at % w, at / w);
        let u = (x as f64 + 0.5) / w as f64 * CELLS.0 as f64;
        let v = (y as f64 + 0.5) / h as f64 * CELLS.1 as f64;
        let common = smooth(&cells, u, v);
        let own = normal(rng);
        let is_outlier = rng.random::<f64>() < noise.outliers;
        let far = (OUTLIER.ln() * (2.0 * rng.random::<f64>() - 1.0)).exp();
        let guess = GUESSWORK * normal(rng);
        if depth.verified(at).is_none() {
            continue;
        }
        let error = noise.depth * std::f64::consts::FRAC_1_SQRT_2 * (common + own);
        let factor = if is_outlier {
            far
        } else {
            (1.0 + error).max(0.05)
        };
        depth.depth[at] = (f64::from(depth.depth[at]) * factor * scale) as f32;
        let off = (factor - 1.0).abs() / noise.depth.max(1e-3);
        let confidence = (guess - off / TELLTALE).exp().clamp(MIN_CONFIDENCE, 1.0);
        depth.confidence[at] = confidence as f32;
    }
}

/// Between four normal numbers, with variance 1 everywhere.
fn smooth(cells: &[f64], u: f64, v: f64) -> f64 {
    let (x, y) = ((u as usize).min(CELLS.0 - 1), (v as usize).min(CELLS.1 - 1));
    let (a, b) = (u - x as f64, v - y as f64);
    let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
    let at = y * (CELLS.0 + 1) + x;
    let corners = [at, at + 1, at + CELLS.0 + 1, at + CELLS.0 + 2];
    let sum: f64 = weights.iter().zip(corners).map(|(w, c)| w * cells[c]).sum();
    let variance: f64 = weights.iter().map(|w| w * w).sum();
    sum / variance.sqrt()
}

pub fn normal3(rng: &mut Pcg64Mcg) -> DVec3 {
    DVec3::new(normal(rng), normal(rng), normal(rng))
}

/// Standard normal (Box and Muller 1958).
pub fn normal(rng: &mut Pcg64Mcg) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}
