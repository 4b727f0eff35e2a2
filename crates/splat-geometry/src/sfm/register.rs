//! Waiting views -> poses in a submap, best supported first; each one brings landmarks and a local adjustment.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use crate::pnp;
use crate::sfm::adjust::{adjust_global, adjust_local};
use crate::sfm::landmarks::extend;
use crate::sfm::limits::Limits;
use crate::sfm::metric_submap::drop_wrong_depth;
use crate::sfm::overlap::overlap_with;
use crate::sfm::pairwise::{pair_seed, release};
use crate::sfm::reconstruction::{NONE, Reconstruction};
use splat_types::transform::Rigid;

/// Share of the candidate landmarks that must agree with a pose; and where there are fewer than `Limits::min_inliers` of them,
/// down to half as many: an image of little texture has no more.
const MIN_SHARE: f64 = 0.25;
const MIN_SHARE_OF_FEW: f64 = 0.6;
/// Candidate landmarks, in `Limits::min_inliers`, below which a view is compared with older ones before it is registered.
const CLEAR: usize = 3;
/// Matches of a held link that speak against registering a view by other links alone, in landmarks that those name.
const CLEARER: usize = 2;
/// Views so near in order are of one stretch of the way, where nothing is taken for another thing that looks like it.
const NEAR_VIEWS: usize = 8;
/// Older views that one without such neighbours is compared with.
const N_COMPARED: usize = 3;
/// Growth of a submap after which all its views are adjusted together.
const GLOBAL_GROWTH: f64 = 1.3;
/// Of fewer views that takes no longer than a few keyframes do, so that it is never left to another thread.
const MAX_SMALL: usize = 24;
/// A view whose landmarks all lie in a smaller part of the image (standard deviation as a share of the longer
/// side) could slide or turn freely.
const MIN_SPREAD: f64 = 0.03;

/// Views that wait and match an old view far better than the last ones are registered by that, too. A camera that is back from
/// elsewhere shares a few landmarks with the last keyframes, seen from far aside, and most with older ones: the few alone have
/// put it 5 % of the path off, at residuals of half a pixel.
pub(crate) fn release_clearer(scene: &mut Reconstruction) {
    let is_clearer = |&(older, newer): &(usize, usize)| {
        let is_next = scene.views[newer].registered.is_none() && scene.submap_of(older).is_some();
        let n_landmarks = || best_submap(scene, newer).map_or(0, |(_, n)| n);
        is_next && scene.held[&(older, newer)].matches.len() > CLEARER * n_landmarks()
    };
    let ends: Vec<(usize, usize)> = scene.held.keys().copied().filter(is_clearer).collect();
    ends.into_iter().for_each(|e| release(scene, e));
}

/// Places as many of the waiting views of `pool` as can be registered, and adjusts about each.
pub(crate) fn grow(scene: &mut Reconstruction, pool: &[usize], limits: &Limits) {
    let min_pairs = limits.min_inliers / 2;
    while let Some(registered) = register_best(scene, pool, limits, min_pairs) {
        adjust_about(scene, &[registered], limits);
    }
}

/// The same sooner, for views that share many landmarks with a submap: their neighbourhood is adjusted once, when all are
/// registered.
pub(crate) fn grow_at_once(scene: &mut Reconstruction, pool: &[usize], limits: &Limits) {
    let min_pairs = CLEAR * limits.min_inliers;
    let registered: Vec<Registered> =
        std::iter::from_fn(|| register_best(scene, pool, limits, min_pairs)).collect();
    adjust_about(scene, &registered, limits);
}

/// A view with its first pose, and the number of matches that spoke for it.
struct Registered {
    view: usize,
    submap: u32,
    n_pairs: usize,
}

/// Gives the best supported of the waiting views a pose, and new landmarks by it. `None`: there is none left.
fn register_best(
    scene: &mut Reconstruction,
    pool: &[usize],
    limits: &Limits,
    min_pairs: usize,
) -> Option<Registered> {
    while let Some((view, submap, pairs)) = best_waiting(scene, pool, min_pairs) {
        let n_pairs = pairs.len();
        let Some(cam_from_world) = pose(scene, view, &pairs, limits) else {
            scene.views[view].failed_with = n_pairs;
            continue;
        };
        if !is_there(scene, view, &cam_from_world, &pairs, limits) {
            scene.views[view].failed_with = n_pairs;
            continue;
        }
        drop_wrong_depth(scene, view, submap, &cam_from_world, &pairs);
        scene.place(view, submap, cam_from_world);
        extend(scene, view, limits.max_error_px);
        return Some(Registered {
            view,
            submap,
            n_pairs,
        });
    }
    None
}

/// Whether a view that only views long before speak for shows what they show; those just before it need no such check.
fn is_there(
    scene: &Reconstruction,
    view: usize,
    cam_from_world: &Rigid,
    pairs: &[(u32, u32)],
    limits: &Limits,
) -> bool {
    let seen = pairs.iter().flat_map(|&(_, landmark)| {
        let seen = scene.landmarks[landmark as usize].seen.iter();
        seen.map(|&(other, _)| other as usize)
    });
    let near = seen.clone().filter(|o| o.abs_diff(view) <= NEAR_VIEWS);
    if near.take(limits.min_inliers).count() == limits.min_inliers {
        return true;
    }
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    for other in seen {
        *counts.entry(other).or_insert(0) += 1;
    }
    let mut others: Vec<(usize, usize)> = counts.into_iter().map(|(o, n)| (n, o)).collect();
    others.sort_unstable_by(|a, b| b.cmp(a));
    let others: Vec<usize> = others.into_iter().take(N_COMPARED).map(|o| o.1).collect();
    let overlap = overlap_with(scene, &others, (view, cam_from_world), limits.max_error_px);
    tracing::debug!(view, ?others, ?overlap, "a view by others long before");
    overlap.is_one_place()
}

/// Adjusts about the last of the views that were registered; those whose landmarks are thrown out again wait on.
fn adjust_about(scene: &mut Reconstruction, registered: &[Registered], limits: &Limits) {
    let Some(last) = registered.last() else {
        return;
    };
    adjust_local(scene, last.view, limits);
    for registered in registered {
        let landmarks = scene.views[registered.view].landmark_of.iter();
        let n_left = landmarks.filter(|l| **l != NONE).count();
        // Landmarks that the adjustment threw out again spoke for a wrong pose.
        if 3 * n_left < 2 * limits.min_inliers {
            scene.unplace(registered.view);
            scene.views[registered.view].failed_with = registered.n_pairs;
        }
    }
    let size = &scene.submaps[last.submap as usize];
    let is_deferred = limits.is_global_deferred && size.views.len() > MAX_SMALL;
    if size.views.len() as f64 >= GLOBAL_GROWTH * size.n_adjusted as f64 && !is_deferred {
        adjust_global(scene, last.submap, limits.max_error_px, 8);
    }
}

/// Features of a view whose matches have landmarks in a submap: (feature, landmark), the most named one each.
pub(crate) fn correspondences(
    scene: &Reconstruction,
    view_ix: usize,
    submap: u32,
) -> Vec<(u32, u32)> {
    let mut pairs = Vec::new();
    for (feature, matched) in scene.views[view_ix].matched.iter().enumerate() {
        let owners = matched
            .iter()
            .map(|&(s, f)| scene.views[s as usize].landmark_of[f as usize]);
        let mut named: Vec<u32> = owners.filter(|&l| l != NONE).collect();
        named.retain(|&l| scene.landmarks[l as usize].submap == submap);
        named.sort_unstable();
        let count = |l: &u32| named.iter().filter(|n| *n == l).count();
        if let Some(best) = named.iter().rev().max_by_key(|l| count(l)) {
            pairs.push((feature as u32, *best));
        }
    }
    pairs
}

type Waiting = (usize, u32, Vec<(u32, u32)>);

/// The waiting view with most landmarks in one submap, `min_pairs` at least; one that failed needs a fifth more than then.
fn best_waiting(scene: &Reconstruction, pool: &[usize], min_pairs: usize) -> Option<Waiting> {
    let mut best: Option<Waiting> = None;
    for &view in pool
        .iter()
        .filter(|&&s| scene.views[s].registered.is_none())
    {
        let Some((submap, n)) = best_submap(scene, view) else {
            continue;
        };
        let needed = min_pairs.max(scene.views[view].failed_with * 6 / 5 + 1);
        if n >= needed && best.as_ref().is_none_or(|b| n > b.2.len()) {
            best = Some((view, submap, correspondences(scene, view, submap)));
        }
    }
    best
}

/// The submap in which most features of a view have landmarks by their matches, and their number.
fn best_submap(scene: &Reconstruction, view_ix: usize) -> Option<(u32, usize)> {
    let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
    let mut named = Vec::new();
    for matched in &scene.views[view_ix].matched {
        let owners = matched
            .iter()
            .map(|&(s, f)| scene.views[s as usize].landmark_of[f as usize]);
        named.clear();
        named.extend(
            owners
                .filter(|&l| l != NONE)
                .map(|l| scene.landmarks[l as usize].submap),
        );
        named.sort_unstable();
        named.dedup();
        for submap in &named {
            *counts.entry(*submap).or_insert(0) += 1;
        }
    }
    // Of as many in two, the older submap.
    counts.into_iter().rev().max_by_key(|count| count.1)
}

fn pose(
    scene: &Reconstruction,
    view_ix: usize,
    pairs: &[(u32, u32)],
    limits: &Limits,
) -> Option<Rigid> {
    let view = &scene.views[view_ix];
    let points: Vec<DVec3> = pairs
        .iter()
        .map(|p| scene.landmarks[p.1 as usize].point)
        .collect();
    let pixels: Vec<DVec2> = pairs
        .iter()
        .map(|p| view.features.pixels[p.0 as usize])
        .collect();
    let seed = pair_seed(limits.seed, view_ix, pairs.len());
    let found = pnp::place(
        &points,
        &pixels,
        &view.lens,
        (1.5 * limits.max_error_px, limits.min_inliers / 2),
        seed,
    )?;
    let share = found.inliers.len() as f64 / pairs.len() as f64;
    let min_share = if found.inliers.len() < limits.min_inliers {
        MIN_SHARE_OF_FEW
    } else {
        MIN_SHARE
    };
    let picked: Vec<DVec2> = found.inliers.iter().map(|&i| pixels[i]).collect();
    let longest = f64::from(view.lens.width_px.max(view.lens.height_px));
    (share >= min_share && spread(&picked) >= MIN_SPREAD * longest).then_some(found.cam_from_world)
}

fn spread(pixels: &[DVec2]) -> f64 {
    let n = pixels.len().max(1) as f64;
    let mean = pixels.iter().sum::<DVec2>() / n;
    (pixels.iter().map(|p| p.distance_squared(mean)).sum::<f64>() / n).sqrt()
}
