//! Submaps that share no view -> one frame, by what odometry says of the way from one to the other.

use glam::{DQuat, DVec3};

use crate::sfm::adjust::adjust_global;
use crate::sfm::limits::Limits;
use crate::sfm::odometry::{MAX_MISFIT, in_time, metres_per_unit, misfit, motion, world_from_cam};
use crate::sfm::reconstruction::Reconstruction;
use splat_types::transform::{Rigid, Similarity, rotation_vector};

/// A submap whose unit is known no better is not joined to another.
const MAX_SCALE_STD: f64 = 0.03;
/// Views of a submap on either side of the one next to a gap, between which odometry must agree with the images.
const N_BESIDE: usize = 6;
/// Pairs of keyframes on either side of a gap that say how it is crossed.
const N_ACROSS: usize = 4;
/// A gap that is crossed with a larger standard deviation of the turn, in radians, stays open.
const MAX_TURN_STD: f64 = 0.3;
/// A submap that odometry may join to another.
struct Joinable {
    submap: u32,
    /// Metres in its unit.
    unit: f64,
}

/// Puts two submaps into one frame by what odometry says of the way from one to the other, the two that are nearest in time;
/// again, until it answers `false`. The submap with the lower number stays.
pub(crate) fn join_by_odometry(scene: &mut Reconstruction, limits: &Limits) -> bool {
    let joinable = |submap: u32| {
        let is_there = !scene.submaps[submap as usize].views.is_empty();
        let scale = is_there.then(|| metres_per_unit(scene, submap))??;
        let unit = scale.log.exp();
        (scale.std <= MAX_SCALE_STD).then_some(Joinable { submap, unit })
    };
    let all: Vec<Joinable> = (0..scene.submaps.len() as u32)
        .filter_map(joinable)
        .collect();
    let mut best: Option<(u32, u32, Crossing)> = None;
    for (ix, stays) in all.iter().enumerate() {
        for gone in &all[ix + 1..] {
            let found = crossing(scene, stays, gone);
            if let Some(found) = found.filter(|f| best.as_ref().is_none_or(|b| f.gap < b.2.gap)) {
                best = Some((stays.submap, gone.submap, found));
            }
        }
    }
    let Some((stays, gone, crossing)) = best else {
        return false;
    };
    tracing::info!(
        stays,
        gone,
        gap_keyframes = crossing.gap,
        gap_m = crossing.gap_m,
        std_deg = crossing.turn_std.to_degrees(),
        "two parts of the map are joined by odometry"
    );
    scene.absorb(stays, gone, &crossing.stays_from_gone);
    adjust_global(scene, stays, limits.max_error_px, 15);
    true
}

/// How one submap lies to another.
struct Crossing {
    stays_from_gone: Similarity,
    /// Keyframes between them, at the nearest.
    gap: usize,
    gap_m: f64,
    turn_std: f64,
}

/// By the pairs of keyframes, one of each submap, that are nearest to each other in time.
fn crossing(scene: &Reconstruction, stays: &Joinable, gone: &Joinable) -> Option<Crossing> {
    let theirs = in_time(scene, gone.submap);
    let mut pairs: Vec<(usize, usize, usize)> = Vec::new();
    for a in in_time(scene, stays.submap) {
        let next = theirs.partition_point(|b| *b < a);
        let near = theirs[next.saturating_sub(N_ACROSS)..]
            .iter()
            .take(2 * N_ACROSS);
        pairs.extend(near.map(|&b| (a.abs_diff(b), a, b)));
    }
    pairs.sort_unstable();
    let scale = gone.unit / stays.unit;
    let mut nearest = None;
    let (mut gap, mut gap_m, mut turn_std) = (0, 0.0, f64::INFINITY);
    let mut found: Vec<(DQuat, DVec3, Rigid, f64)> = Vec::new();
    for (away, a, b) in pairs {
        let Some(motion) = motion(scene, a, b) else {
            continue;
        };
        if found.is_empty() {
            nearest = Some((a, b));
            (gap, gap_m) = (away, motion.first_from_second.translation.length());
        }
        turn_std = turn_std.min(motion.std[1]);
        let step = Rigid {
            translation: motion.first_from_second.translation / stays.unit,
            ..motion.first_from_second
        };
        let predicted = world_from_cam(scene, a)? * step;
        let own = world_from_cam(scene, b)?;
        let turn = predicted.rotation * own.rotation.inverse();
        found.push((turn, predicted.translation, own, motion.std[1].powi(-2)));
        if found.len() == N_ACROSS {
            break;
        }
    }
    let agrees = |own: &Joinable, at: usize| {
        let views = in_time(scene, own.submap);
        let ix = views.partition_point(|view| *view < at);
        let beside = &views[ix.saturating_sub(N_BESIDE)..(ix + N_BESIDE).min(views.len())];
        misfit(scene, beside, own.unit).is_some_and(|off| off <= MAX_MISFIT)
    };
    let (a, b) = nearest?;
    if turn_std > MAX_TURN_STD || !agrees(stays, a) || !agrees(gone, b) {
        return None;
    }
    let total: f64 = found.iter().map(|f| f.3).sum();
    let first = found[0].0;
    let off =
        |f: &(DQuat, DVec3, Rigid, f64)| rotation_vector(first.inverse() * f.0) * (f.3 / total);
    let mean: DVec3 = found.iter().map(off).sum();
    let rotation = first * DQuat::from_scaled_axis(mean);
    // Where the origin goes is known best by where the keyframes near the gap go.
    let origin = |f: &(DQuat, DVec3, Rigid, f64)| {
        (f.1 - rotation * (f.2.translation * scale)) * (f.3 / total)
    };
    let stays_from_gone = Similarity {
        scale,
        rotation: rotation.normalize(),
        translation: found.iter().map(origin).sum(),
    };
    stays_from_gone.is_finite().then_some(Crossing {
        stays_from_gone,
        gap,
        gap_m,
        turn_std,
    })
}
