//! Uncalibrated views -> their common focal length, and the first submap that goes with it.

use crate::sfm::adjust::median_error_px;
use crate::sfm::initialize::{Start, start};
use crate::sfm::limits::Limits;
use crate::sfm::pairwise::{pair_seed, pixel_pairs};
use crate::sfm::reconstruction::Reconstruction;
use crate::two_view::epipolar::{eight_point, homography_share};
use crate::two_view::focal::{PairView, centred, focal_share};

/// Uncalibrated keyframes that are waited for before starting: three leave the focal length open (GEOMETRY.md 2).
pub(crate) const MIN_UNCALIBRATED: usize = 6;
/// Focal lengths that are tried when the first choice gives a poor scene, as shares of the longer side.
const RESTARTS: [f64; 5] = [0.7, 0.9, 1.2, 0.55, 1.6];
/// A start is good when its median error is below this share of the largest error of an inlier, and places this
/// share of the waiting views.
const GOOD_ERROR: f64 = 0.4;
const GOOD_SHARE: f64 = 0.7;

/// Share of the longer side of the uncalibrated views' common focal length.
pub(crate) fn current_share(scene: &Reconstruction) -> Option<f64> {
    let view = scene.views.iter().find(|s| !s.is_calibrated)?;
    Some(view.lens.fx / f64::from(view.lens.width_px.max(view.lens.height_px)))
}

/// Starts the first submap of uncalibrated views: view-graph focal length first, then a few others if that is poor.
pub(crate) fn start_uncalibrated(
    scene: &mut Reconstruction,
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
        let Some(submap) = scene.submaps.last().filter(|_| outcome == Start::Started) else {
            continue;
        };
        let n = submap.views.len() as f64;
        let error = median_error_px(scene, &submap.views);
        if error <= GOOD_ERROR * limits.max_error_px && n >= GOOD_SHARE * pool.len() as f64 {
            return outcome;
        }
        // More views first, then less error.
        let rank = n - error / limits.max_error_px;
        if best.is_none_or(|b| rank > b.0) {
            best = Some((rank, share));
        }
        let last = scene.submaps.len() as u32 - 1;
        scene.dissolve(last);
    }
    let Some((_, share)) = best else {
        return outcome;
    };
    set_share(scene, share);
    start(scene, pool, needed, limits)
}

fn set_share(scene: &mut Reconstruction, share: f64) {
    scene.radial = 0.0;
    let is_calibrated: Vec<bool> = scene.views.iter().map(|s| s.is_calibrated).collect();
    for view in scene.views.iter_mut().filter(|s| !s.is_calibrated) {
        let f = share * f64::from(view.lens.width_px.max(view.lens.height_px));
        (view.lens.fx, view.lens.fy) = (f, f);
        view.failed_with = 0;
    }
    scene.undistort();
    for ((a, b), link) in &mut scene.links {
        if !is_calibrated[*a] || !is_calibrated[*b] {
            link.motion = None;
        }
    }
}

fn estimate(scene: &Reconstruction, limits: &Limits) -> Option<f64> {
    let mut pairs = Vec::new();
    let mut longest: f64 = 0.0;
    for ((a, b), link) in &scene.links {
        let (first, second) = (&scene.views[*a], &scene.views[*b]);
        if first.is_calibrated || second.is_calibrated || link.matches.len() < limits.min_inliers {
            continue;
        }
        let pixels = pixel_pairs(first, second, &link.matches);
        let plane = homography_share(&pixels, limits.max_error_px, pair_seed(limits.seed, *a, *b));
        let Some(f) = eight_point(&pixels) else {
            continue;
        };
        let centre =
            |s: &crate::sfm::reconstruction::SfmView| glam::DVec2::new(s.lens.cx, s.lens.cy);
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
