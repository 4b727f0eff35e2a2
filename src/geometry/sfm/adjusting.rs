//! Landmarks and shots -> bundle adjustment problems and back: around one shot, or of a whole component.

use std::collections::BTreeMap;

use super::landmarks::filter;
use super::scene::Scene;
use crate::geometry::bundle::{Camera, Observation, Problem, Settings, adjust};
use crate::geometry::two_view::median;
use crate::pose::Similarity;

/// Shots that move in a local adjustment.
const N_LOCAL: usize = 7;
/// Shots that move in a global adjustment; the newest of larger components.
const MAX_GLOBAL: usize = 150;
/// Residual at which the loss bends, as a share of the largest error of an inlier.
const LOSS_SHARE: f64 = 0.5;
/// Views from which on the focal length can be told from depth (GEOMETRY.md measured 3 to be too few, 6 enough).
const MIN_FOCAL_VIEWS: usize = 6;

/// Adjusts a shot and those that share most landmarks with it; all others stay.
pub(super) fn adjust_local(scene: &mut Scene, shot_ix: usize, max_error_px: f64) {
    let Some(component) = scene.component_of(shot_ix) else {
        return;
    };
    if scene.components[component as usize].shots.len() <= N_LOCAL + 1 {
        adjust_global(scene, component, max_error_px, 6);
        return;
    }
    let mut ranked: Vec<(u32, usize)> = scene
        .shared_counts(shot_ix)
        .into_iter()
        .map(|(s, n)| (n, s))
        .collect();
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.cmp(&a.1)));
    let mut free: Vec<usize> = ranked.iter().take(N_LOCAL - 1).map(|r| r.1).collect();
    free.push(shot_ix);
    // The first shot holds the frame of its component.
    let first = scene.components[component as usize].shots[0];
    free.retain(|&s| s != first);
    run(scene, &free, max_error_px, (5, false));
}

/// Adjusts all shots of a component but the first, and keeps its scale.
pub(super) fn adjust_global(
    scene: &mut Scene,
    component: u32,
    max_error_px: f64,
    max_steps: usize,
) {
    let shots = scene.components[component as usize].shots.clone();
    let Some(&first) = shots.first() else { return };
    let free: Vec<usize> = shots[1..]
        .iter()
        .rev()
        .take(MAX_GLOBAL)
        .rev()
        .copied()
        .collect();
    let holds_all = free.len() + 1 == shots.len();
    let before = spread(scene, first, &shots);
    run(
        scene,
        &free,
        max_error_px,
        (max_steps, shots.len() >= MIN_FOCAL_VIEWS),
    );
    // With one camera held the scale is free; it would drift from one adjustment to the next.
    if holds_all && let Some(centre) = scene.centre(first) {
        let mut ratios: Vec<f64> = spread(scene, first, &shots)
            .iter()
            .zip(&before)
            .map(|(a, b)| b / a)
            .collect();
        ratios.retain(|r| r.is_finite() && *r > 0.0);
        if let Some(scale) = median(&mut ratios) {
            let new_from_old = Similarity {
                scale,
                translation: centre * (1.0 - scale),
                ..Similarity::IDENTITY
            };
            scene.transform(component, &new_from_old);
        }
    }
    scene.components[component as usize].n_adjusted = shots.len();
}

fn spread(scene: &Scene, first: usize, shots: &[usize]) -> Vec<f64> {
    let origin = scene.centre(first).unwrap_or_default();
    shots[1..]
        .iter()
        .map(|&s| scene.centre(s).unwrap_or_default().distance(origin))
        .collect()
}

/// Median reprojection error over the landmarks of some shots.
pub(super) fn median_error_px(scene: &Scene, shots: &[usize]) -> f64 {
    let mut errors = Vec::new();
    for landmark in scene.landmarks_of(shots) {
        let landmark = &scene.landmarks[landmark as usize];
        errors.extend(
            landmark
                .seen
                .iter()
                .filter_map(|&at| scene.sight(at))
                .map(|s| s.error_px(landmark.point)),
        );
    }
    median(&mut errors).unwrap_or(0.0)
}

fn run(
    scene: &mut Scene,
    free: &[usize],
    max_error_px: f64,
    (max_steps, refine_focal): (usize, bool),
) {
    let landmarks = scene.landmarks_of(free);
    let mut problem = Problem::default();
    let mut camera_of: BTreeMap<u32, usize> = BTreeMap::new();
    let mut shots = Vec::new();
    for &landmark in &landmarks {
        let landmark = &scene.landmarks[landmark as usize];
        let mut seen = Vec::with_capacity(landmark.seen.len());
        for &at in &landmark.seen {
            let shot = &scene.shots[at.0 as usize];
            let Some(placed) = &shot.placed else { continue };
            let camera_ix = *camera_of.entry(at.0).or_insert_with(|| {
                problem.cameras.push(Camera {
                    cam_from_map: placed.cam_from_map,
                    intrinsics: shot.lens,
                    is_fixed: !free.contains(&(at.0 as usize)),
                    shares_focal: !shot.is_calibrated,
                });
                shots.push(at.0 as usize);
                shots.len() - 1
            });
            seen.push(Observation {
                camera_ix,
                pixel: scene.pixel(at),
            });
        }
        problem.points.push(landmark.point);
        problem.observations.push(seen);
    }
    let settings = Settings {
        max_steps,
        loss_px: LOSS_SHARE * max_error_px,
        refine_focal,
    };
    adjust(&mut problem, &settings);
    for (&shot, camera) in shots.iter().zip(&problem.cameras) {
        if let Some(placed) = &mut scene.shots[shot].placed {
            placed.cam_from_map = camera.cam_from_map;
        }
    }
    let moved = problem
        .cameras
        .iter()
        .zip(&shots)
        .find(|(c, _)| c.shares_focal);
    if let Some((camera, &shot)) = moved.filter(|_| refine_focal) {
        share_focal(scene, camera.intrinsics.fx / scene.shots[shot].lens.fx);
    }
    for (&landmark, point) in landmarks.iter().zip(&problem.points) {
        scene.landmarks[landmark as usize].point = *point;
    }
    filter(scene, &landmarks, max_error_px);
}

/// One camera took all uncalibrated shots, so all change alike.
fn share_focal(scene: &mut Scene, factor: f64) {
    for shot in scene.shots.iter_mut().filter(|s| !s.is_calibrated) {
        shot.lens.fx *= factor;
        shot.lens.fy *= factor;
    }
}
