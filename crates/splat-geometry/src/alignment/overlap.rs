//! Keyframes that a window shares with the views before it -> the similarity between the two, and how well it fits.

use glam::{DVec2, DVec3};

use crate::answer::View;
use crate::similarity;
use splat_types::depth::DepthMap;
use splat_types::transform::Similarity;

/// Pixels of a shared view that its surface is compared by.
const MAX_SAMPLES: usize = 20_000;
/// A pixel counts with this share of the lower of both median confidences.
const MIN_CONFIDENCE: f64 = 0.1;
/// Huber's loss bends at this share of the median depth, for so many rounds of reweighting.
const HUBER: f64 = 0.05;
const ROUNDS: usize = 5;
/// Distance, as a share of its depth, up to which a point of the window falls on the map's.
const INLIER: f64 = 0.1;
/// Points below which two views share no surface.
const MIN_SAMPLES: usize = 50;
/// A keyframe before, and as the window has it.
pub(crate) struct Shared<'a> {
    pub(crate) old: &'a View,
    pub(crate) new: &'a View,
    /// Points in the frames of both that the same pixel shows.
    samples: Vec<Sample>,
    median_depth: f64,
}

struct Sample {
    old: DVec3,
    new: DVec3,
    old_depth: f64,
    log_ratio: f64,
    weight: f64,
}

impl<'a> Shared<'a> {
    pub(crate) fn new(old: &'a View, new: &'a View) -> Self {
        let (w, h) = (old.depth.width_px as usize, old.depth.height_px as usize);
        let (new_w, new_h) = (new.depth.width_px as usize, new.depth.height_px as usize);
        let min = MIN_CONFIDENCE * median_confidence(&old.depth).min(median_confidence(&new.depth));
        let old_lens = old
            .intrinsics
            .resized(old.depth.width_px, old.depth.height_px);
        let new_lens = new
            .intrinsics
            .resized(new.depth.width_px, new.depth.height_px);
        let n = (w * h).min(MAX_SAMPLES);
        let centre = |x: usize, y: usize| DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        let sample = |k: usize| {
            let at = k * w * h / n;
            let (x, y) = (at % w, at / w);
            let (new_x, new_y) = (x * new_w / w, y * new_h / h);
            let (old_depth, old_confidence) = old.depth.verified(at)?;
            let (new_depth, new_confidence) = new.depth.verified(new_y * new_w + new_x)?;
            let (old_depth, new_depth) = (f64::from(old_depth), f64::from(new_depth));
            let lowest = f64::from(old_confidence.min(new_confidence));
            let old_in_cam = old_lens.ray_in_cam(centre(x, y)) * old_depth;
            let new_in_cam = new_lens.ray_in_cam(centre(new_x, new_y)) * new_depth;
            (lowest > min).then(|| Sample {
                old: old.submap_from_cam.transform_point(old_in_cam),
                new: new.submap_from_cam.transform_point(new_in_cam),
                old_depth,
                log_ratio: (old_depth / new_depth).ln(),
                weight: f64::from(old_confidence * new_confidence).sqrt(),
            })
        };
        Self {
            old,
            new,
            samples: (0..n).filter_map(sample).collect(),
            median_depth: old.depth.median().map_or(0.0, f64::from),
        }
    }
}

impl Shared<'_> {
    /// Between its orientation before and the one that the window gives it.
    pub(crate) fn turn_deg(&self, submap_from_window: &Similarity) -> f64 {
        let laid = submap_from_window.transform_pose(&self.new.submap_from_cam);
        laid.angle_to(&self.old.submap_from_cam).to_degrees()
    }
}

fn median_confidence(depth: &DepthMap) -> f64 {
    let mut values: Vec<f32> = (0..depth.depth.len())
        .filter_map(|at| Some(depth.verified(at)?.1))
        .collect();
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

fn all_samples<'a>(shared: &'a [&Shared<'_>]) -> impl Iterator<Item = &'a Sample> {
    shared.iter().flat_map(|s| &s.samples)
}

pub(crate) fn inlier_share(shared: &[&Shared<'_>], similarity: &Similarity) -> f64 {
    let (mut n, mut all) = (0.0, 0.0);
    for sample in all_samples(shared) {
        all += 1.0;
        let off = similarity.transform_point(sample.new) - sample.old;
        if off.length() < INLIER * sample.old_depth {
            n += 1.0;
        }
    }
    n / all
}

/// Scale by the ratio of the depths of the same pixels, the rest by the poses.
pub(crate) fn by_poses(shared: &[&Shared<'_>]) -> Option<Similarity> {
    let mut ratios: Vec<(f64, f64)> = all_samples(shared)
        .map(|s| (s.log_ratio, s.weight))
        .collect();
    if ratios.len() < MIN_SAMPLES {
        return None;
    }
    ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * ratios.iter().map(|r| r.1).sum::<f64>();
    let mut sum = 0.0;
    let middle = ratios.iter().find(|r| {
        sum += r.1;
        sum >= half
    })?;
    let scale = middle.0.exp();
    let turns = shared
        .iter()
        .map(|s| s.old.submap_from_cam.rotation * s.new.submap_from_cam.rotation.conjugate());
    let rotation = similarity::mean_rotation(turns)?;
    let places = shared.iter().map(|s| {
        s.old.submap_from_cam.translation - rotation * s.new.submap_from_cam.translation * scale
    });
    Some(Similarity {
        scale,
        rotation,
        translation: places.sum::<DVec3>() / shared.len() as f64,
    })
}

/// Weighted similarity between the surfaces, reweighted by Huber's loss.
pub(crate) fn by_points(shared: &[&Shared<'_>]) -> Option<Similarity> {
    let samples: Vec<&Sample> = all_samples(shared).collect();
    if samples.len() < MIN_SAMPLES {
        return None;
    }
    let medians = shared.iter().map(|s| s.median_depth).sum::<f64>();
    let bend = HUBER * medians / shared.len() as f64;
    let mut weights: Vec<f64> = samples.iter().map(|s| s.weight).collect();
    let mut found = None;
    for _ in 0..ROUNDS {
        let pairs = samples.iter().map(|s| (s.old, s.new));
        let similarity = similarity::of_weighted_points(pairs, &weights)?;
        for (weight, s) in weights.iter_mut().zip(&samples) {
            let off = (similarity.transform_point(s.new) - s.old).length();
            *weight = s.weight * if off > bend { bend / off } else { 1.0 };
        }
        found = Some(similarity);
    }
    found
}
