//! Links to views long before -> used where they fit, a loop that is closed where they agree on one, else dropped.
//!
//! The gates are those of `geometry::seen_again`. A closed loop bends the way by a graph of poses, joins landmarks and
//! adjusts all; if that loses observations, it was none and all is put back.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use crate::loop_closure::{self, AMBIGUOUS, MIN_GAP, MIN_LINKS};
use crate::optim::pose_graph::Graph;
use crate::optim::pose_graph::edge::Edge;
use crate::sfm::adjust::{adjust_global, adjust_local};
use crate::sfm::landmarks::{extend, join};
use crate::sfm::limits::Limits;
use crate::sfm::merge_submaps::{similarity, views_in_common};
use crate::sfm::odometry::{metres_per_unit, motion};
use crate::sfm::overlap::overlap;
use crate::sfm::pairwise::{pair_seed, release};
use crate::sfm::reconstruction::{
    Landmark, NONE, PairMatches, Reconstruction, RegisteredView, SfmView, Submap,
};
use crate::stats::median;
use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, Similarity};

/// Landmarks that matches must name before they say where a view is; a share of them must fit for a link to hold.
const MIN_NAMED: usize = 15;
const MIN_FITTING: f64 = 0.5;
/// Views that a link may wait for others that say the same.
const MAX_WAIT: usize = 24;
/// Landmarks are joined within so many times the error of an inlier, before all is adjusted.
const LAX_JOIN: f64 = 6.0;
/// Of the observations before, so many must be left.
const MIN_LEFT: f64 = 0.95;

/// A link with what it would do to the newer view's side of the map.
struct Candidate {
    ends: (usize, usize),
    correction: Similarity,
    /// Landmarks that are the same by it: (the older side's, the newer side's).
    pairs: Vec<(u32, u32)>,
}

/// Views that wait may be registered by whatever they match.
pub(crate) fn release_waiting(scene: &mut Reconstruction) {
    let waits = |view: usize| scene.views[view].registered.is_none();
    let ends: Vec<(usize, usize)> = scene.held.keys().copied().collect();
    let ends: Vec<_> = ends
        .into_iter()
        .filter(|e| waits(e.0) || waits(e.1))
        .collect();
    ends.into_iter().for_each(|e| release(scene, e));
}

/// Uses the held links that fit and closes a loop if there is one. `max_drift` as in `align.max_loop_correction`; `None`: no loops.
pub(crate) fn settle(scene: &mut Reconstruction, limits: &Limits, max_drift: Option<f64>) -> bool {
    let held: Vec<(usize, usize)> = scene.held.keys().copied().collect();
    let (mut open, mut used) = (Vec::new(), BTreeSet::new());
    for ends in held {
        let submaps = [scene.submap_of(ends.0), scene.submap_of(ends.1)];
        if submaps[0].is_none() || submaps[1].is_none() || submaps[0] != submaps[1] {
            release(scene, ends);
        } else if max_drift.is_some() && fits(scene, ends, 2.0 * limits.max_error_px) {
            release(scene, ends);
            extend(scene, ends.1, limits.max_error_px);
            used.insert(ends);
        } else {
            open.push(ends);
        }
    }
    let newers: BTreeSet<usize> = used.iter().map(|e| e.1).collect();
    newers
        .into_iter()
        .for_each(|view| adjust_local(scene, view, limits));
    // Where one far place fits as the poses are, another that asks for a correction only looks alike.
    let far = used.iter().filter(|e| e.0 + MIN_GAP as usize <= e.1);
    let settled: BTreeSet<usize> = far.map(|e| e.1).collect();
    let (mut found, mut is_closed) = (Vec::new(), false);
    if let Some(max_drift) = max_drift {
        let asking = open.iter().filter(|e| !settled.contains(&e.1));
        found.extend(asking.filter_map(|e| candidate(scene, *e, limits)));
        let plausible = |c: &&Candidate| is_plausible(scene, c, max_drift);
        let best = found
            .iter()
            .filter(plausible)
            .max_by_key(|c| (c.pairs.len(), c.ends));
        let links = best.and_then(|best| find_inliers(scene, &found, best));
        let links = links.filter(|all| is_one_place(scene, all, limits));
        is_closed = links.is_some_and(|all| close(scene, &all, limits));
    }
    let newest = scene.views.len();
    let keeps = |ends: &(usize, usize)| max_drift.is_some() && ends.1 + MAX_WAIT > newest;
    scene.held.retain(|ends, _| keeps(ends));
    is_closed
}

/// Whether the landmarks of the older view lie where the newer one has them.
fn fits(scene: &Reconstruction, ends: (usize, usize), max_px: f64) -> bool {
    let (mut n, mut n_fitting) = (0, 0);
    for &(theirs, ours) in &scene.held[&ends].matches {
        let landmark = scene.views[ends.0].landmark_of[theirs as usize];
        let observation = scene.observation((ends.1 as u32, ours));
        if let Some(observation) = observation.filter(|_| landmark != NONE) {
            n += 1;
            let point = scene.landmarks[landmark as usize].point;
            n_fitting += usize::from(observation.error_px(point) <= max_px);
        }
    }
    n >= MIN_NAMED && n_fitting as f64 >= MIN_FITTING * n as f64
}

fn candidate(scene: &Reconstruction, ends: (usize, usize), limits: &Limits) -> Option<Candidate> {
    let landmark = |view: usize, feature: u32| scene.views[view].landmark_of[feature as usize];
    let matches = scene.held[&ends].matches.iter();
    let pairs: Vec<(u32, u32)> = matches
        .map(|&(theirs, ours)| (landmark(ends.0, theirs), landmark(ends.1, ours)))
        .filter(|(a, b)| *a != NONE && *b != NONE && a != b)
        .collect();
    if pairs.len() < MIN_NAMED {
        return None;
    }
    let limits = Limits {
        min_inliers: MIN_NAMED,
        ..*limits
    };
    let seed = pair_seed(limits.seed, ends.0, ends.1);
    let (correction, inliers) = similarity(scene, &pairs, &limits, seed)?;
    Some(Candidate {
        ends,
        correction,
        pairs: inliers.into_iter().map(|i| pairs[i]).collect(),
    })
}

/// Whether the way between both ends may have gathered so much drift.
fn is_plausible(scene: &Reconstruction, candidate: &Candidate, max_drift: f64) -> bool {
    let (older, newer) = candidate.ends;
    let submap = scene.submap_of(newer);
    let way: Vec<DVec3> = (older..=newer)
        .filter(|&s| scene.submap_of(s) == submap)
        .filter_map(|s| scene.centre(s))
        .collect();
    let is_plausible = loop_closure::may_have_drifted(&way, &candidate.correction, max_drift);
    let n = candidate.pairs.len();
    tracing::debug!(older, newer, n, is_plausible, "seen again");
    is_plausible
}

/// Links that say the same as the one with most landmarks, if they are enough and no other speaks against it; one that no
/// drift explains does, too: the place looks like others.
fn find_inliers<'a>(
    scene: &Reconstruction,
    found: &'a [Candidate],
    best: &Candidate,
) -> Option<Vec<&'a Candidate>> {
    let is_same = |c: &&Candidate| {
        let (Some(centre), depth) = (scene.centre(c.ends.1), depth(scene, c.ends.1)) else {
            return false;
        };
        loop_closure::is_same(centre, depth, &c.correction, &best.correction)
    };
    let all: Vec<&Candidate> = found.iter().filter(is_same).collect();
    let ambiguous = found.iter().filter(|c| !is_same(c));
    let strongest = ambiguous.map(|c| c.pairs.len()).max().unwrap_or(0);
    let olders: BTreeSet<usize> = all.iter().map(|c| c.ends.0).collect();
    let newers: BTreeSet<usize> = all.iter().map(|c| c.ends.1).collect();
    let is_enough = all.len() >= MIN_LINKS && olders.len() >= 2 && newers.len() >= 2;
    let is_clear = strongest as f64 <= AMBIGUOUS * best.pairs.len() as f64;
    (is_enough && is_clear).then_some(all)
}

/// Whether what is round the landmarks in common is the same as well.
fn is_one_place(scene: &Reconstruction, links: &[&Candidate], limits: &Limits) -> bool {
    let Some(first) = links.first() else {
        return false;
    };
    let views = views_in_common(
        scene,
        links.iter().flat_map(|link| link.pairs.iter().copied()),
    );
    let overlap = overlap(scene, &views, &first.correction, limits.max_error_px);
    tracing::debug!(?overlap, "a place that is seen again");
    overlap.is_one_place()
}

fn depth(scene: &Reconstruction, view: usize) -> f64 {
    median(&mut scene.depths(view)).unwrap_or(1.0)
}

fn close(scene: &mut Reconstruction, links: &[&Candidate], limits: &Limits) -> bool {
    let Some(submap) = scene.submap_of(links[0].ends.1) else {
        return false;
    };
    scene.n_rebuilt += 1;
    let backup = Backup::of(scene);
    let before = n_observations(scene, submap);
    let is_distorted = bend(scene, submap, links);
    if is_distorted {
        for link in links {
            release(scene, link.ends);
            for &(a, b) in &link.pairs {
                let is_there = |l: u32| !scene.landmarks[l as usize].seen.is_empty();
                if is_there(a) && is_there(b) {
                    join(scene, a, b, LAX_JOIN * limits.max_error_px);
                }
            }
        }
        adjust_global(scene, submap, 2.0 * limits.max_error_px, 15);
        for link in links {
            extend(scene, link.ends.1, limits.max_error_px);
        }
        adjust_global(scene, submap, limits.max_error_px, 15);
    }
    let after = n_observations(scene, submap);
    let is_good = is_distorted && after as f64 >= MIN_LEFT * before as f64;
    let ends: Vec<(usize, usize)> = links.iter().map(|l| l.ends).collect();
    tracing::info!(
        ?ends,
        is_distorted,
        before,
        after,
        "{}",
        if is_good {
            "a loop is closed"
        } else {
            "a loop is refused"
        }
    );
    if is_good {
        scene.closed.extend(ends);
    } else {
        backup.put_back(scene);
        ends.iter().for_each(|e| {
            scene.held.remove(e);
        });
    }
    is_good
}

fn n_observations(scene: &Reconstruction, submap: u32) -> usize {
    let of_submap = scene.landmarks.iter().filter(|l| l.submap == submap);
    of_submap.map(|l| l.seen.len()).sum()
}

/// Spreads what the links ask for over the way; landmarks go with the first view that sees them.
fn bend(scene: &mut Reconstruction, submap: u32, links: &[&Candidate]) -> bool {
    let mut views = scene.submaps[submap as usize].views.clone();
    let first = views[0];
    views.sort_unstable();
    let ix_of: BTreeMap<usize, usize> = views.iter().enumerate().map(|(ix, s)| (*s, ix)).collect();
    let pose = |s: &usize| {
        scene.views[*s]
            .registered
            .map_or(Rigid::IDENTITY, |p| p.cam_from_world.inverse())
    };
    let before: Vec<Similarity> = views.iter().map(|s| pose(s).into()).collect();
    let depths: Vec<f64> = views.iter().map(|s| depth(scene, *s)).collect();
    let way: Vec<usize> = (0..views.len()).collect();
    let mut edges = Edge::along(&way, &before, |ix| depths[ix]);
    if let Some(scale) = metres_per_unit(scene, submap) {
        for edge in &mut edges {
            let ends = [views[edge.first], views[edge.second]];
            loosen(scene, edge, (ends, scale.log.exp()));
        }
    }
    let ix = |(a, b): (usize, usize)| Some((*ix_of.get(&a)?, *ix_of.get(&b)?));
    let closed = scene.closed.iter().filter_map(|ends| ix(*ends));
    edges.extend(closed.map(|ends| Edge::as_is(&before, ends, depths[ends.1])));
    for link in links {
        let Some(ends) = ix(link.ends) else {
            return false;
        };
        let first_from_second = before[ends.0].inverse() * link.correction * before[ends.1];
        edges.push(Edge::link(first_from_second, ends, depths[ends.1]));
    }
    let mut graph = Graph {
        nodes: before.clone(),
        is_held: views.iter().map(|s| *s == first).collect(),
        edges,
        moves_scale: true,
    };
    if !graph.spread() {
        return false;
    }
    for landmark in scene.landmarks_of(&views) {
        let landmark = &mut scene.landmarks[landmark as usize];
        let owner = landmark
            .seen
            .first()
            .and_then(|at| ix_of.get(&(at.0 as usize)));
        if let Some(&owner) = owner {
            let moved = graph.nodes[owner] * before[owner].inverse();
            landmark.point = moved.transform_point(landmark.point);
        }
    }
    for (view, node) in views.iter().zip(&graph.nodes) {
        if let Some(registered) = &mut scene.views[*view].registered {
            let pose = Rigid::new(node.rotation, node.translation).renormalized();
            registered.cam_from_world = pose.inverse();
        }
    }
    true
}

/// Where odometry alone ties two views, the edge between them is as stiff as odometry is sure; the submap's unit is in metres.
fn loosen(scene: &Reconstruction, edge: &mut Edge, (ends, unit): ([usize; 2], f64)) {
    let Some(motion) = motion(scene, ends[0], ends[1]) else {
        return;
    };
    if !scene.shared_counts(ends[0]).contains_key(&ends[1]) {
        edge.std[0] = edge.std[0].max(motion.std[0] / unit);
        edge.std[1] = edge.std[1].max(motion.std[1]);
    }
}

struct KeptView {
    registered: Option<RegisteredView>,
    landmark_of: Vec<u32>,
    matched: Vec<Vec<(u32, u32)>>,
    lens: Intrinsics,
}

/// All that closing a loop may change.
struct Backup {
    landmarks: Vec<Landmark>,
    submaps: Vec<Submap>,
    links: BTreeMap<(usize, usize), PairMatches>,
    held: BTreeMap<(usize, usize), PairMatches>,
    radial: f64,
    views: Vec<KeptView>,
}

impl Backup {
    fn of(scene: &Reconstruction) -> Self {
        let view = |view: &SfmView| KeptView {
            registered: view.registered,
            landmark_of: view.landmark_of.clone(),
            matched: view.matched.clone(),
            lens: view.lens,
        };
        Self {
            landmarks: scene.landmarks.clone(),
            submaps: scene.submaps.clone(),
            links: scene.links.clone(),
            held: scene.held.clone(),
            radial: scene.radial,
            views: scene.views.iter().map(view).collect(),
        }
    }

    fn put_back(self, scene: &mut Reconstruction) {
        (scene.landmarks, scene.submaps) = (self.landmarks, self.submaps);
        (scene.links, scene.held, scene.radial) = (self.links, self.held, self.radial);
        for (view, kept) in scene.views.iter_mut().zip(self.views) {
            (view.registered, view.landmark_of) = (kept.registered, kept.landmark_of);
            (view.matched, view.lens) = (kept.matched, kept.lens);
        }
        scene.undistort();
    }
}
