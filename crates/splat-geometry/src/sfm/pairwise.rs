//! A new view -> verified matches with the views before it: the last few, and those that look alike.

use glam::DVec2;
use rayon::prelude::*;

use crate::matching::{PreparedDescriptors, matches};
use crate::sfm::landmarks::extend;
use crate::sfm::reconstruction::{PairMatches, Reconstruction, SfmView};
use crate::two_view::epipolar::{fundamental, motion};

/// Views just before a new one that are always compared with it.
const N_RECENT: usize = 6;
/// Older views that look alike and are compared, too: jumps and loops need them.
const N_ALIKE: usize = 4;
/// Matching signatures below which two images do not look alike.
const MIN_VOTES: usize = 6;
/// Older views asked for likeness; beyond it they are taken evenly.
const MAX_ASKED: usize = 600;
/// Views up to which all are linked anew when the lens turns out to bend.
const MAX_ANEW: usize = 64;
/// Verified matches that make a link; fewer are as likely chance.
const MIN_LINK: usize = 15;

/// Links a view to those just before it.
pub(crate) fn link_recent(
    scene: &mut Reconstruction,
    view_ix: usize,
    max_error_px: f64,
    seed: u64,
) {
    link_last(scene, view_ix, N_RECENT, max_error_px, seed);
}

/// Links a view to so many just before it, at most as many as `link_recent` takes.
pub(crate) fn link_last(
    scene: &mut Reconstruction,
    view_ix: usize,
    n_last: usize,
    max_error_px: f64,
    seed: u64,
) {
    let first = view_ix.saturating_sub(n_last.min(N_RECENT));
    let others: Vec<usize> = (first..view_ix).collect();
    link(scene, view_ix, &others, max_error_px, seed);
}

/// Links a view to those long before that look like it.
pub(crate) fn link_older(scene: &mut Reconstruction, view_ix: usize, max_error_px: f64, seed: u64) {
    let others = alike(scene, view_ix, view_ix.saturating_sub(N_RECENT));
    for (other, found) in found(scene, view_ix, &others, max_error_px, seed) {
        if scene.submaps.is_empty() {
            insert(scene, view_ix, other, found);
        } else {
            scene.held.insert((other, view_ix), found);
        }
    }
}

/// Matches of a distorted lens were verified as a pinhole's, which lost those near the rim: all are made again, and the
/// registered views take what landmarks they give. Does nothing for a large scene, which has enough.
pub(crate) fn link_anew(scene: &mut Reconstruction, max_error_px: f64, seed: u64) {
    if scene.views.len() > MAX_ANEW {
        return;
    }
    scene.links.clear();
    for view in &mut scene.views {
        view.matched.iter_mut().for_each(Vec::clear);
        view.failed_with = 0;
    }
    for view_ix in 0..scene.views.len() {
        link_recent(scene, view_ix, max_error_px, seed);
        link_older(scene, view_ix, max_error_px, seed);
    }
    for submap in 0..scene.submaps.len() {
        for view_ix in scene.submaps[submap].views.clone() {
            extend(scene, view_ix, max_error_px);
        }
    }
}

/// Links one view to those that look alike but were not compared with it, later ones included.
pub(crate) fn link_alike(
    scene: &mut Reconstruction,
    view_ix: usize,
    max_error_px: f64,
    seed: u64,
) -> bool {
    let before = scene.links.len();
    let pool = scene.views.len();
    let others: Vec<usize> = alike(scene, view_ix, pool)
        .into_iter()
        .filter(|&o| !scene.links.contains_key(&(o.min(view_ix), o.max(view_ix))))
        .collect();
    link(scene, view_ix, &others, max_error_px, seed);
    scene.links.len() > before
}

/// Of the first `pool` views, those whose signatures match best.
fn alike(scene: &Reconstruction, view_ix: usize, pool: usize) -> Vec<usize> {
    let stride = pool.div_ceil(MAX_ASKED).max(1);
    let asked: Vec<usize> = (0..pool)
        .step_by(stride)
        .filter(|&o| o != view_ix)
        .collect();
    let own = &scene.views[view_ix].signature;
    let votes = |&o: &usize| (matches(own, &scene.views[o].signature).len(), o);
    let mut ranked: Vec<(usize, usize)> = asked.par_iter().map(votes).collect();
    ranked.retain(|r| r.0 >= MIN_VOTES);
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.cmp(&a.1)));
    ranked.truncate(N_ALIKE);
    ranked.into_iter().map(|r| r.1).collect()
}

fn link(
    scene: &mut Reconstruction,
    view_ix: usize,
    others: &[usize],
    max_error_px: f64,
    seed: u64,
) {
    for (other, link) in found(scene, view_ix, others, max_error_px, seed) {
        insert(scene, view_ix, other, link);
    }
}

/// Takes a held link for one that holds.
pub(crate) fn release(scene: &mut Reconstruction, (older, newer): (usize, usize)) {
    if let Some(link) = scene.held.remove(&(older, newer)) {
        insert(scene, newer, older, link);
    }
}

/// `link` as (feature of `other`, feature of the view).
fn insert(scene: &mut Reconstruction, view_ix: usize, other: usize, link: PairMatches) {
    for &(theirs, ours) in &link.matches {
        scene.views[other].matched[theirs as usize].push((view_ix as u32, ours));
        scene.views[view_ix].matched[ours as usize].push((other as u32, theirs));
    }
    scene.unmerged.extend([other, view_ix]);
    let flipped = other > view_ix;
    let link = if flipped { reversed(&link) } else { link };
    scene
        .links
        .insert((other.min(view_ix), other.max(view_ix)), link);
}

fn found(
    scene: &Reconstruction,
    view_ix: usize,
    others: &[usize],
    max_error_px: f64,
    seed: u64,
) -> Vec<(usize, PairMatches)> {
    let ours = PreparedDescriptors::new(&scene.views[view_ix].features.descriptors);
    // The first submap settles the focal length; from then on the stricter check is possible.
    let focal_known = !scene.submaps.is_empty();
    let compare = |&other: &usize| {
        let theirs = PreparedDescriptors::new(&scene.views[other].features.descriptors);
        let raw = matches(&theirs, &ours);
        let link = verified(
            &scene.views[other],
            &scene.views[view_ix],
            &raw,
            focal_known,
            (max_error_px, pair_seed(seed, other, view_ix)),
        );
        link.map(|link| (other, link))
    };
    others.par_iter().filter_map(compare).collect()
}

fn reversed(link: &PairMatches) -> PairMatches {
    let matches = link.matches.iter().map(|&(a, b)| (b, a)).collect();
    PairMatches {
        matches,
        motion: link
            .motion
            .map(|(pose, parallax)| (pose.inverse(), parallax)),
    }
}

pub(crate) fn pair_seed(seed: u64, a: usize, b: usize) -> u64 {
    seed ^ (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (b as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
}

/// Pixel pairs of matches between two views.
pub(crate) fn pixel_pairs(a: &SfmView, b: &SfmView, matches: &[(u32, u32)]) -> Vec<(DVec2, DVec2)> {
    matches
        .iter()
        .map(|&(i, j)| (a.features.pixels[i as usize], b.features.pixels[j as usize]))
        .collect()
}

fn verified(
    a: &SfmView,
    b: &SfmView,
    raw: &[(u32, u32)],
    focal_known: bool,
    (max_error_px, seed): (f64, u64),
) -> Option<PairMatches> {
    if raw.len() < MIN_LINK {
        return None;
    }
    let pairs = pixel_pairs(a, b, raw);
    let (inliers, motion) = if focal_known || (a.is_calibrated && b.is_calibrated) {
        let found = motion(&pairs, [&a.lens, &b.lens], max_error_px, seed)?;
        (
            found.inliers,
            Some((found.second_from_first, found.parallax_deg)),
        )
    } else {
        (fundamental(&pairs, max_error_px, seed)?.1, None)
    };
    let matches: Vec<(u32, u32)> = inliers.iter().map(|&i| raw[i]).collect();
    (matches.len() >= MIN_LINK).then_some(PairMatches { matches, motion })
}
