//! A new shot -> verified matches with the shots before it: the last few, and those that look alike.

use glam::DVec2;
use rayon::prelude::*;

use super::landmarks::extend;
use super::scene::{Link, Scene, Shot};
use crate::geometry::matching::{Comparable, matches};
use crate::geometry::two_view::{fundamental, motion};

/// Shots just before a new one that are always compared with it.
const N_RECENT: usize = 6;
/// Older shots that look alike and are compared, too: jumps and loops need them.
const N_ALIKE: usize = 4;
/// Matching signatures below which two pictures do not look alike.
const MIN_VOTES: usize = 6;
/// Older shots asked for likeness; beyond it they are taken evenly.
const MAX_ASKED: usize = 600;
/// Shots up to which all are linked anew when the lens turns out to bend.
const MAX_ANEW: usize = 64;
/// Verified matches that make a link; fewer are as likely chance.
const MIN_LINK: usize = 15;

/// Links the newest shot (the last) to earlier ones.
pub(super) fn link_newest(scene: &mut Scene, max_error_px: f64, seed: u64) {
    if let Some(newest) = scene.shots.len().checked_sub(1) {
        link_back(scene, newest, max_error_px, seed);
    }
}

/// Matches of a bent lens were verified as a pinhole's, which lost those near the rim: all are made again, and the
/// placed shots take what landmarks they give. Does nothing for a large scene, which has enough.
pub(super) fn link_anew(scene: &mut Scene, max_error_px: f64, seed: u64) {
    if scene.shots.len() > MAX_ANEW {
        return;
    }
    scene.links.clear();
    for shot in &mut scene.shots {
        shot.matched.iter_mut().for_each(Vec::clear);
        shot.failed_with = 0;
    }
    for shot_ix in 0..scene.shots.len() {
        link_back(scene, shot_ix, max_error_px, seed);
    }
    for component in 0..scene.components.len() {
        for shot_ix in scene.components[component].shots.clone() {
            extend(scene, shot_ix, max_error_px);
        }
    }
}

fn link_back(scene: &mut Scene, shot_ix: usize, max_error_px: f64, seed: u64) {
    let recent = shot_ix.saturating_sub(N_RECENT);
    let others: Vec<usize> = (recent..shot_ix).collect();
    link(scene, shot_ix, &others, max_error_px, seed);
    let others = alike(scene, shot_ix, recent);
    for (other, found) in found(scene, shot_ix, &others, max_error_px, seed) {
        if scene.components.is_empty() {
            insert(scene, shot_ix, other, found);
        } else {
            scene.held.insert((other, shot_ix), found);
        }
    }
}

/// Links one shot to those that look alike but were not compared with it, later ones included.
pub(super) fn link_alike(scene: &mut Scene, shot_ix: usize, max_error_px: f64, seed: u64) -> bool {
    let before = scene.links.len();
    let pool = scene.shots.len();
    let others: Vec<usize> = alike(scene, shot_ix, pool)
        .into_iter()
        .filter(|&o| !scene.links.contains_key(&(o.min(shot_ix), o.max(shot_ix))))
        .collect();
    link(scene, shot_ix, &others, max_error_px, seed);
    scene.links.len() > before
}

/// Of the first `pool` shots, those whose signatures match best.
fn alike(scene: &Scene, shot_ix: usize, pool: usize) -> Vec<usize> {
    let stride = pool.div_ceil(MAX_ASKED).max(1);
    let asked: Vec<usize> = (0..pool)
        .step_by(stride)
        .filter(|&o| o != shot_ix)
        .collect();
    let own = &scene.shots[shot_ix].signature;
    let votes = |&o: &usize| (matches(own, &scene.shots[o].signature).len(), o);
    let mut ranked: Vec<(usize, usize)> = asked.par_iter().map(votes).collect();
    ranked.retain(|r| r.0 >= MIN_VOTES);
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.cmp(&a.1)));
    ranked.truncate(N_ALIKE);
    ranked.into_iter().map(|r| r.1).collect()
}

fn link(scene: &mut Scene, shot_ix: usize, others: &[usize], max_error_px: f64, seed: u64) {
    for (other, link) in found(scene, shot_ix, others, max_error_px, seed) {
        insert(scene, shot_ix, other, link);
    }
}

/// Takes a held link for one that holds.
pub(super) fn release(scene: &mut Scene, (older, newer): (usize, usize)) {
    if let Some(link) = scene.held.remove(&(older, newer)) {
        insert(scene, newer, older, link);
    }
}

/// `link` as (feature of `other`, feature of the shot).
fn insert(scene: &mut Scene, shot_ix: usize, other: usize, link: Link) {
    for &(theirs, ours) in &link.matches {
        scene.shots[other].matched[theirs as usize].push((shot_ix as u32, ours));
        scene.shots[shot_ix].matched[ours as usize].push((other as u32, theirs));
    }
    let flipped = other > shot_ix;
    let link = if flipped { reversed(&link) } else { link };
    scene
        .links
        .insert((other.min(shot_ix), other.max(shot_ix)), link);
}

fn found(
    scene: &Scene,
    shot_ix: usize,
    others: &[usize],
    max_error_px: f64,
    seed: u64,
) -> Vec<(usize, Link)> {
    let ours = Comparable::new(&scene.shots[shot_ix].features.descriptors);
    // The first component settles the focal length; from then on the stricter check is possible.
    let focal_known = !scene.components.is_empty();
    let compare = |&other: &usize| {
        let theirs = Comparable::new(&scene.shots[other].features.descriptors);
        let raw = matches(&theirs, &ours);
        let link = verified(
            &scene.shots[other],
            &scene.shots[shot_ix],
            &raw,
            focal_known,
            (max_error_px, pair_seed(seed, other, shot_ix)),
        );
        link.map(|link| (other, link))
    };
    others.par_iter().filter_map(compare).collect()
}

fn reversed(link: &Link) -> Link {
    let matches = link.matches.iter().map(|&(a, b)| (b, a)).collect();
    Link {
        matches,
        motion: link
            .motion
            .map(|(pose, parallax)| (pose.inverse(), parallax)),
    }
}

pub(super) fn pair_seed(seed: u64, a: usize, b: usize) -> u64 {
    seed ^ (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (b as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
}

/// Pixel pairs of matches between two shots.
pub(super) fn pixel_pairs(a: &Shot, b: &Shot, matches: &[(u32, u32)]) -> Vec<(DVec2, DVec2)> {
    matches
        .iter()
        .map(|&(i, j)| (a.features.pixels[i as usize], b.features.pixels[j as usize]))
        .collect()
}

fn verified(
    a: &Shot,
    b: &Shot,
    raw: &[(u32, u32)],
    focal_known: bool,
    (max_error_px, seed): (f64, u64),
) -> Option<Link> {
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
    (matches.len() >= MIN_LINK).then_some(Link { matches, motion })
}
