//! Two components that see the same landmarks -> one, by the similarity that their landmarks agree on.

use std::collections::BTreeMap;

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::Limits;
use super::adjusting::adjust_global;
use super::landmarks::join;
use super::links::pair_seed;
use super::scene::{NONE, Scene};
use crate::geometry::umeyama::aligned;
use crate::pose::Similarity;

const TRIES: usize = 300;
/// Share of the landmarks in common: two parts of one room measured 0.56 to 0.86 (kitchen7s, 16 joins and loops). Where the
/// parts are of few keyframes a fourth of them agrees on a wrong place, too.
const MIN_AGREEING: f64 = 0.5;

/// Merges until nothing fits any more. The component with the lower number stays.
pub(super) fn merge(scene: &mut Scene, limits: &Limits) -> bool {
    let mut merged = false;
    let n = scene.components.len() as u32;
    for stays in 0..n {
        for gone in stays + 1..n {
            merged |= merge_pair(scene, stays, gone, limits);
        }
    }
    merged
}

fn merge_pair(scene: &mut Scene, stays: u32, gone: u32, limits: &Limits) -> bool {
    if scene.components[stays as usize].shots.is_empty()
        || scene.components[gone as usize].shots.is_empty()
    {
        return false;
    }
    let pairs = common_landmarks(scene, stays, gone);
    if pairs.len() < limits.min_inliers {
        return false;
    }
    let Some((stays_from_gone, inliers)) = similarity(
        scene,
        &pairs,
        limits,
        pair_seed(limits.seed, stays as usize, gone as usize),
    ) else {
        return false;
    };
    scene.transform(gone, &stays_from_gone);
    let shots = std::mem::take(&mut scene.components[gone as usize].shots);
    for landmark in scene.landmarks_of(&shots) {
        scene.landmarks[landmark as usize].component = stays;
    }
    for &shot in &shots {
        if let Some(placed) = &mut scene.shots[shot].placed {
            placed.component = stays;
        }
    }
    scene.components[stays as usize].shots.extend(shots);
    for ix in inliers {
        let (a, b) = pairs[ix];
        if !scene.landmarks[a as usize].seen.is_empty()
            && !scene.landmarks[b as usize].seen.is_empty()
        {
            join(scene, a, b, 2.0 * limits.max_error_px);
        }
    }
    adjust_global(scene, stays, limits.max_error_px, 15);
    true
}

/// Landmarks of two components that matches name as one: (of `a`, of `b`), each at most once.
fn common_landmarks(scene: &Scene, a: u32, b: u32) -> Vec<(u32, u32)> {
    let mut votes: BTreeMap<(u32, u32), usize> = BTreeMap::new();
    for &shot in &scene.components[b as usize].shots {
        for (feature, &landmark) in scene.shots[shot]
            .landmark_of
            .iter()
            .enumerate()
            .filter(|(_, l)| **l != NONE)
        {
            for &(s, f) in &scene.shots[shot].matched[feature] {
                let other = scene.shots[s as usize].landmark_of[f as usize];
                if other != NONE && scene.landmarks[other as usize].component == a {
                    *votes.entry((other, landmark)).or_insert(0) += 1;
                }
            }
        }
    }
    let mut ranked: Vec<((u32, u32), usize)> = votes.into_iter().collect();
    ranked.sort_by(|x, y| y.1.cmp(&x.1).then(x.0.cmp(&y.0)));
    let (mut taken_a, mut taken_b) = (
        std::collections::BTreeSet::new(),
        std::collections::BTreeSet::new(),
    );
    ranked.retain(|((l, m), _)| {
        !taken_a.contains(l) && !taken_b.contains(m) && taken_a.insert(*l) && taken_b.insert(*m)
    });
    ranked.into_iter().map(|r| r.0).collect()
}

/// RANSAC over three landmarks; a pair agrees when each point projects to the sights of its partner.
pub(super) fn similarity(
    scene: &Scene,
    pairs: &[(u32, u32)],
    limits: &Limits,
    seed: u64,
) -> Option<(Similarity, Vec<usize>)> {
    let point = |l: u32| scene.landmarks[l as usize].point;
    let fits = |s: &Similarity, (a, b): (u32, u32)| {
        let limit = 3.0 * limits.max_error_px;
        let error = |point: DVec3, seen: &[(u32, u32)]| {
            seen.iter()
                .filter_map(|&at| scene.sight(at))
                .all(|sight| sight.error_px(point) <= limit)
        };
        error(
            s.transform_point(point(b)),
            &scene.landmarks[a as usize].seen,
        ) && error(
            s.inverse().transform_point(point(a)),
            &scene.landmarks[b as usize].seen,
        )
    };
    let agreeing = |s: &Similarity| -> Vec<usize> {
        (0..pairs.len()).filter(|&i| fits(s, pairs[i])).collect()
    };
    let mut rng = Pcg32::seed_from_u64(seed);
    let mut best: (Vec<usize>, Similarity) = (Vec::new(), Similarity::IDENTITY);
    for _ in 0..TRIES {
        let sample: [(u32, u32); 3] =
            std::array::from_fn(|_| pairs[rng.random_range(0..pairs.len())]);
        let Some(s) = aligned(&sample.map(|(a, b)| (point(a), point(b)))) else {
            continue;
        };
        let inliers = agreeing(&s);
        if inliers.len() > best.0.len() {
            best = (inliers, s);
        }
    }
    for _ in 0..2 {
        let picked: Vec<(DVec3, DVec3)> = best
            .0
            .iter()
            .map(|&i| (point(pairs[i].0), point(pairs[i].1)))
            .collect();
        let Some(s) = aligned(&picked) else { break };
        let inliers = agreeing(&s);
        if inliers.len() < best.0.len() {
            break;
        }
        best = (inliers, s);
    }
    tracing::debug!("{} of {} common landmarks agree", best.0.len(), pairs.len());
    let share = best.0.len() as f64 / pairs.len() as f64;
    let enough = best.0.len() >= limits.min_inliers && share >= MIN_AGREEING;
    enough.then_some((best.1, best.0))
}
