//! Two submaps that see the same landmarks -> one, by the similarity that their landmarks agree on.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::ransac::{self, Tries};
use crate::sfm::adjust::adjust_global;
use crate::sfm::landmarks::join;
use crate::sfm::limits::Limits;
use crate::sfm::overlap::overlap;
use crate::sfm::pairwise::pair_seed;
use crate::sfm::reconstruction::{NONE, Reconstruction};
use crate::similarity;
use splat_types::transform::Similarity;

const TRIES: usize = 300;
/// Share of the landmarks in common: two parts of one room measured 0.56 to 0.86 (kitchen7s, 16 joins and loops). Where the
/// parts are of few keyframes a fourth of them agrees on a wrong place, too.
const MIN_INLIERS: f64 = 0.5;
/// Pairs of views that are compared before two submaps are one.
const N_COMPARED: usize = 6;

/// Merges the submaps that fit, of those that have come to share matches since the last call; again, until it answers
/// `false`. The submap with the lower number stays.
pub(crate) fn merge(scene: &mut Reconstruction, limits: &Limits) -> bool {
    let mut merged = false;
    for (stays, gone) in submaps_in_touch(scene) {
        merged |= merge_pair(scene, stays, gone, limits);
    }
    merged
}

/// Submaps that a match of a view of `unmerged` leads to, in order; of all other pairs nothing has changed.
fn submaps_in_touch(scene: &mut Reconstruction) -> BTreeSet<(u32, u32)> {
    let mut pairs = BTreeSet::new();
    for view_ix in std::mem::take(&mut scene.unmerged) {
        let view = &scene.views[view_ix];
        let Some(own) = scene.submap_of(view_ix) else {
            continue;
        };
        let named = view.landmark_of.iter().zip(&view.matched);
        let matched = named
            .filter(|(landmark, _)| **landmark != NONE)
            .flat_map(|(_, matched)| matched);
        for &(other, feature) in matched {
            let landmark = scene.views[other as usize].landmark_of[feature as usize];
            if landmark != NONE {
                let other = scene.landmarks[landmark as usize].submap;
                pairs.insert((own.min(other), own.max(other)));
            }
        }
    }
    pairs.retain(|(a, b)| a != b);
    pairs
}

fn merge_pair(scene: &mut Reconstruction, stays: u32, gone: u32, limits: &Limits) -> bool {
    if scene.submaps[stays as usize].views.is_empty()
        || scene.submaps[gone as usize].views.is_empty()
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
    let views = views_in_common(scene, inliers.iter().map(|ix| pairs[*ix]));
    let overlap = overlap(scene, &views, &stays_from_gone, limits.max_error_px);
    tracing::debug!(
        stays,
        gone,
        n = inliers.len(),
        ?overlap,
        "submaps that share landmarks"
    );
    if !overlap.is_one_place() {
        return false;
    }
    scene.absorb(stays, gone, &stays_from_gone);
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

/// The pairs of views that see most of the landmarks in common.
pub(crate) fn views_in_common(
    scene: &Reconstruction,
    pairs: impl Iterator<Item = (u32, u32)>,
) -> Vec<(usize, usize)> {
    let seen = |landmark: u32| scene.landmarks[landmark as usize].seen.iter();
    let mut counts: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for (a, b) in pairs {
        for (first, _) in seen(a) {
            for (second, _) in seen(b) {
                *counts
                    .entry((*first as usize, *second as usize))
                    .or_insert(0) += 1;
            }
        }
    }
    let mut ranked: Vec<(usize, (usize, usize))> =
        counts.into_iter().map(|(v, n)| (n, v)).collect();
    ranked.sort_by(|x, y| y.0.cmp(&x.0).then(x.1.cmp(&y.1)));
    ranked.truncate(N_COMPARED);
    ranked.into_iter().map(|r| r.1).collect()
}

/// Landmarks of two submaps that matches name as one: (of `a`, of `b`), each at most once.
fn common_landmarks(scene: &Reconstruction, a: u32, b: u32) -> Vec<(u32, u32)> {
    let mut votes: BTreeMap<(u32, u32), usize> = BTreeMap::new();
    for &view in &scene.submaps[b as usize].views {
        for (feature, &landmark) in scene.views[view]
            .landmark_of
            .iter()
            .enumerate()
            .filter(|(_, l)| **l != NONE)
        {
            for &(s, f) in &scene.views[view].matched[feature] {
                let other = scene.views[s as usize].landmark_of[f as usize];
                if other != NONE && scene.landmarks[other as usize].submap == a {
                    *votes.entry((other, landmark)).or_insert(0) += 1;
                }
            }
        }
    }
    let mut ranked: Vec<((u32, u32), usize)> = votes.into_iter().collect();
    ranked.sort_by(|x, y| y.1.cmp(&x.1).then(x.0.cmp(&y.0)));
    let (mut taken_a, mut taken_b) = (BTreeSet::new(), BTreeSet::new());
    ranked.retain(|((l, m), _)| {
        !taken_a.contains(l) && !taken_b.contains(m) && taken_a.insert(*l) && taken_b.insert(*m)
    });
    ranked.into_iter().map(|r| r.0).collect()
}

/// RANSAC over three landmarks; a pair agrees when each point projects to the observations of its partner.
pub(crate) fn similarity(
    scene: &Reconstruction,
    pairs: &[(u32, u32)],
    limits: &Limits,
    seed: u64,
) -> Option<(Similarity, Vec<usize>)> {
    let point = |l: u32| scene.landmarks[l as usize].point;
    let fits = |s: &Similarity, (a, b): (u32, u32)| {
        let limit = 3.0 * limits.max_error_px;
        let error = |point: DVec3, seen: &[(u32, u32)]| {
            seen.iter()
                .filter_map(|&at| scene.observation(at))
                .all(|observation| observation.error_px(point) <= limit)
        };
        error(
            s.transform_point(point(b)),
            &scene.landmarks[a as usize].seen,
        ) && error(
            s.inverse().transform_point(point(a)),
            &scene.landmarks[b as usize].seen,
        )
    };
    let inlier_ixs = |s: &Similarity| -> Vec<usize> {
        (0..pairs.len()).filter(|&i| fits(s, pairs[i])).collect()
    };
    let points = |i: usize| (point(pairs[i].0), point(pairs[i].1));
    let models = |sample: [usize; 3]| similarity::of_points(&sample.map(points));
    let loss = |s: &Similarity, _| Some((pairs.len() - inlier_ixs(s).len()) as f64);
    let mut rng = Pcg32::seed_from_u64(seed);
    let (found, _) = ransac::search(&mut rng, pairs.len(), &Tries::fixed(TRIES), models, loss)?;
    let inliers = inlier_ixs(&found);
    let fit = |inliers: &[usize]| {
        let picked: Vec<(DVec3, DVec3)> = inliers.iter().map(|&i| points(i)).collect();
        similarity::of_points(&picked)
    };
    let (found, inliers) = ransac::refit((found, inliers), 2, fit, inlier_ixs);
    tracing::debug!(
        "{} of {} common landmarks agree",
        inliers.len(),
        pairs.len()
    );
    let share = inliers.len() as f64 / pairs.len() as f64;
    let enough = inliers.len() >= limits.min_inliers && share >= MIN_INLIERS;
    enough.then_some((found, inliers))
}
