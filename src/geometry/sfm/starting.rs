//! Waiting shots -> a new component: the pair with most parallax, its landmarks, and all that can be placed on them.

use super::Limits;
use super::adjusting::{adjust_global, median_error_px};
use super::landmarks::extend;
use super::links::{pair_seed, pixel_pairs};
use super::placing::grow;
use super::scene::{Component, NONE, Scene};
use crate::geometry::triangulate::widest_angle;
use crate::geometry::two_view::{homography_share, median, motion};
use crate::pose::{Rigid, Similarity};

/// Pairs that are tried before waiting for more keyframes.
const MAX_ATTEMPTS: usize = 5;
/// More parallax than this is no better: wide views share fewer matches.
const ENOUGH_PARALLAX_DEG: f64 = 12.0;
/// Share of matches on one plane from which on a pair is a poor start: two motions explain it about equally well.
const PLANE_SHARE: f64 = 0.85;

/// What came of trying to start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Start {
    Started,
    /// No pair has matches enough.
    NoMatches,
    /// Pairs match, but their rays are parallel: the camera rests or only turns.
    NoParallax,
    /// There was parallax, but no pair gave a scene that held.
    Unstable,
}

/// Tries to start a component from waiting shots of `pool` with at least `min_shots` in it.
pub(super) fn start(scene: &mut Scene, pool: &[usize], min_shots: usize, limits: &Limits) -> Start {
    let waiting: Vec<usize> = pool.iter().copied().filter(|&s| scene.shots[s].placed.is_none()).collect();
    let (pairs, has_matches) = ranked_pairs(scene, &waiting, limits);
    if pairs.is_empty() {
        return if has_matches { Start::NoParallax } else { Start::NoMatches };
    }
    for (_, a, b) in pairs.into_iter().take(MAX_ATTEMPTS) {
        if attempt(scene, &waiting, (a, b), min_shots, limits) {
            return Start::Started;
        }
    }
    Start::Unstable
}

/// Pairs with parallax, best first, and whether any pair had matches enough.
fn ranked_pairs(scene: &mut Scene, waiting: &[usize], limits: &Limits) -> (Vec<(f64, usize, usize)>, bool) {
    let mut pairs = Vec::new();
    let mut has_matches = false;
    let keys: Vec<(usize, usize)> = scene.links.keys().copied().collect();
    for (a, b) in keys.into_iter().filter(|(a, b)| waiting.contains(a) && waiting.contains(b)) {
        let link = &scene.links[&(a, b)];
        let n = link.matches.len();
        if n < limits.min_inliers {
            continue;
        }
        has_matches = true;
        let seed = pair_seed(limits.seed, a, b);
        let pixels = pixel_pairs(&scene.shots[a], &scene.shots[b], &link.matches);
        let lenses = [&scene.shots[a].lens, &scene.shots[b].lens];
        let found = link.motion.or_else(|| {
            motion(&pixels, lenses, limits.max_error_px, seed).map(|m| (m.second_from_first, m.parallax_deg))
        });
        let Some((pose, parallax)) = found else { continue };
        if parallax < limits.min_parallax_deg {
            continue;
        }
        let plane = homography_share(&pixels, limits.max_error_px, seed);
        let is_calibrated = scene.shots[a].is_calibrated && scene.shots[b].is_calibrated;
        // With a wrong focal length a mere turn looks like parallax.
        if plane > PLANE_SHARE && !is_calibrated && scene.components.is_empty() {
            continue;
        }
        let flat = if plane > PLANE_SHARE { 0.1 } else { 1.0 };
        pairs.push((flat * n as f64 * parallax.min(ENOUGH_PARALLAX_DEG), a, b));
        if let Some(link) = scene.links.get_mut(&(a, b)) {
            link.motion = Some((pose, parallax));
        }
    }
    pairs.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    (pairs, has_matches)
}

fn attempt(scene: &mut Scene, waiting: &[usize], (a, b): (usize, usize), min_shots: usize, limits: &Limits) -> bool {
    let Some((pose, _)) = scene.links[&(a, b)].motion else { return false };
    let component = scene.components.len() as u32;
    scene.components.push(Component::default());
    scene.place(a, component, Rigid::IDENTITY);
    scene.place(b, component, pose);
    extend(scene, b, limits.max_error_px);
    adjust_global(scene, component, limits.max_error_px, 15);
    extend(scene, b, limits.max_error_px);
    let n = scene.landmarks_of(&[a, b]).len();
    if n >= limits.min_inliers && parallax_deg(scene, b) >= limits.min_parallax_deg {
        for &shot in waiting {
            scene.shots[shot].failed_with = 0;
        }
        grow(scene, waiting, limits);
        adjust_global(scene, component, limits.max_error_px, 15);
        let shots = &scene.components[component as usize].shots;
        if shots.len() >= min_shots && median_error_px(scene, shots) <= 0.75 * limits.max_error_px {
            normalise(scene, component, a);
            return true;
        }
    }
    scene.dissolve(component);
    false
}

/// Median of the widest angles at which the landmarks of a shot are seen.
pub(super) fn parallax_deg(scene: &Scene, shot_ix: usize) -> f64 {
    let seen = scene.shots[shot_ix].landmark_of.iter().filter(|l| **l != NONE);
    let angle = |&l: &u32| {
        let landmark = &scene.landmarks[l as usize];
        let centres: Vec<_> = landmark.seen.iter().filter_map(|at| scene.centre(at.0 as usize)).collect();
        widest_angle(&centres, landmark.point).to_degrees()
    };
    median(&mut seen.map(angle).collect::<Vec<f64>>()).unwrap_or(0.0)
}

/// Median depth in the first shot becomes 1.
fn normalise(scene: &mut Scene, component: u32, first: usize) {
    if let Some(depth) = median(&mut scene.depths(first)).filter(|d| *d > 0.0) {
        scene.transform(component, &Similarity { scale: 1.0 / depth, ..Similarity::IDENTITY });
    }
}
