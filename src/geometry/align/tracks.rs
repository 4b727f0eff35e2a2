//! Matches between pairs of views -> tracks: one scene point, seen at most once in each view.

use glam::DVec3;

use super::Matched;
use crate::geometry::triangulate::{Sight, triangulate, widest_angle};
use crate::geometry::two_view::median;

/// Longer tracks say more: beyond so many, the shorter ones are left.
const MAX_TRACKS: usize = 1500;
/// Below this angle between its rays a point's depth is mostly noise.
const MIN_ANGLE_DEG: f64 = 1.0;

/// (view, feature) of each sight.
pub type Track = Vec<(usize, usize)>;

/// A track whose point fits all its sights.
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
    let mut counts = vec![0; matched.shots.len()];
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

/// Matches joined over all pairs, the longest first. A track that meets a view twice is a mistake somewhere and goes.
fn all_tracks(matched: &Matched) -> Vec<Track> {
    let mut first = Vec::with_capacity(matched.shots.len());
    let mut n = 0;
    for shot in &matched.shots {
        first.push(n);
        n += shot.pixels.len();
    }
    let mut parent: Vec<usize> = (0..n).collect();
    for pair in &matched.pairs {
        for &(i, j) in &pair.features {
            let a = root(&mut parent, first[pair.first] + i as usize);
            let b = root(&mut parent, first[pair.second] + j as usize);
            parent[a.max(b)] = a.min(b);
        }
    }
    let mut members: Vec<Track> = vec![Vec::new(); n];
    for (view, shot) in matched.shots.iter().enumerate() {
        for feature in 0..shot.pixels.len() {
            let root = root(&mut parent, first[view] + feature);
            members[root].push((view, feature));
        }
    }
    members.retain(|track| {
        let is_single = track.windows(2).all(|two| two[0].0 != two[1].0);
        track.len() >= 2 && is_single
    });
    // Stable: equals stay in the order of views and features.
    members.sort_by_key(|track| std::cmp::Reverse(track.len()));
    members
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
        let sights: Vec<Sight<'_>> = track.iter().map(|&at| sight(matched, at)).collect();
        let point = triangulate(&sights)?;
        let mut errors: Vec<f64> = sights.iter().map(|s| s.error_px(point)).collect();
        let is_good = errors.iter().all(|e| *e <= max_error_px);
        let centres: Vec<DVec3> = sights.iter().map(Sight::centre_in_map).collect();
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

pub fn sight(matched: &Matched, (view, feature): (usize, usize)) -> Sight<'_> {
    let shot = &matched.shots[view];
    Sight {
        cam_from_map: &shot.cam_from_batch,
        intrinsics: &shot.lens,
        pixel: shot.pixels[feature],
    }
}
