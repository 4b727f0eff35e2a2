//! Matches between placed shots -> landmarks: made, extended, joined and thrown away by what their pixels say.

use glam::DVec3;

use super::scene::{NONE, Scene};
use crate::geometry::triangulate::{Sight, triangulate, widest_angle};

/// Below this angle between its rays a point's depth is mostly noise.
const MIN_ANGLE_DEG: f64 = 1.0;

/// Gives the features of a placed shot landmarks: those of its matches, or new ones.
pub(super) fn extend(scene: &mut Scene, shot_ix: usize, max_error_px: f64) {
    for feature in 0..scene.shots[shot_ix].landmark_of.len() {
        let at = (shot_ix as u32, feature as u32);
        if scene.shots[shot_ix].landmark_of[feature] == NONE {
            adopt(scene, at, max_error_px);
        }
        if scene.shots[shot_ix].landmark_of[feature] == NONE {
            create(scene, at, max_error_px);
        } else {
            complete(scene, at, max_error_px);
        }
    }
}

/// Takes the landmark of a match if it projects to this feature.
fn adopt(scene: &mut Scene, at: (u32, u32), max_error_px: f64) {
    let component = scene.component_of(at.0 as usize);
    let matched = &scene.shots[at.0 as usize].matched[at.1 as usize];
    let owners = matched
        .iter()
        .map(|&(s, f)| scene.shots[s as usize].landmark_of[f as usize]);
    let mut candidates: Vec<u32> = owners.filter(|&l| l != NONE).collect();
    candidates.sort_unstable();
    candidates.dedup();
    candidates.retain(|&l| Some(scene.landmarks[l as usize].component) == component);
    let Some(sight) = scene.sight(at) else { return };
    let error = |l: &u32| sight.error_px(scene.landmarks[*l as usize].point);
    let best = candidates
        .iter()
        .map(|l| (error(l), *l))
        .min_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((error, landmark)) = best.filter(|b| b.0 <= max_error_px) {
        debug_assert!(error.is_finite());
        scene.add_sight(landmark, at);
    }
}

/// Hands a feature's landmark on to its matches, and joins it with theirs where both are the same point.
fn complete(scene: &mut Scene, at: (u32, u32), max_error_px: f64) {
    let own = scene.shots[at.0 as usize].landmark_of[at.1 as usize];
    let component = scene.landmarks[own as usize].component;
    for (shot, feature) in scene.shots[at.0 as usize].matched[at.1 as usize].clone() {
        if scene.component_of(shot as usize) != Some(component) {
            continue;
        }
        let theirs = scene.shots[shot as usize].landmark_of[feature as usize];
        let point = scene.landmarks[own as usize].point;
        if theirs == NONE {
            let fits = scene
                .sight((shot, feature))
                .is_some_and(|s| s.error_px(point) <= max_error_px);
            if fits {
                scene.add_sight(own, (shot, feature));
            }
        } else if theirs != own && scene.landmarks[theirs as usize].component == component {
            join(scene, own, theirs, max_error_px);
        }
    }
}

/// Joins two landmarks if one point fits the sights of both.
pub(super) fn join(scene: &mut Scene, a: u32, b: u32, max_error_px: f64) {
    let (first, second) = (&scene.landmarks[a as usize], &scene.landmarks[b as usize]);
    let (n, m) = (first.seen.len() as f64, second.seen.len() as f64);
    let point = (first.point * n + second.point * m) / (n + m);
    let mut sights = first
        .seen
        .iter()
        .chain(&second.seen)
        .filter_map(|&at| scene.sight(at));
    if sights.all(|s| s.error_px(point) <= max_error_px) {
        scene.landmarks[a as usize].point = point;
        scene.join_landmarks(a, b);
    }
}

/// A new landmark from a feature and its matches in placed shots.
fn create(scene: &mut Scene, at: (u32, u32), max_error_px: f64) {
    let Some(component) = scene.component_of(at.0 as usize) else {
        return;
    };
    let free = |m: &&(u32, u32)| {
        scene.component_of(m.0 as usize) == Some(component)
            && scene.shots[m.0 as usize].landmark_of[m.1 as usize] == NONE
    };
    let mut seen = vec![at];
    for m in scene.shots[at.0 as usize].matched[at.1 as usize]
        .iter()
        .filter(free)
    {
        if seen.iter().all(|s| s.0 != m.0) {
            seen.push(*m);
        }
    }
    if let Some((point, seen)) = agreeing_point(scene, &seen, max_error_px) {
        scene.add_landmark(point, component, seen);
    }
}

/// The point that most of the sights agree on, if they see it from far enough apart. The first one must agree.
fn agreeing_point(
    scene: &Scene,
    seen: &[(u32, u32)],
    max_error_px: f64,
) -> Option<(DVec3, Vec<(u32, u32)>)> {
    let sights: Vec<Sight<'_>> = seen.iter().filter_map(|&at| scene.sight(at)).collect();
    if sights.len() < 2 || sights.len() != seen.len() {
        return None;
    }
    let mut best: Option<(DVec3, Vec<usize>)> = None;
    for other in 1..sights.len() {
        let Some(point) = triangulate(&[sights[0], sights[other]]) else {
            continue;
        };
        let fits: Vec<usize> = (0..sights.len())
            .filter(|&i| sights[i].error_px(point) <= max_error_px)
            .collect();
        let agrees = fits.contains(&0) && fits.len() >= 2;
        if agrees && best.as_ref().is_none_or(|b| fits.len() > b.1.len()) {
            best = Some((point, fits));
        }
    }
    let (_, fits) = best?;
    let picked: Vec<Sight<'_>> = fits.iter().map(|&i| sights[i]).collect();
    let point = triangulate(&picked)?;
    let centres: Vec<DVec3> = picked.iter().map(Sight::centre_in_map).collect();
    let is_sharp = widest_angle(&centres, point) >= MIN_ANGLE_DEG.to_radians();
    let fit_all = picked.iter().all(|s| s.error_px(point) <= max_error_px);
    (is_sharp && fit_all).then(|| (point, fits.iter().map(|&i| seen[i]).collect()))
}

/// Drops sights that do not fit their landmark, and landmarks without depth.
pub(super) fn filter(scene: &mut Scene, landmarks: &[u32], max_error_px: f64) {
    for &landmark in landmarks {
        let (point, seen) = {
            let l = &scene.landmarks[landmark as usize];
            (l.point, l.seen.clone())
        };
        let fits = |at: &(u32, u32)| {
            scene
                .sight(*at)
                .is_some_and(|s| s.error_px(point) <= max_error_px)
        };
        let kept: Vec<(u32, u32)> = seen.iter().copied().filter(fits).collect();
        let centres: Vec<DVec3> = kept
            .iter()
            .filter_map(|at| scene.centre(at.0 as usize))
            .collect();
        let is_sharp =
            point.is_finite() && widest_angle(&centres, point) >= 0.7 * MIN_ANGLE_DEG.to_radians();
        if !is_sharp || kept.len() < seen.len() {
            scene.retain_sights(landmark, |at| is_sharp && kept.contains(at));
        }
    }
}
