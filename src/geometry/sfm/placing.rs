//! Waiting shots -> poses in a component, best supported first; each one brings landmarks and a local adjustment.

use glam::{DVec2, DVec3};

use super::Limits;
use super::adjusting::{adjust_global, adjust_local};
use super::landmarks::extend;
use super::links::pair_seed;
use super::scene::{NONE, Scene};
use crate::geometry::pnp;

/// Share of the candidate landmarks that must agree with a pose.
const MIN_SHARE: f64 = 0.25;
/// Growth of a component after which all its shots are adjusted together.
const GLOBAL_GROWTH: f64 = 1.3;
/// A shot whose landmarks all lie in a smaller part of the picture (standard deviation as a share of the longer
/// side) could slide or turn freely.
const MIN_SPREAD: f64 = 0.03;

/// Places as many of the waiting shots of `pool` as can be placed.
pub(super) fn grow(scene: &mut Scene, pool: &[usize], limits: &Limits) {
    while let Some((shot, component, pairs)) = best_waiting(scene, pool, limits) {
        let Some(cam_from_map) = pose(scene, shot, &pairs, limits) else {
            scene.shots[shot].failed_with = pairs.len();
            continue;
        };
        scene.place(shot, component, cam_from_map);
        extend(scene, shot, limits.max_error_px);
        adjust_local(scene, shot, limits);
        // Landmarks that the adjustment threw out again spoke for a wrong pose.
        let n_left = scene.shots[shot]
            .landmark_of
            .iter()
            .filter(|l| **l != NONE)
            .count();
        if 3 * n_left < 2 * limits.min_inliers {
            scene.unplace(shot);
            scene.shots[shot].failed_with = pairs.len();
            continue;
        }
        let size = &scene.components[component as usize];
        if size.shots.len() as f64 >= GLOBAL_GROWTH * size.n_adjusted as f64 {
            adjust_global(scene, component, limits.max_error_px, 8);
        }
    }
}

/// Features of a shot whose matches have landmarks in a component: (feature, landmark), the most named one each.
pub(super) fn correspondences(scene: &Scene, shot_ix: usize, component: u32) -> Vec<(u32, u32)> {
    let mut pairs = Vec::new();
    for (feature, matched) in scene.shots[shot_ix].matched.iter().enumerate() {
        let owners = matched
            .iter()
            .map(|&(s, f)| scene.shots[s as usize].landmark_of[f as usize]);
        let mut named: Vec<u32> = owners.filter(|&l| l != NONE).collect();
        named.retain(|&l| scene.landmarks[l as usize].component == component);
        named.sort_unstable();
        let count = |l: &u32| named.iter().filter(|n| *n == l).count();
        if let Some(best) = named.iter().rev().max_by_key(|l| count(l)) {
            pairs.push((feature as u32, *best));
        }
    }
    pairs
}

type Waiting = (usize, u32, Vec<(u32, u32)>);

/// The waiting shot with most landmarks in one component; one that failed needs a fifth more than then.
fn best_waiting(scene: &Scene, pool: &[usize], limits: &Limits) -> Option<Waiting> {
    let mut best: Option<Waiting> = None;
    for &shot in pool.iter().filter(|&&s| scene.shots[s].placed.is_none()) {
        for component in 0..scene.components.len() as u32 {
            let pairs = correspondences(scene, shot, component);
            let needed = limits
                .min_inliers
                .max(scene.shots[shot].failed_with * 6 / 5 + 1);
            let is_better = best.as_ref().is_none_or(|b| pairs.len() > b.2.len());
            if pairs.len() >= needed && is_better {
                best = Some((shot, component, pairs));
            }
        }
    }
    best
}

fn pose(
    scene: &Scene,
    shot_ix: usize,
    pairs: &[(u32, u32)],
    limits: &Limits,
) -> Option<crate::pose::Rigid> {
    let shot = &scene.shots[shot_ix];
    let points: Vec<DVec3> = pairs
        .iter()
        .map(|p| scene.landmarks[p.1 as usize].point)
        .collect();
    let pixels: Vec<DVec2> = pairs
        .iter()
        .map(|p| shot.features.pixels[p.0 as usize])
        .collect();
    let seed = pair_seed(limits.seed, shot_ix, pairs.len());
    let found = pnp::place(
        &points,
        &pixels,
        &shot.lens,
        (1.5 * limits.max_error_px, limits.min_inliers),
        seed,
    )?;
    let share = found.inliers.len() as f64 / pairs.len() as f64;
    let picked: Vec<DVec2> = found.inliers.iter().map(|&i| pixels[i]).collect();
    let longest = f64::from(shot.lens.width_px.max(shot.lens.height_px));
    (share >= MIN_SHARE && spread(&picked) >= MIN_SPREAD * longest).then_some(found.cam_from_map)
}

fn spread(pixels: &[DVec2]) -> f64 {
    let n = pixels.len().max(1) as f64;
    let mean = pixels.iter().sum::<DVec2>() / n;
    (pixels.iter().map(|p| p.distance_squared(mean)).sum::<f64>() / n).sqrt()
}
