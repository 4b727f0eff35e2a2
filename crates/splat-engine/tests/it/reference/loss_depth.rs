//! Rendered depth and alpha against a depth map, in three ways, and the gradient at every pixel. docs/GRADIENTS.md 5.

use super::raster::Raster;
use super::{Target, Weights};
use splat_engine::settings::DepthMode;

/// Relative inverse-depth error at which Huber turns from square to straight.
const HUBER: f64 = 0.05;
/// Below this alpha a pixel's expected depth means nothing.
pub const MIN_DEPTH_ALPHA: f64 = 0.5;
/// What spans less of its size is flat and not stretched.
pub const MIN_RELATIVE_RANGE: f64 = 1e-3;

/// What a depth loss decides and does not compute. Between equal decisions it is smooth.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decisions {
    /// Per pixel: left out, or the branch of Huber or the sign of the difference.
    pub branches: Vec<Option<i8>>,
    /// Pixels of the smallest and the largest rendered number; none when one of the images is flat.
    pub ends: Option<[usize; 2]>,
    /// By how little the closest of the differences and of the ends was decided; infinite without stretching.
    pub margin: f64,
}

/// Adds `weights.terms.depth_weight` times the gradient. Returns the loss before its weight.
pub fn depth(
    raster: &Raster,
    target: &Target,
    weights: &Weights,
    v: [&mut [f64]; 2],
) -> (f64, Decisions) {
    let weight = f64::from(weights.terms.depth_weight);
    match weights.depth_mode {
        DepthMode::InverseDepth => inverse(raster, target, weight, v),
        DepthMode::PaperCode => stretched(raster, target, weight, false, v),
        DepthMode::PaperAlpha => stretched(raster, target, weight, true, v),
    }
}

/// Huber of the relative inverse-depth error, weighted by confidence.
fn inverse(
    raster: &Raster,
    target: &Target,
    weight: f64,
    [v_alpha, v_depth_sum]: [&mut [f64]; 2],
) -> (f64, Decisions) {
    let total_confidence: f64 = target.depth.iter().map(|&(_, confidence)| confidence).sum();
    let norm = total_confidence.max(1e-6);
    let mut sum = 0.0;
    let mut branches = Vec::new();
    for (pixel, &(wanted, confidence)) in target.depth.iter().enumerate() {
        let alpha = raster.alpha[pixel];
        if confidence == 0.0 || alpha <= MIN_DEPTH_ALPHA {
            branches.push(None);
            continue;
        }
        let rendered = raster.depth_sum[pixel] / alpha;
        let (value, slope, branch) = huber(wanted / rendered - 1.0);
        branches.push(Some(branch));
        sum += confidence * value;
        let v_depth = weight * confidence / norm * slope * -wanted / (rendered * rendered);
        v_depth_sum[pixel] += v_depth / alpha;
        v_alpha[pixel] -= v_depth * rendered / alpha;
    }
    let decisions = Decisions {
        branches,
        ends: None,
        margin: f64::INFINITY,
    };
    (sum / norm, decisions)
}

/// Value, slope and branch.
fn huber(error: f64) -> (f64, f64, i8) {
    if error.abs() <= HUBER {
        (0.5 * error * error / HUBER, error / HUBER, 0)
    } else {
        let sign = error.signum();
        (error.abs() - 0.5 * HUBER, sign, sign as i8)
    }
}

/// Mean over all pixels with a depth of |minmax(rendered) - minmax(wanted)|: alpha and depth, or depth and 1 - minmax(1 / depth).
fn stretched(
    raster: &Raster,
    target: &Target,
    weight: f64,
    is_alpha: bool,
    [v_alpha, v_depth_sum]: [&mut [f64]; 2],
) -> (f64, Decisions) {
    let mut decisions = Decisions {
        branches: vec![None; raster.alpha.len()],
        ends: None,
        margin: f64::INFINITY,
    };
    let pixels: Vec<usize> = (0..raster.alpha.len())
        .filter(|&pixel| target.depth[pixel].0 > 0.0)
        .collect();
    let rendered: Vec<f64> = pixels
        .iter()
        .map(|&pixel| {
            if is_alpha {
                raster.alpha[pixel]
            } else if raster.alpha[pixel] > 0.0 {
                raster.depth_sum[pixel] / raster.alpha[pixel]
            } else {
                0.0
            }
        })
        .collect();
    let wanted: Vec<f64> = pixels
        .iter()
        .map(|&pixel| {
            let depth = target.depth[pixel].0;
            if is_alpha { depth } else { 1.0 / depth }
        })
        .collect();
    let (Some((low, high)), Some((wanted_low, wanted_high))) = (ends(&rendered), ends(&wanted))
    else {
        return (0.0, decisions);
    };
    let n = pixels.len() as f64;
    let range = rendered[high] - rendered[low];
    let mut sum = 0.0;
    // By each rendered number, the two ends included.
    let mut v = vec![0.0; pixels.len()];
    for i in 0..pixels.len() {
        let share = (rendered[i] - rendered[low]) / range;
        let wanted_share =
            (wanted[i] - wanted[wanted_low]) / (wanted[wanted_high] - wanted[wanted_low]);
        let wanted_share = if is_alpha {
            wanted_share
        } else {
            1.0 - wanted_share
        };
        let difference = share - wanted_share;
        sum += difference.abs() / n;
        let sign = if difference == 0.0 {
            0.0
        } else {
            difference.signum()
        };
        decisions.branches[pixels[i]] = Some(sign as i8);
        let is_end = i == low || i == high;
        // Where there is no splat the numbers are 0 in every implementation.
        let is_certain = raster.alpha[pixels[i]] == 0.0;
        if is_certain {
            // Nothing to decide.
        } else if !is_end {
            let to_ends = (rendered[i] - rendered[low]).min(rendered[high] - rendered[i]) / range;
            decisions.margin = decisions.margin.min(difference.abs()).min(to_ends);
        } else if difference != 0.0 {
            decisions.margin = decisions.margin.min(difference.abs());
        }
        let v_share = weight * sign / n;
        v[i] += v_share / range;
        v[low] += v_share * (rendered[i] - rendered[high]) / (range * range);
        v[high] -= v_share * (rendered[i] - rendered[low]) / (range * range);
    }
    decisions.ends = Some([pixels[low], pixels[high]]);
    for (i, &pixel) in pixels.iter().enumerate() {
        if is_alpha {
            v_alpha[pixel] += v[i];
        } else if raster.alpha[pixel] > 0.0 {
            v_depth_sum[pixel] += v[i] / raster.alpha[pixel];
            v_alpha[pixel] -= v[i] * rendered[i] / raster.alpha[pixel];
        }
    }
    (sum, decisions)
}

/// Where the smallest and the largest number are, the first of equals; none when they are all but equal.
fn ends(values: &[f64]) -> Option<(usize, usize)> {
    let (mut low, mut high) = (0, 0);
    for ix in 0..values.len() {
        if values[ix] < values[low] {
            low = ix;
        }
        if values[ix] > values[high] {
            high = ix;
        }
    }
    let (smallest, largest) = (*values.get(low)?, *values.get(high)?);
    let size = smallest.abs().max(largest.abs());
    (largest - smallest > MIN_RELATIVE_RANGE * size).then_some((low, high))
}
