//! Waiting views -> a new submap: the pair with most parallax, its landmarks, and all that can be registered on them.

use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};

use crate::pnp;
use crate::sfm::adjust::{adjust_global, median_error_px};
use crate::sfm::gyroscope;
use crate::sfm::landmarks::extend;
use crate::sfm::limits::Limits;
use crate::sfm::odometry::{MAX_MISFIT, turn_misfit, world_from_cam};
use crate::sfm::pairwise::{pair_seed, pixel_pairs};
use crate::sfm::reconstruction::{NONE, Reconstruction, Submap};
use crate::sfm::register::grow;
use crate::stats::median;
use crate::two_view::epipolar::{homography, motion};
use crate::two_view::plane::motions_by_plane;
use crate::two_view::triangulate::widest_angle;
use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, Similarity};

/// Pairs that are tried before waiting for more keyframes.
const MAX_ATTEMPTS: usize = 5;
/// More parallax than this is no better: wide views share fewer matches.
const ENOUGH_PARALLAX_DEG: f64 = 12.0;
/// What a pair with measured depth counts for, which needs none.
const MUCH_PARALLAX_DEG: f64 = 100.0;
/// Share of matches on one plane from which on a pair is a poor start: two motions explain it about equally well.
const PLANE_SHARE: f64 = 0.85;
/// Share from which on both motions are tried: the one that five points gave may be the plane's wrong one.
const BOTH_MOTIONS_SHARE: f64 = 0.35;

/// A start that places this share of the waiting views is taken without trying other pairs.
const GOOD_SHARE: f64 = 0.7;
/// Share of the matches that a sound scene explains: right starts measured 0.75 (driving) to
/// 0.98, wrong ones 0.50 and less.
const MIN_EXPLAINED: f64 = 0.62;
/// The same while the focal length is free: it bends to explain more than is true. One motif on every tile measured
/// 0.65 with a focal length 26 % off.
const MIN_EXPLAINED_FREE: f64 = 0.72;

/// A start that explains this share of the matches is taken for right; one that explains less is compared with what other pairs of views,
/// and the other motion of a plane, say. Blurred images before a wall of prints explained 0.83 by a motion that was 11 degrees wrong, and 0.75 by
/// the right one.
const CLEARLY_EXPLAINED: f64 = 0.88;
/// Two starts that both explain this share of what the better one does, and differ by such a turn in radians: neither is believed until
/// more keyframes have come. Three views that go through a door explained 0.84 by one and 0.86 by the other, which was wrong; eight, 0.93 and 0.54.
const ALIKE: f64 = 0.8;
const SAME_TURN: f64 = 0.05;

/// What came of trying to start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Start {
    Started,
    /// No pair has matches enough.
    NoMatches,
    /// Pairs match, but their rays are parallel: the camera rests or only turns.
    NoParallax,
    /// There was parallax, but no pair gave a scene that held.
    Unstable,
}

/// Tries to start a submap from waiting views of `pool` with at least `min_views` in it.
pub(crate) fn start(
    scene: &mut Reconstruction,
    pool: &[usize],
    min_views: usize,
    limits: &Limits,
) -> Start {
    let waiting: Vec<usize> = pool
        .iter()
        .copied()
        .filter(|&s| scene.views[s].registered.is_none())
        .collect();
    let (pairs, has_matches) = ranked_pairs(scene, &waiting, limits);
    if pairs.is_empty() {
        return if has_matches {
            Start::NoParallax
        } else {
            Start::NoMatches
        };
    }
    let (mut found, mut is_enough) = (Vec::<Candidate>::new(), false);
    for pair in pairs.into_iter().take(MAX_ATTEMPTS) {
        let other = pair.other_motion(scene);
        for pair in [Some(pair), other].into_iter().flatten() {
            let Some(made) = attempt(scene, &waiting, &pair, min_views, limits) else {
                continue;
            };
            let is_good = made.n_views as f64 >= GOOD_SHARE * waiting.len() as f64;
            let is_clear = pair.is_metric || made.explained >= CLEARLY_EXPLAINED;
            if is_good && is_clear && other.is_none() && found.is_empty() {
                return Start::Started;
            }
            // Another pair may reach more views, and the other motion be the true one.
            let last = scene.submaps.len() as u32 - 1;
            let poses = poses_of(scene, last);
            scene.dissolve(last);
            // No other pair needs to be tried.
            is_enough |= is_good && is_clear;
            found.push(Candidate {
                pair,
                n_explained: made.n_explained,
                poses,
            });
        }
        if is_enough {
            break;
        }
    }
    prefer_by_turns(scene, &mut found);
    let best = found.iter().max_by_key(|candidate| candidate.n_explained);
    let again = best
        .filter(|best| !found.iter().any(|other| other.contradicts(best)))
        .and_then(|best| attempt(scene, &waiting, &best.pair, min_views, limits));
    if again.is_some() {
        Start::Started
    } else {
        Start::Unstable
    }
}

/// A start that held, and was taken apart again.
struct Candidate {
    pair: FirstPair,
    n_explained: usize,
    /// `world_from_cam` by view.
    poses: BTreeMap<usize, Rigid>,
}

impl Candidate {
    /// Whether this start explains about as much as the best one, and says something else.
    fn contradicts(&self, best: &Self) -> bool {
        let is_alike = self.n_explained as f64 > ALIKE * best.n_explained as f64;
        is_alike && turned_between(&self.poses, &best.poses) > SAME_TURN
    }
}

/// The largest angle by which two sets of poses disagree on the turn between two views, in radians; of the views that both have.
fn turned_between(a: &BTreeMap<usize, Rigid>, b: &BTreeMap<usize, Rigid>) -> f64 {
    let mut both = a
        .iter()
        .filter_map(|(view, pose)| Some((pose, b.get(view)?)));
    let Some(first) = both.next() else {
        return 0.0;
    };
    let off = |(a, b): (&Rigid, &Rigid)| {
        let (a, b) = (first.0.inverse() * *a, first.1.inverse() * *b);
        a.angle_to(&b)
    };
    both.map(off).fold(0.0, f64::max)
}

/// Of starts that say different things, those remain whose turns are the ones of odometry, else of a gyroscope, if there are any.
fn prefer_by_turns(scene: &Reconstruction, found: &mut Vec<Candidate>) {
    let agrees = |candidate: &Candidate| {
        let by_odometry = turn_misfit(scene, &candidate.poses);
        let misfit = by_odometry.or_else(|| gyroscope::turn_misfit(scene, &candidate.poses));
        misfit.is_some_and(|misfit| misfit <= MAX_MISFIT)
    };
    if found.iter().any(agrees) {
        found.retain(agrees);
    }
}

fn poses_of(scene: &Reconstruction, submap: u32) -> BTreeMap<usize, Rigid> {
    let views = scene.submaps[submap as usize].views.iter();
    let pose = |&view: &usize| Some((view, world_from_cam(scene, view)?));
    views.filter_map(pose).collect()
}

/// Two views to start from, and the motion between them that is tried.
#[derive(Debug, Clone, Copy)]
struct FirstPair {
    score: f64,
    ends: (usize, usize),
    second_from_first: Rigid,
    /// Homography, in pixels, of the plane that shows most of the matches, if it shows many of them.
    plane: Option<DMat3>,
    /// The motion is in metres, by measured depth.
    is_metric: bool,
}

impl FirstPair {
    /// With the other motion that explains matches on a plane as well as this one.
    fn other_motion(&self, scene: &Reconstruction) -> Option<Self> {
        let plane = self.plane?;
        let (a, b) = self.ends;
        let views = [&scene.views[a], &scene.views[b]];
        let matches = &scene.links[&(a, b)].matches;
        let pixels = pixel_pairs(views[0], views[1], matches);
        let [first, second] = views.map(|view| rays_from_pixels(&view.lens));
        let rays: Vec<DVec3> = pixels
            .iter()
            .map(|pixel| views[0].lens.ray_in_cam(pixel.0))
            .collect();
        let between_rays = second * plane * first.inverse();
        let motions = motions_by_plane(&between_rays, &rays);
        let alike = |m: &Rigid| m.translation.dot(self.second_from_first.translation);
        let other = motions
            .into_iter()
            .min_by(|x, y| alike(x).total_cmp(&alike(y)))?;
        Some(Self {
            second_from_first: other,
            ..*self
        })
    }
}

fn rays_from_pixels(lens: &Intrinsics) -> DMat3 {
    DMat3::from_cols(
        DVec3::X / lens.fx,
        DVec3::Y / lens.fy,
        DVec3::new(-lens.cx / lens.fx, -lens.cy / lens.fy, 1.0),
    )
}

/// Pairs with parallax, best first, and whether any pair had matches enough.
fn ranked_pairs(
    scene: &mut Reconstruction,
    waiting: &[usize],
    limits: &Limits,
) -> (Vec<FirstPair>, bool) {
    let mut pairs = Vec::new();
    let mut has_matches = false;
    let of_first = |&a: &usize| scene.links.range((a, 0)..(a + 1, 0)).map(|link| *link.0);
    let waits = |ends: &(usize, usize)| waiting.contains(&ends.1);
    let keys: Vec<(usize, usize)> = waiting.iter().flat_map(of_first).filter(waits).collect();
    for (a, b) in keys {
        let link = &scene.links[&(a, b)];
        let n = link.matches.len();
        if n < limits.min_inliers {
            continue;
        }
        has_matches = true;
        let seed = pair_seed(limits.seed, a, b);
        if let Some(pair) = metric_pair(scene, (a, b), limits, seed) {
            pairs.push(pair);
            continue;
        }
        let pixels = pixel_pairs(&scene.views[a], &scene.views[b], &link.matches);
        let lenses = [&scene.views[a].lens, &scene.views[b].lens];
        let found = link.motion.or_else(|| {
            motion(&pixels, lenses, limits.max_error_px, seed)
                .map(|m| (m.second_from_first, m.parallax_deg))
        });
        let Some((pose, parallax)) = found else {
            continue;
        };
        if parallax < limits.min_parallax_deg {
            continue;
        }
        let on_plane = homography(&pixels, limits.max_error_px, seed);
        let share = on_plane.map_or(0.0, |found| found.1 as f64 / n as f64);
        let is_calibrated = scene.views[a].is_calibrated && scene.views[b].is_calibrated;
        // With a wrong focal length a mere turn looks like parallax.
        if share > PLANE_SHARE && !is_calibrated && scene.submaps.is_empty() {
            continue;
        }
        let flat = if share > PLANE_SHARE { 0.1 } else { 1.0 };
        pairs.push(FirstPair {
            score: flat * n as f64 * parallax.min(ENOUGH_PARALLAX_DEG),
            ends: (a, b),
            second_from_first: pose,
            plane: on_plane
                .filter(|_| share > BOTH_MOTIONS_SHARE)
                .map(|found| found.0),
            is_metric: false,
        });
        if let Some(link) = scene.links.get_mut(&(a, b)) {
            link.motion = Some((pose, parallax));
        }
    }
    pairs.sort_by(|x, y| y.score.total_cmp(&x.score).then(x.ends.cmp(&y.ends)));
    (pairs, has_matches)
}

/// The motion between two views by what a depth sensor measured at the features of the first, which takes no parallax and leaves
/// no second solution. `None` where too little was measured, and for a camera whose lens is unknown.
fn metric_pair(
    scene: &Reconstruction,
    (a, b): (usize, usize),
    limits: &Limits,
    seed: u64,
) -> Option<FirstPair> {
    let (first, second) = (&scene.views[a], &scene.views[b]);
    let depths = first.measured.as_ref()?;
    if !first.is_calibrated || !second.is_calibrated {
        return None;
    }
    let matches = scene.links[&(a, b)].matches.iter();
    let measured = matches.filter_map(|&(ours, theirs)| {
        let inverse = depths.of(ours as usize)?.inverse;
        let ray = first.lens.ray_in_cam(first.features.pixels[ours as usize]);
        Some((ray / inverse, second.features.pixels[theirs as usize]))
    });
    let (points, pixels): (Vec<DVec3>, Vec<DVec2>) = measured.unzip();
    let gates = (1.5 * limits.max_error_px, limits.min_inliers);
    let found = pnp::place(&points, &pixels, &second.lens, gates, seed)?;
    let share = found.inliers.len() as f64 / points.len() as f64;
    (share >= MIN_EXPLAINED).then_some(FirstPair {
        // Any such pair goes before those that need parallax.
        score: MUCH_PARALLAX_DEG * found.inliers.len() as f64,
        ends: (a, b),
        second_from_first: found.cam_from_world,
        plane: None,
        is_metric: true,
    })
}

/// A submap that was started.
struct Made {
    n_views: usize,
    /// Matches that it explains, and their share.
    n_explained: usize,
    explained: f64,
}

/// The new submap, the last one; `None` and no submap where the scene does not hold.
fn attempt(
    scene: &mut Reconstruction,
    waiting: &[usize],
    pair: &FirstPair,
    min_views: usize,
    limits: &Limits,
) -> Option<Made> {
    let (a, b) = pair.ends;
    let radial = scene.radial;
    let submap = scene.submaps.len() as u32;
    scene.submaps.push(Submap {
        is_metric: pair.is_metric,
        ..Submap::default()
    });
    scene.place(a, submap, Rigid::IDENTITY);
    scene.place(b, submap, pair.second_from_first);
    extend(scene, b, limits.max_error_px);
    adjust_global(scene, submap, limits.max_error_px, 15);
    extend(scene, b, limits.max_error_px);
    let n = scene.landmarks_of(&[a, b]).len();
    let has_depth = pair.is_metric || parallax_deg(scene, b) >= limits.min_parallax_deg;
    if n >= limits.min_inliers && has_depth {
        for &view in waiting {
            scene.views[view].failed_with = 0;
        }
        grow(scene, waiting, limits);
        adjust_global(scene, submap, limits.max_error_px, 15);
        let views = &scene.submaps[submap as usize].views;
        let n = views.len();
        let (n_explained, n_matches) = explained_matches(scene, submap);
        let explained = n_explained as f64 / n_matches.max(1) as f64;
        let error_px = median_error_px(scene, views);
        tracing::debug!(a, b, n, explained, error_px, "start of a submap");
        let is_free = submap == 0 && views.iter().any(|&s| !scene.views[s].is_calibrated);
        let least = if is_free {
            MIN_EXPLAINED_FREE
        } else {
            MIN_EXPLAINED
        };
        // Any few images fit some focal length.
        let is_enough = n >= min_views && (!is_free || 2 * n > waiting.len());
        if is_enough && error_px <= 0.75 * limits.max_error_px && explained >= least {
            if !scene.submaps[submap as usize].is_metric {
                normalise(scene, submap, a);
            }
            return Some(Made {
                n_views: n,
                n_explained,
                explained,
            });
        }
    }
    scene.dissolve(submap);
    scene.radial = radial;
    scene.undistort();
    None
}

/// Median of the widest angles at which the landmarks of a view are seen.
pub(crate) fn parallax_deg(scene: &Reconstruction, view_ix: usize) -> f64 {
    let seen = scene.views[view_ix]
        .landmark_of
        .iter()
        .filter(|l| **l != NONE);
    let angle = |&l: &u32| {
        let landmark = &scene.landmarks[l as usize];
        let centres: Vec<_> = landmark
            .seen
            .iter()
            .filter_map(|at| scene.centre(at.0 as usize))
            .collect();
        widest_angle(&centres, landmark.point).to_degrees()
    };
    median(&mut seen.map(angle).collect::<Vec<f64>>()).unwrap_or(0.0)
}

/// Of the matches between the views of a submap, those whose two features see one landmark, and all. A scene turned inside
/// out (the bas-relief ambiguity) has small errors, too, but leaves many matches out.
fn explained_matches(scene: &Reconstruction, submap: u32) -> (usize, usize) {
    let (mut explained, mut all) = (0, 0);
    for ((a, b), link) in &scene.links {
        if scene.submap_of(*a) != Some(submap) || scene.submap_of(*b) != Some(submap) {
            continue;
        }
        let (first, second) = (&scene.views[*a], &scene.views[*b]);
        let agrees = |m: &&(u32, u32)| {
            let landmark = first.landmark_of[m.0 as usize];
            landmark != NONE && landmark == second.landmark_of[m.1 as usize]
        };
        explained += link.matches.iter().filter(agrees).count();
        all += link.matches.len();
    }
    (explained, all)
}

/// Median depth in the first view becomes 1.
fn normalise(scene: &mut Reconstruction, submap: u32, first: usize) {
    if let Some(depth) = median(&mut scene.depths(first)).filter(|d| *d > 0.0) {
        scene.transform(
            submap,
            &Similarity {
                scale: 1.0 / depth,
                ..Similarity::IDENTITY
            },
        );
    }
}
