//! Corrected poses and the points that they triangulate -> depth in the same unit, confidence that other views share.

use std::collections::BTreeMap;

use crate::alignment::matched::{Matched, depth_at};
use crate::alignment::tracks::Point;
use crate::answer::View;
use crate::mvs::consistency::Tolerance;
use crate::mvs::stereo::votes;
use crate::mvs::view::RawDepth;
use crate::stats::median;
use splat_types::depth::DepthMap;

/// Points that a view's factor needs; views with fewer take the median factor of the others.
const MIN_POINTS: usize = 12;
/// A factor further from 1 is no error of scale.
const MAX_FACTOR: f64 = 4.0;
/// Views that see through a depth that none agrees with, from which it is never used.
const MIN_CONTRADICTIONS: u8 = 2;
/// Two depths are off independently.
const DIFFERENCE: f64 = 1.5;
/// A depth off by its expected error lands so many px beside the start, there and back.
const RETURN_PX: f64 = 4.0;
/// A pixel floats when both neighbours are further off than so many expected errors, one before and one behind.
const FLOATING: f64 = 3.0;
/// Share of a view's depth that is not used.
const LEAST_TRUSTED: f64 = 0.2;
/// Others that each view is checked against: those nearest in the list, which is the order of time.
const MAX_OTHERS: usize = 8;

/// Scales each view's depth to the triangulated points. Returns the factors; the first `n_held` are 1.
pub fn depth(views: &mut [View], matched: &Matched, points: &[Point], n_held: usize) -> Vec<f64> {
    let mut ratios: Vec<Vec<f64>> = vec![Vec::new(); views.len()];
    for point in points {
        for &(view, feature) in &point.track {
            let aligned_view = &matched.views[view];
            let z = aligned_view.cam_from_submap.transform_point(point.point).z;
            let given = depth_at(
                &views[view].depth,
                &aligned_view.lens,
                aligned_view.pixels[feature],
            );
            if let Some(given) = given.filter(|_| z > 0.0) {
                ratios[view].push((z / given).ln());
            }
        }
    }
    let own: Vec<Option<f64>> = ratios
        .iter_mut()
        .map(|logs| median(logs).filter(|_| logs.len() >= MIN_POINTS))
        .collect();
    let common = median(&mut own.iter().flatten().copied().collect::<Vec<_>>()).unwrap_or(0.0);
    let limit = MAX_FACTOR.ln();
    let factor = |(ix, log): (usize, &Option<f64>)| {
        let log = log.unwrap_or(common);
        let is_usable = ix >= n_held && log.is_finite() && log.abs() < limit;
        if is_usable { log.exp() } else { 1.0 }
    };
    let factors: Vec<f64> = own.iter().enumerate().map(factor).collect();
    for (view, factor) in views.iter_mut().zip(&factors) {
        let values = view.depth.depth.iter_mut();
        values.for_each(|d| *d = (f64::from(*d) * factor) as f32);
    }
    factors
}

/// What the points say of each view's pose.
pub fn health(views: &mut [View], points: &[Point]) {
    let mut seen: BTreeMap<usize, (Vec<f64>, Vec<f64>)> = BTreeMap::new();
    for point in points {
        for &(view, _) in &point.track {
            let (errors, angles) = seen.entry(view).or_default();
            errors.push(point.error_px);
            angles.push(point.angle_rad.to_degrees());
        }
    }
    for (view, (mut errors, mut angles)) in seen {
        let health = &mut views[view].health;
        health.n_inliers = errors.len() as u32;
        health.reprojection_px = median(&mut errors).unwrap_or(0.0);
        health.parallax_deg = median(&mut angles).unwrap_or(0.0);
    }
}

/// Lowers the confidence of depth that other views see through: a share of inliers, where any has a say.
pub fn confidence(views: &mut [View], depth_error: f64, n_held: usize) {
    let raw: Vec<RawDepth> = views.iter().map(as_raw).collect();
    let tolerance = Tolerance {
        return_px: RETURN_PX,
        depth: 2.0 * DIFFERENCE * depth_error,
    };
    let counts: Vec<Vec<[u8; 2]>> = (n_held..views.len())
        .map(|ix| {
            let first = ix.saturating_sub(MAX_OTHERS / 2);
            let others: Vec<_> = (first..(ix + 1 + MAX_OTHERS / 2).min(views.len()))
                .filter(|&o| o != ix && views[o].submap == views[ix].submap)
                .map(|o| (views[o].submap_from_cam, &raw[o]))
                .collect();
            votes((views[ix].submap_from_cam, &raw[ix]), &others, tolerance)
        })
        .collect();
    for (view, counts) in views.iter_mut().skip(n_held).zip(counts) {
        for (confidence, [agree, contradict]) in view.depth.confidence.iter_mut().zip(counts) {
            if agree == 0 && contradict >= MIN_CONTRADICTIONS {
                *confidence = 0.0;
            } else {
                let (agree, contradict) = (f32::from(agree), f32::from(contradict));
                *confidence *= (agree + 1.0) / (agree + contradict + 1.0);
            }
        }
    }
}

/// Takes the confidence of pixels that float between two surfaces, as networks put them at silhouettes, and of the
/// least trusted of a view: only the order of a network's confidence means anything.
pub fn mask(depth: &mut DepthMap, depth_error: f64) {
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    let step = (FLOATING * depth_error) as f32;
    let floats = |before: usize, at: usize, after: usize| {
        let (a, d, b) = (depth.depth[before], depth.depth[at], depth.depth[after]);
        let (low, high) = (a.min(b), a.max(b));
        low > 0.0 && d > low * (1.0 + step) && high > d * (1.0 + step)
    };
    let is_floating = |at: usize| {
        let (x, y) = (at % w, at / w);
        let across = x > 0 && x + 1 < w && floats(at - 1, at, at + 1);
        across || (y > 0 && y + 1 < h && floats(at - w, at, at + w))
    };
    let floating: Vec<usize> = (0..w * h).filter(|&at| is_floating(at)).collect();
    floating
        .into_iter()
        .for_each(|at| depth.confidence[at] = 0.0);
    let mut values: Vec<f32> = (0..w * h)
        .filter_map(|at| Some(depth.verified(at)?.1))
        .collect();
    if !values.is_empty() {
        let n = (LEAST_TRUSTED * values.len() as f64) as usize;
        let cut = *values.select_nth_unstable_by(n, f32::total_cmp).1;
        let low = depth.confidence.iter_mut().filter(|c| **c < cut);
        low.for_each(|c| *c = 0.0);
    }
}

fn as_raw(view: &View) -> RawDepth {
    let (w, h) = (view.depth.width_px, view.depth.height_px);
    let n = w as usize * h as usize;
    let is_whole = w >= 2 && h >= 2 && n == view.depth.depth.len();
    // An image without a side is skipped by the verification.
    let (w, h, n) = if is_whole { (w, h, n) } else { (0, 0, 0) };
    let depth = (0..n).map(|at| view.depth.verified(at).map_or(0.0, |found| found.0));
    RawDepth {
        intrinsics: view.intrinsics.resized(w, h),
        depth: depth.collect(),
        score: Vec::new(),
        margin: Vec::new(),
    }
}
