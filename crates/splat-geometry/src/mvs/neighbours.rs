//! Poses and sparse landmarks -> which views to match a view against, and between which depths.

use glam::DVec3;

use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// A view that may serve as a source.
#[derive(Debug, Clone)]
pub struct Candidate {
    pub keyframe_id: u32,
    pub intrinsics: Intrinsics,
    pub submap_from_cam: Rigid,
    /// Landmarks that it and the reference both see; 0 for all where nobody counts.
    pub n_shared: usize,
}

/// Angle between the rays of both views at which matching works best: more gives exacter depth, less looks more alike.
const BEST_ANGLE_DEG: f64 = 8.0;
/// The weight falls to 0.6 this far below and above.
const NARROW_DEG: f64 = 3.5;
const WIDE_DEG: f64 = 9.0;
/// Candidates outside of these are no use at all.
const ANGLE_RANGE_DEG: std::ops::Range<f64> = 0.7..45.0;
/// A source that sees less of the reference than this is not worth its time.
const MIN_OVERLAP: f64 = 0.15;
/// Enough for a median.
const MAX_LANDMARKS: usize = 256;
/// Fewer say nothing of a range.
const MIN_LANDMARKS: usize = 8;

/// Ids of the best sources, best first, at most `n`.
///
/// `landmarks_in_world`: what the reference sees; angles and overlap are taken there.
pub fn choose_sources(
    reference: (&Intrinsics, &Rigid),
    landmarks_in_submap: &[DVec3],
    candidates: &[Candidate],
    n: usize,
) -> Vec<u32> {
    let stride = landmarks_in_submap.len().div_ceil(MAX_LANDMARKS).max(1);
    let landmarks: Vec<DVec3> = landmarks_in_submap
        .iter()
        .copied()
        .step_by(stride)
        .collect();
    let most_shared = candidates
        .iter()
        .map(|candidate| candidate.n_shared)
        .max()
        .unwrap_or(0);
    let mut weighed: Vec<(f64, u32)> = candidates
        .iter()
        .filter_map(|candidate| {
            let weight = weight(reference.1, &landmarks, candidate)?;
            // Both views may see a place without both having found it: the count alone is too strict.
            let shared = if most_shared > 0 {
                candidate.n_shared as f64 / most_shared as f64
            } else {
                1.0
            };
            Some((weight * (0.2 + 0.8 * shared), candidate.keyframe_id))
        })
        .collect();
    weighed.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    weighed.truncate(n);
    weighed.into_iter().map(|(_, id)| id).collect()
}

/// Near and far plane of a sweep from the z-depths of landmarks; `None` with too few of them.
pub fn depth_range(depths: &[f64]) -> Option<(f64, f64)> {
    let mut sorted: Vec<f64> = depths
        .iter()
        .copied()
        .filter(|depth| depth.is_finite() && *depth > 0.0)
        .collect();
    if sorted.len() < MIN_LANDMARKS {
        return None;
    }
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize];
    // Landmarks sit on corners and edges; the walls between them reach nearer and farther.
    Some((0.7 * at(0.02), 1.8 * at(0.98)))
}

/// `None`: no use as a source.
fn weight(reference: &Rigid, landmarks: &[DVec3], candidate: &Candidate) -> Option<f64> {
    let pose = &candidate.submap_from_cam;
    if !pose.is_finite()
        || !reference.is_finite()
        || !candidate.intrinsics.is_plausible()
        || landmarks.is_empty()
    {
        return None;
    }
    let cam_from_submap = pose.inverse();
    let (width, height) = (
        f64::from(candidate.intrinsics.width_px),
        f64::from(candidate.intrinsics.height_px),
    );
    let mut angles: Vec<f64> = landmarks
        .iter()
        .filter(|landmark| {
            let pixel = candidate
                .intrinsics
                .project(cam_from_submap.transform_point(**landmark));
            pixel.is_some_and(|p| p.x >= 0.0 && p.y >= 0.0 && p.x < width && p.y < height)
        })
        .map(|&landmark| {
            (landmark - reference.translation)
                .angle_between(landmark - pose.translation)
                .to_degrees()
        })
        .filter(|angle| angle.is_finite())
        .collect();
    let overlap = angles.len() as f64 / landmarks.len() as f64;
    if overlap < MIN_OVERLAP {
        return None;
    }
    let middle = angles.len() / 2;
    let (_, median, _) = angles.select_nth_unstable_by(middle, f64::total_cmp);
    if !ANGLE_RANGE_DEG.contains(median) {
        return None;
    }
    let off = *median - BEST_ANGLE_DEG;
    let sigma = if off < 0.0 { NARROW_DEG } else { WIDE_DEG };
    Some(overlap * (-0.5 * (off / sigma).powi(2)).exp())
}
