//! Matches between registered views -> landmarks: made, extended, joined and thrown away by what their pixels say.

use glam::DVec3;

use crate::sfm::reconstruction::{NONE, Reconstruction};
use crate::two_view::triangulate::{Observation, has_angle, triangulate};

/// Below this angle between its rays a point's depth is mostly noise.
const MIN_ANGLE_DEG: f64 = 1.0;

/// Gives the features of a registered view landmarks: those of its matches, or new ones.
pub(crate) fn extend(scene: &mut Reconstruction, view_ix: usize, max_error_px: f64) {
    for feature in 0..scene.views[view_ix].landmark_of.len() {
        let at = (view_ix as u32, feature as u32);
        if scene.views[view_ix].landmark_of[feature] == NONE {
            adopt(scene, at, max_error_px);
        }
        if scene.views[view_ix].landmark_of[feature] == NONE {
            create(scene, at, max_error_px);
        } else {
            complete(scene, at, max_error_px);
        }
    }
}

/// Takes the landmark of a match if it projects to this feature.
fn adopt(scene: &mut Reconstruction, at: (u32, u32), max_error_px: f64) {
    let submap = scene.submap_of(at.0 as usize);
    let matched = &scene.views[at.0 as usize].matched[at.1 as usize];
    let owners = matched
        .iter()
        .map(|&(s, f)| scene.views[s as usize].landmark_of[f as usize]);
    let mut candidates: Vec<u32> = owners.filter(|&l| l != NONE).collect();
    candidates.sort_unstable();
    candidates.dedup();
    candidates.retain(|&l| Some(scene.landmarks[l as usize].submap) == submap);
    let Some(observation) = scene.observation(at) else {
        return;
    };
    let error = |l: &u32| observation.error_px(scene.landmarks[*l as usize].point);
    let best = candidates
        .iter()
        .map(|l| (error(l), *l))
        .min_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((error, landmark)) = best.filter(|b| b.0 <= max_error_px) {
        debug_assert!(error.is_finite());
        scene.add_observation(landmark, at);
    }
}

/// Hands a feature's landmark on to its matches, and joins it with theirs where both are the same point.
fn complete(scene: &mut Reconstruction, at: (u32, u32), max_error_px: f64) {
    let own = scene.views[at.0 as usize].landmark_of[at.1 as usize];
    let submap = scene.landmarks[own as usize].submap;
    for (view, feature) in scene.views[at.0 as usize].matched[at.1 as usize].clone() {
        if scene.submap_of(view as usize) != Some(submap) {
            continue;
        }
        let theirs = scene.views[view as usize].landmark_of[feature as usize];
        let point = scene.landmarks[own as usize].point;
        if theirs == NONE {
            let fits = scene
                .observation((view, feature))
                .is_some_and(|s| s.error_px(point) <= max_error_px);
            if fits {
                scene.add_observation(own, (view, feature));
            }
        } else if theirs != own && scene.landmarks[theirs as usize].submap == submap {
            join(scene, own, theirs, max_error_px);
        }
    }
}

/// Joins two landmarks if one point fits the observations of both.
pub(crate) fn join(scene: &mut Reconstruction, a: u32, b: u32, max_error_px: f64) {
    let (first, second) = (&scene.landmarks[a as usize], &scene.landmarks[b as usize]);
    let (n, m) = (first.seen.len() as f64, second.seen.len() as f64);
    let point = (first.point * n + second.point * m) / (n + m);
    let mut observations = first
        .seen
        .iter()
        .chain(&second.seen)
        .filter_map(|&at| scene.observation(at));
    if observations.all(|s| s.error_px(point) <= max_error_px) {
        scene.landmarks[a as usize].point = point;
        scene.join_landmarks(a, b);
    }
}

/// A new landmark from a feature and its matches in registered views.
fn create(scene: &mut Reconstruction, at: (u32, u32), max_error_px: f64) {
    let Some(submap) = scene.submap_of(at.0 as usize) else {
        return;
    };
    let free = |m: &&(u32, u32)| {
        scene.submap_of(m.0 as usize) == Some(submap)
            && scene.views[m.0 as usize].landmark_of[m.1 as usize] == NONE
    };
    let mut seen = vec![at];
    for m in scene.views[at.0 as usize].matched[at.1 as usize]
        .iter()
        .filter(free)
    {
        if seen.iter().all(|s| s.0 != m.0) {
            seen.push(*m);
        }
    }
    if let Some((point, seen)) = inlier_point(scene, &seen, max_error_px) {
        scene.add_landmark(point, submap, seen);
    }
}

/// The point that most of the observations agree on, if they see it from far enough apart. The first one must agree.
fn inlier_point(
    scene: &Reconstruction,
    seen: &[(u32, u32)],
    max_error_px: f64,
) -> Option<(DVec3, Vec<(u32, u32)>)> {
    let observations: Vec<Observation<'_>> = seen
        .iter()
        .filter_map(|&at| scene.observation(at))
        .collect();
    if observations.len() < 2 || observations.len() != seen.len() {
        return None;
    }
    let mut best: Option<(DVec3, Vec<usize>)> = None;
    let others = 1..observations.len();
    let triangulated = others.filter_map(|i| triangulate(&[observations[0], observations[i]]));
    let measured = seen.iter().filter_map(|at| scene.measured_point(*at));
    for point in triangulated.chain(measured) {
        let fits: Vec<usize> = (0..observations.len())
            .filter(|&i| observations[i].error_px(point) <= max_error_px)
            .collect();
        let agrees = fits.contains(&0) && fits.len() >= 2;
        if agrees && best.as_ref().is_none_or(|b| fits.len() > b.1.len()) {
            best = Some((point, fits));
        }
    }
    let (_, fits) = best?;
    let picked: Vec<Observation<'_>> = fits.iter().map(|&i| observations[i]).collect();
    let seen: Vec<(u32, u32)> = fits.iter().map(|&i| seen[i]).collect();
    let fit_all = |point: &DVec3| picked.iter().all(|s| s.error_px(*point) <= max_error_px);
    let is_sharp = |point: &DVec3| {
        let centres = picked.iter().map(Observation::centre_in_world);
        has_angle(centres, *point, MIN_ANGLE_DEG.to_radians())
    };
    let point = triangulate(&picked).filter(|point| is_sharp(point) && fit_all(point));
    // Where the rays are as good as parallel, what a sensor measured says how far it is.
    let point = point.or_else(|| mean_measured(scene, &seen).filter(fit_all));
    Some((point?, seen))
}

/// Mean of where the measured depths of the observations put their point; near ones are measured better.
fn mean_measured(scene: &Reconstruction, seen: &[(u32, u32)]) -> Option<DVec3> {
    let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
    for &at in seen {
        let measured = scene.measured(at).zip(scene.measured_point(at));
        if let Some((depth, point)) = measured {
            // The standard deviation of z grows with its square.
            let weight = depth.inverse.powi(4);
            sum += point * weight;
            weights += weight;
        }
    }
    (weights > 0.0).then(|| sum / weights)
}

/// Whether the measured depth of an observation says that its point is there.
fn is_measured(scene: &Reconstruction, at: (u32, u32), point: DVec3, max_error_px: f64) -> bool {
    let measured = scene.measured(at).zip(scene.observation(at));
    measured.is_some_and(|(depth, observation)| {
        let z = observation.cam_from_world.transform_point(point).z;
        depth.residual_px(z).abs() <= 2.0 * max_error_px
    })
}

/// Drops observations that do not fit their landmark, and landmarks without depth.
pub(crate) fn filter(scene: &mut Reconstruction, landmarks: &[u32], max_error_px: f64) {
    for &landmark in landmarks {
        let (point, seen) = {
            let l = &scene.landmarks[landmark as usize];
            (l.point, l.seen.clone())
        };
        let fits = |at: &(u32, u32)| {
            scene
                .observation(*at)
                .is_some_and(|s| s.error_px(point) <= max_error_px)
        };
        let kept: Vec<(u32, u32)> = seen.iter().copied().filter(fits).collect();
        let centres = kept.iter().filter_map(|at| scene.centre(at.0 as usize));
        let is_sharp = point.is_finite()
            && (has_angle(centres, point, 0.7 * MIN_ANGLE_DEG.to_radians())
                || kept
                    .iter()
                    .any(|at| is_measured(scene, *at, point, max_error_px)));
        if !is_sharp || kept.len() < seen.len() {
            scene.retain_observations(landmark, |at| is_sharp && kept.contains(at));
        }
    }
}
