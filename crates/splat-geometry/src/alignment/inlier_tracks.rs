//! Tracks and poses -> the observations of each track that agree on one point, in their pixels and in their depth.
//!
//! Where a motif repeats, a match may be wrong along the line that the other camera's rays draw: two images alone never
//! report, but the point then lies far from where the depth has it.

use glam::DVec3;
use rayon::prelude::*;

use crate::alignment::depths::{Depths, by_depth};
use crate::alignment::matched::Matched;
use crate::alignment::tracks::{MIN_ANGLE_DEG, Track, observation};
use crate::two_view::triangulate::{Observation, has_angle, triangulate};

/// A point is at the depth of a view if it is off by less than so many expected errors.
const MAX_DEPTH_ERRORS: f64 = 5.0;

/// What is left of a track.
#[derive(Debug, Clone)]
pub(crate) struct InlierTracks {
    pub(crate) track: Track,
    pub(crate) point: DVec3,
    /// Observations, less each by the square of its misfit (0 to 1): more and closer ones score higher.
    pub(crate) score: f64,
}

/// `limits`: px, and the relative error that depth is expected to have.
pub(crate) fn find_inliers(
    matched: &Matched,
    tracks: &[Track],
    depths: &Depths,
    limits: (f64, f64),
) -> Vec<InlierTracks> {
    let all = tracks.par_iter();
    all.filter_map(|track| of_track(matched, track.clone(), depths, limits))
        .collect()
}

/// Leaves the observation that fits worst, until the others fit.
fn of_track(
    matched: &Matched,
    mut track: Track,
    depths: &Depths,
    (max_px, depth_error): (f64, f64),
) -> Option<InlierTracks> {
    let max_log = MAX_DEPTH_ERRORS * depth_error;
    while track.len() >= 2 {
        let point = point(matched, &track, depths)?;
        let misfit = |&(view, feature): &(usize, usize)| {
            let pixels = observation(matched, (view, feature)).error_px(point) / max_px;
            let z = matched.views[view].cam_from_submap.transform_point(point).z;
            let depth = depths[view][feature].map_or(0.0, |d| (z / d).ln().abs() / max_log);
            // NaN, from a point behind the camera, is the worst.
            let worst = pixels.max(depth);
            if worst.is_finite() && z > 0.0 {
                worst
            } else {
                f64::INFINITY
            }
        };
        let misfits: Vec<f64> = track.iter().map(misfit).collect();
        let (worst, most) = misfits
            .iter()
            .enumerate()
            .max_by(|a, b| a.1.total_cmp(b.1))?;
        if *most <= 1.0 {
            let score = misfits.iter().map(|m| 1.0 - m * m).sum();
            return Some(InlierTracks {
                track,
                point,
                score,
            });
        }
        track.remove(worst);
    }
    None
}

/// Where the rays meet, or, if they are all but parallel, where the depths put the point on average.
fn point(matched: &Matched, track: &Track, depths: &Depths) -> Option<DVec3> {
    let observations: Vec<Observation<'_>> =
        track.iter().map(|&at| observation(matched, at)).collect();
    let centres: Vec<DVec3> = observations
        .iter()
        .map(Observation::centre_in_world)
        .collect();
    let met = triangulate(&observations)
        .filter(|p| has_angle(centres.iter().copied(), *p, MIN_ANGLE_DEG.to_radians()));
    met.or_else(|| by_depth(matched, track, depths))
}
