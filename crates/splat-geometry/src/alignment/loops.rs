//! A new keyframe -> links to places that were seen long before, each checked by pixels, depth and its neighbours.
//!
//! The gates are those of `geometry::seen_again`: here keyframes beside both ends are asked, and poses as they are count
//! as a place, too.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::alignment::kept_views::KeptView;
use crate::alignment::matches::Matcher;
use crate::alignment::pair_similarity::{PairSimilarity, ViewFeatures, verified};
use crate::alignment::params::AlignParams;
use crate::answer::View;
use crate::loop_closure::{self, AMBIGUOUS, MIN_GAP, MIN_LINKS, Stand};
use crate::optim::pose_graph;
use splat_types::time::Stamp;
use splat_types::transform::Similarity;

/// Matching signatures below which two images do not look alike.
const MIN_VOTES: usize = 6;
/// Places that a keyframe is compared with, and how many keyframes one place takes.
const N_PLACES: usize = 8;
const PLACE: u32 = 3;
/// Neighbours of both ends that are asked, to each side.
const N_BESIDE: usize = 2;
/// Links that must agree between two submaps, of which nothing else is known.
const MIN_LINKS_ACROSS: usize = 4;
/// A correction below this is left to the adjustment of all: share of the depth, radians, logarithm of scale.
const SMALL_SHIFT: f64 = 0.1;
const SMALL_TURN: f64 = 0.02;
const SMALL_SCALE: f64 = 0.06;
/// Links that wait for a neighbour's word.
const MAX_PENDING: usize = 12;

#[derive(Debug, Clone, Default)]
pub(crate) struct Loops {
    pending: Vec<PairSimilarity>,
    /// Pairs that led to nothing good.
    refused: BTreeSet<(u32, u32)>,
    /// When keyframes were taken, as far as that was said.
    stamps: BTreeMap<u32, Stamp>,
}

/// Links of a new keyframe, and where they would have the newer end's side of the map.
struct Best {
    link: PairSimilarity,
    /// `older_side_from_newer_side`, in map coordinates.
    correction: Similarity,
}

impl Loops {
    /// Links that agree, of one of the `fresh` keyframes and those beside it; empty where nothing new was found.
    pub(crate) fn found(
        &mut self,
        kept: &KeptView,
        matcher: &Matcher,
        fresh: &[u32],
        params: &AlignParams,
    ) -> Vec<PairSimilarity> {
        for &id in fresh {
            let Some(best) = self.best_link(kept, matcher, id, params) else {
                continue;
            };
            let mut links = confirming(kept, matcher, &best, params);
            let inliers = self.pending.iter().filter(|l| agrees(kept, &best, l));
            links.extend(inliers.copied());
            links.push(best.link);
            links.sort_by_key(PairSimilarity::ends);
            links.dedup_by_key(|l| l.ends());
            if is_enough(kept, &links) {
                self.pending.clear();
                return links;
            }
            self.pending.push(best.link);
            if self.pending.len() > MAX_PENDING {
                self.pending.remove(0);
            }
        }
        Vec::new()
    }

    pub(crate) fn note_stamps(&mut self, stamps: impl Iterator<Item = (u32, Stamp)>) {
        self.stamps.extend(stamps);
    }

    /// They did more harm than good.
    pub(crate) fn refuse(&mut self, links: &[PairSimilarity]) {
        self.refused.extend(links.iter().map(PairSimilarity::ends));
    }

    /// Keyframes before `id` are forgotten.
    pub(crate) fn forget_before(&mut self, id: u32) {
        self.refused.retain(|(older, _)| *older >= id);
        self.pending.retain(|l| l.older >= id);
        self.stamps.retain(|taken, _| *taken >= id);
    }

    /// The place that fits best, if it asks for a correction that may be and no other place fits about as well.
    fn best_link(
        &self,
        kept: &KeptView,
        matcher: &Matcher,
        id: u32,
        params: &AlignParams,
    ) -> Option<Best> {
        let asked: Vec<u32> = places(kept, matcher, id);
        let check = |&older: &u32| self.checked(kept, matcher, (older, id), params);
        let mut found: Vec<Best> = asked.par_iter().filter_map(check).collect();
        found.sort_by_key(|b| (std::cmp::Reverse(b.link.n), b.link.older));
        let mut rest = found.into_iter();
        let best = rest.next()?;
        // One that no drift explains is an ambiguous match all the same: the place looks like others.
        let ambiguous = rest.find(|b| !is_same(kept, id, &b.correction, &best.correction));
        let is_rivalled = ambiguous
            .as_ref()
            .is_some_and(|r| r.link.n as f64 > AMBIGUOUS * best.link.n as f64);
        let is_plausible = self.is_plausible(kept, &best, params.max_loop_correction);
        let needed = is_needed(kept, &best);
        tracing::debug!(
            id,
            older = best.link.older,
            n = best.link.n,
            is_rivalled,
            is_plausible,
            needed,
            "seen again"
        );
        (!is_rivalled && is_plausible && needed).then_some(best)
    }

    fn checked(
        &self,
        kept: &KeptView,
        matcher: &Matcher,
        ends: (u32, u32),
        params: &AlignParams,
    ) -> Option<Best> {
        if self.refused.contains(&ends) {
            return None;
        }
        let link = link(kept, matcher, ends, params)?;
        let correction = correction(kept, &link)?;
        Some(Best { link, correction })
    }

    /// Whether the way between both ends may have gathered so much drift; between two submaps, whether the camera can
    /// have gone from one to the other at all.
    fn is_plausible(&self, kept: &KeptView, best: &Best, max_drift: f64) -> bool {
        let (older, newer) = best.link.ends();
        let sides = [submap(kept, older), submap(kept, newer)];
        if sides[0] == sides[1] {
            let way: Vec<DVec3> = centres(kept, older..=newer, sides[0])
                .map(|c| c.1)
                .collect();
            return loop_closure::may_have_drifted(&way, &best.correction, max_drift);
        }
        let stands = |side: Option<u32>, moved: Similarity| -> Vec<(u32, Stand)> {
            let all = centres(kept, 0..=u32::MAX, side);
            let stand = |(id, at)| Some((id, (*self.stamps.get(&id)?, moved.transform_point(at))));
            all.filter_map(stand).collect()
        };
        let ours = stands(sides[0], Similarity::IDENTITY);
        let theirs = stands(sides[1], best.correction);
        can_follow(&ours, &theirs, best.link.ends(), max_drift)
            && can_follow(&theirs, &ours, (newer, older), max_drift)
    }
}

/// Keyframes of a submap with their places in its map.
fn centres(
    kept: &KeptView,
    ids: RangeInclusive<u32>,
    side: Option<u32>,
) -> impl Iterator<Item = (u32, DVec3)> {
    kept.range(ids)
        .map(|(id, (view, _))| (*id, view))
        .filter(move |(_, view)| Some(view.submap) == side)
        .map(|(id, view)| (id, view.submap_from_cam.translation))
}

/// Wherever the camera went from the one part to the other with nothing known in between. `ends` of the link, the first
/// one in `from`.
fn can_follow(
    from: &[(u32, Stand)],
    to: &[(u32, Stand)],
    ends: (u32, u32),
    max_drift: f64,
) -> bool {
    let length = |part: &[(u32, Stand)], a: u32, b: u32| {
        let (low, high) = (a.min(b), a.max(b));
        let inside = part.iter().filter(|(id, _)| (low..=high).contains(id));
        loop_closure::length(inside.map(|(_, stand)| stand.1))
    };
    from.iter().enumerate().all(|(ix, (id, _))| {
        let next = to.partition_point(|(other, _)| other < id);
        let Some((begin, _)) = to.get(next) else {
            return true;
        };
        if from
            .get(ix + 1)
            .is_some_and(|(follower, _)| follower < begin)
        {
            return true;
        }
        let before: Vec<Stand> = from[..=ix].iter().map(|(_, stand)| *stand).collect();
        let behind: Vec<Stand> = to[next..].iter().map(|(_, stand)| *stand).collect();
        let way = length(from, ends.0, *id) + length(to, ends.1, *begin);
        loop_closure::may_have_walked((&before, &behind), way, max_drift)
    })
}

fn link(
    kept: &KeptView,
    matcher: &Matcher,
    ends: (u32, u32),
    params: &AlignParams,
) -> Option<PairSimilarity> {
    let (older, newer) = (kept.get(&ends.0)?, kept.get(&ends.1)?);
    let seen = |(view, depths): &'_ (View, Vec<Option<f64>>)| -> (Vec<DVec2>, Vec<Option<f64>>) {
        (matcher.view(view).pixels, depths.clone())
    };
    let matches = matcher.verified([&older.0, &newer.0], params.max_matches);
    if matches.is_empty() {
        return None;
    }
    let ((pixels_a, depths_a), (pixels_b, depths_b)) = (seen(older), seen(newer));
    let of = |view, pixels, depths| ViewFeatures {
        view,
        lens: matcher.view(view).lens,
        pixels,
        depths,
    };
    let a = of(&older.0, pixels_a, depths_a);
    let b = of(&newer.0, pixels_b, depths_b);
    verified(&a, &b, &matches, params.depth_error)
}

/// Earlier keyframes whose signatures match best, one of each place.
fn places(kept: &KeptView, matcher: &Matcher, id: u32) -> Vec<u32> {
    let Some((own, _)) = kept.get(&id) else {
        return Vec::new();
    };
    let is_far = |other: &View| other.submap != own.submap || id > other.keyframe_id + MIN_GAP;
    let asked: Vec<u32> = kept
        .values()
        .map(|(view, _)| view)
        .filter(|view| view.keyframe_id < id && is_far(view))
        .map(|view| view.keyframe_id)
        .collect();
    let votes = |&other: &u32| (matcher.votes(id, other), other);
    let mut ranked: Vec<(usize, u32)> = asked.par_iter().map(votes).collect();
    ranked.retain(|r| r.0 >= MIN_VOTES);
    ranked.sort_by_key(|r| (std::cmp::Reverse(r.0), r.1));
    let mut picked: Vec<u32> = Vec::new();
    for (_, other) in ranked {
        if picked.iter().all(|p| p.abs_diff(other) >= PLACE) {
            picked.push(other);
        }
        if picked.len() == N_PLACES {
            break;
        }
    }
    picked
}

/// Links between the neighbours of both ends that say the same; none where more say otherwise.
fn confirming(
    kept: &KeptView,
    matcher: &Matcher,
    best: &Best,
    params: &AlignParams,
) -> Vec<PairSimilarity> {
    let beside = |id: u32, forward: usize| -> Vec<u32> {
        let Some((own, _)) = kept.get(&id) else {
            return Vec::new();
        };
        let is_own = |k: &&u32| kept[k].0.submap == own.submap;
        let before = kept.range(..id).rev().map(|(k, _)| k);
        let behind = kept.range(id + 1..).map(|(k, _)| k);
        let before = before.filter(is_own).take(N_BESIDE);
        let behind = behind.filter(is_own).take(forward);
        before.chain(behind).copied().chain([id]).collect()
    };
    let newer_ends = beside(best.link.newer, 0);
    let mut pairs = Vec::new();
    for older in beside(best.link.older, N_BESIDE) {
        pairs.extend(newer_ends.iter().map(|&newer| (older, newer)));
    }
    pairs.retain(|&(older, newer)| older < newer && (older, newer) != best.link.ends());
    let found: Vec<PairSimilarity> = pairs
        .par_iter()
        .filter_map(|&ends| link(kept, matcher, ends, params))
        .collect();
    let n = found.len();
    let inliers: Vec<PairSimilarity> = found
        .into_iter()
        .filter(|l| agrees(kept, best, l))
        .collect();
    if 2 * inliers.len() > n {
        inliers
    } else {
        Vec::new()
    }
}

/// Enough of them, and not all from one keyframe.
fn is_enough(kept: &KeptView, links: &[PairSimilarity]) -> bool {
    let olders: BTreeSet<u32> = links.iter().map(|l| l.older).collect();
    let newers: BTreeSet<u32> = links.iter().map(|l| l.newer).collect();
    let is_across = links
        .iter()
        .any(|l| submap(kept, l.older) != submap(kept, l.newer));
    let needed = if is_across {
        MIN_LINKS_ACROSS
    } else {
        MIN_LINKS
    };
    links.len() >= needed && olders.len() >= 2 && newers.len() >= 2
}

fn submap(kept: &KeptView, id: u32) -> Option<u32> {
    kept.get(&id).map(|(view, _)| view.submap)
}

fn world_from_cam(kept: &KeptView, id: u32) -> Option<Similarity> {
    Some(kept.get(&id)?.0.submap_from_cam.into())
}

/// What the link would do to the newer end's side of the map.
pub(crate) fn correction(kept: &KeptView, link: &PairSimilarity) -> Option<Similarity> {
    let older = world_from_cam(kept, link.older)?;
    let newer = world_from_cam(kept, link.newer)?;
    Some(older * link.older_from_newer * newer.inverse())
}

fn agrees(kept: &KeptView, best: &Best, link: &PairSimilarity) -> bool {
    let is_between = submap(kept, link.older) == submap(kept, best.link.older)
        && submap(kept, link.newer) == submap(kept, best.link.newer);
    let theirs = correction(kept, link);
    is_between && theirs.is_some_and(|c| is_same(kept, best.link.newer, &c, &best.correction))
}

/// Where the camera stood, and how deep it saw.
fn place(kept: &KeptView, id: u32) -> Option<(DVec3, f64)> {
    let (view, _) = kept.get(&id)?;
    let depth = f64::from(view.depth.median()?);
    Some((view.submap_from_cam.translation, depth))
}

fn is_same(kept: &KeptView, id: u32, a: &Similarity, b: &Similarity) -> bool {
    place(kept, id).is_some_and(|(at, depth)| loop_closure::is_same(at, depth, a, b))
}

/// Between two submaps any, else one that the poses do not have already.
fn is_needed(kept: &KeptView, best: &Best) -> bool {
    if submap(kept, best.link.older) != submap(kept, best.link.newer) {
        return true;
    }
    let as_is = Similarity::IDENTITY;
    place(kept, best.link.newer)
        .map(|(at, depth)| pose_graph::apart(at, depth, &best.correction, &as_is))
        .is_some_and(|[shift, turn, scale]| {
            shift > SMALL_SHIFT || turn > SMALL_TURN || scale > SMALL_SCALE
        })
}
