//! Matches between pairs of views -> tracks: one scene point, seen at most once in each view.

use glam::DVec3;

use crate::alignment::matched::Matched;
use crate::stats::median;
use crate::two_view::triangulate::{Observation, triangulate, widest_angle};

/// Longer tracks say more: beyond so many, the shorter ones are left.
const MAX_TRACKS: usize = 1500;
/// Below this angle between its rays a point's depth is mostly noise.
pub(crate) const MIN_ANGLE_DEG: f64 = 1.0;

/// (view, feature) of each observation.
pub type Track = Vec<(usize, usize)>;

/// A track whose point fits all its observations.
#[derive(Debug, Clone)]
pub struct Point {
    pub track: Track,
    pub point: DVec3,
    pub error_px: f64,
    pub angle_rad: f64,
}

/// The longest tracks of a window.
pub fn tracks(matched: &Matched) -> Vec<Track> {
    let mut tracks = all_tracks(matched);
    tracks.truncate(MAX_TRACKS);
    tracks
}

/// The longest tracks of many views, until each view has `per_view` of them or no more.
pub fn covering_tracks(matched: &Matched, per_view: usize) -> Vec<Track> {
    let mut counts = vec![0; matched.views.len()];
    let mut tracks = all_tracks(matched);
    tracks.retain(|track| {
        let is_wanted = track.iter().any(|&(view, _)| counts[view] < per_view);
        if is_wanted {
            track.iter().for_each(|&(view, _)| counts[view] += 1);
        }
        is_wanted
    });
    tracks
}

/// Matches joined over all pairs, the longest first. A match that would make a track meet a view twice is a mistake or
/// comes after one, and is left; pairs with the most matches are mistaken least and come first.
fn all_tracks(matched: &Matched) -> Vec<Track> {
    let mut first = Vec::with_capacity(matched.views.len());
    let mut members: Vec<Track> = Vec::new();
    for (view, aligned_view) in matched.views.iter().enumerate() {
        first.push(members.len());
        members.extend((0..aligned_view.pixels.len()).map(|feature| vec![(view, feature)]));
    }
    let mut parent: Vec<usize> = (0..members.len()).collect();
    let mut pairs: Vec<_> = matched.pairs.iter().collect();
    pairs.sort_by_key(|pair| std::cmp::Reverse(pair.features.len()));
    for pair in pairs {
        for &(i, j) in &pair.features {
            let a = root(&mut parent, first[pair.first] + i as usize);
            let b = root(&mut parent, first[pair.second] + j as usize);
            if a != b
                && let Some(both) = merged(&members[a], &members[b])
            {
                parent[a.max(b)] = a.min(b);
                members[a.max(b)] = Track::new();
                members[a.min(b)] = both;
            }
        }
    }
    members.retain(|track| track.len() >= 2);
    // Stable: equals stay in the order of views and features.
    members.sort_by_key(|track| std::cmp::Reverse(track.len()));
    members
}

/// Two tracks in order of views as one; `None` if they share a view.
fn merged(a: &Track, b: &Track) -> Option<Track> {
    let mut both = Track::with_capacity(a.len() + b.len());
    both.extend_from_slice(a);
    both.extend_from_slice(b);
    both.sort_unstable();
    let is_single = both.windows(2).all(|two| two[0].0 != two[1].0);
    is_single.then_some(both)
}

fn root(parent: &mut [usize], mut at: usize) -> usize {
    while parent[at] != at {
        parent[at] = parent[parent[at]];
        at = parent[at];
    }
    at
}

/// The points of the tracks at the present poses; those without depth, and with an error beyond the limit, are left out.
pub fn points(matched: &Matched, tracks: &[Track], max_error_px: f64) -> Vec<Point> {
    let point = |track: &Track| {
        let observations: Vec<Observation<'_>> =
            track.iter().map(|&at| observation(matched, at)).collect();
        let point = triangulate(&observations)?;
        let mut errors: Vec<f64> = observations.iter().map(|s| s.error_px(point)).collect();
        let is_good = errors.iter().all(|e| *e <= max_error_px);
        let centres: Vec<DVec3> = observations
            .iter()
            .map(Observation::centre_in_world)
            .collect();
        let angle_rad = widest_angle(&centres, point);
        let is_sharp = angle_rad >= MIN_ANGLE_DEG.to_radians();
        (is_good && is_sharp).then_some(Point {
            track: track.clone(),
            point,
            error_px: median(&mut errors)?,
            angle_rad,
        })
    };
    tracks.iter().filter_map(point).collect()
}

pub fn observation(matched: &Matched, (view, feature): (usize, usize)) -> Observation<'_> {
    let aligned_view = &matched.views[view];
    Observation {
        cam_from_world: &aligned_view.cam_from_submap,
        intrinsics: &aligned_view.lens,
        pixel: aligned_view.pixels[feature],
    }
}
