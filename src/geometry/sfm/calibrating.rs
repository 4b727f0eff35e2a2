//! Uncalibrated shots -> their common focal length, and the first component that goes with it.

use super::Limits;
use super::adjusting::median_error_px;
use super::links::{pair_seed, pixel_pairs};
use super::scene::Scene;
use super::starting::{Start, start};
use crate::geometry::focal::{PairView, centred, focal_share};
use crate::geometry::two_view::{eight_point, homography_share};

/// Uncalibrated keyframes that are waited for before starting: three leave the focal length open (GEOMETRY.md 2).
pub(super) const MIN_UNCALIBRATED: usize = 6;
/// Focal lengths that are tried when the first choice gives a poor scene, as shares of the longer side.
const RESTARTS: [f64; 5] = [0.7, 0.9, 1.2, 0.55, 1.6];
/// A start is good when its median error is below this share of the largest error of an inlier, and places this
/// share of the waiting shots.
const GOOD_ERROR: f64 = 0.4;
const GOOD_SHARE: f64 = 0.7;

/// Share of the longer side of the uncalibrated shots' common focal length.
pub(super) fn current_share(scene: &Scene) -> Option<f64> {
    let shot = scene.shots.iter().find(|s| !s.is_calibrated)?;
    Some(shot.lens.fx / f64::from(shot.lens.width_px.max(shot.lens.height_px)))
}

/// Starts the first component of uncalibrated shots: view-graph focal length first, then a few others if that is poor.
pub(super) fn start_uncalibrated(
    scene: &mut Scene,
    pool: &[usize],
    guess: Option<f64>,
    limits: &Limits,
) -> Start {
    let needed = pool.len().min(3);
    let first = guess.or_else(|| estimate(scene, limits));
    let choices: Vec<f64> = first.into_iter().chain(RESTARTS).collect();
    let mut best: Option<(f64, f64)> = None;
    let mut outcome = Start::NoMatches;
    for share in choices {
        set_share(scene, share);
        outcome = start(scene, pool, needed, limits);
        if matches!(outcome, Start::NoMatches) {
            return outcome;
        }
        let Some(component) = scene
            .components
            .last()
            .filter(|_| outcome == Start::Started)
        else {
            continue;
        };
        let n = component.shots.len() as f64;
        let error = median_error_px(scene, &component.shots);
        if error <= GOOD_ERROR * limits.max_error_px && n >= GOOD_SHARE * pool.len() as f64 {
            return outcome;
        }
        // More shots first, then less error.
        let rank = n - error / limits.max_error_px;
        if best.is_none_or(|b| rank > b.0) {
            best = Some((rank, share));
        }
        let last = scene.components.len() as u32 - 1;
        scene.dissolve(last);
    }
    let Some((_, share)) = best else {
        return outcome;
    };
    set_share(scene, share);
    start(scene, pool, needed, limits)
}

fn set_share(scene: &mut Scene, share: f64) {
    scene.radial = 0.0;
    let is_calibrated: Vec<bool> = scene.shots.iter().map(|s| s.is_calibrated).collect();
    for shot in scene.shots.iter_mut().filter(|s| !s.is_calibrated) {
        let f = share * f64::from(shot.lens.width_px.max(shot.lens.height_px));
        (shot.lens.fx, shot.lens.fy) = (f, f);
        shot.failed_with = 0;
    }
    scene.straighten();
    for ((a, b), link) in &mut scene.links {
        if !is_calibrated[*a] || !is_calibrated[*b] {
            link.motion = None;
        }
    }
}

fn estimate(scene: &Scene, limits: &Limits) -> Option<f64> {
    let mut pairs = Vec::new();
    let mut longest: f64 = 0.0;
    for ((a, b), link) in &scene.links {
        let (first, second) = (&scene.shots[*a], &scene.shots[*b]);
        if first.is_calibrated || second.is_calibrated || link.matches.len() < limits.min_inliers {
            continue;
        }
        let pixels = pixel_pairs(first, second, &link.matches);
        let plane = homography_share(&pixels, limits.max_error_px, pair_seed(limits.seed, *a, *b));
        let Some(f) = eight_point(&pixels) else {
            continue;
        };
        let centre = |s: &super::scene::Shot| glam::DVec2::new(s.lens.cx, s.lens.cy);
        let fundamental = centred(&f, centre(first), centre(second));
        let weight = (1.0 - plane).max(0.0) * (link.matches.len() as f64).sqrt();
        pairs.push(PairView {
            fundamental,
            weight,
        });
        longest = f64::from(first.lens.width_px.max(first.lens.height_px));
    }
    let found = focal_share(&pairs, longest);
    tracing::debug!(
        n_pairs = pairs.len(),
        ?found,
        "focal length from the view graph"
    );
    found
}
