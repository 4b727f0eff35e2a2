//! Splats come where a view shows holes or errors, and go, or move, when they have become transparent.

use std::sync::Arc;

use glam::DVec3;
use rand::Rng;

use crate::mapper::params::{RelocationRule, Start};
use crate::mapper::parts::Parts;
use crate::mapper::splats::seeds::{Guess, Seeds};
use crate::mapper::train::seed::{self, SeedView};
use crate::mapper::train::transient;
use splat_engine::error::EngineError;
use splat_engine::mcmc::Relocation;
use splat_engine::settings::McmcSettings;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// MCMC moves take in splats that one of the last so many rounds through all views has seen; the rest of a large map
/// is not under optimisation, and its splats are no measure of anything.
const ACTIVE_ROUNDS: usize = 4;
const MIN_ACTIVE_STEPS: usize = 500;
/// A guess that is off by a smaller part of its depth lies on the surface: steps move it the rest of the way.
const SAME_SURFACE: f64 = 0.02;

/// Splats where a keyframe's depth says that the map has a hole or is wrong; none where the scene's points are the start.
pub(crate) fn seed_from(
    map: &mut Parts<'_>,
    rng: &mut impl Rng,
    keyframe_id: u32,
    fills_gaps: bool,
) -> Result<(), EngineError> {
    if map.params.train.start == Start::Points {
        return Ok(());
    }
    let registered = map.keyframes.registered().get(&keyframe_id);
    let Some(depth) = registered.map(|registered| Arc::clone(&registered.depth)) else {
        return Ok(());
    };
    let budget = map.params.train.seeds_per_keyframe;
    let seeds = seeds(map, rng, (keyframe_id, &depth), fills_gaps, budget)?;
    map.splats.append_seeds(&seeds, map.engine)
}

/// Splats that stand in until a keyframe's depth comes, from that of its landmarks.
pub(crate) fn seed_provisional(
    map: &mut Parts<'_>,
    rng: &mut impl Rng,
    keyframe_id: u32,
    depth: &DepthMap,
) -> Result<(), EngineError> {
    if map.params.train.start == Start::Points {
        return Ok(());
    }
    let budget = map.params.train.seeds_per_keyframe;
    let mut seeds = seeds(map, rng, (keyframe_id, depth), true, budget)?;
    seeds.is_guess.fill(true);
    map.splats.append_seeds(&seeds, map.engine)
}

/// Guessed splats meet a keyframe's depth, new or better: those on a surface that it has verified are right and stay, those at or
/// before one go, and so do all others that it was given itself.
pub(crate) fn judge_guesses(map: &mut Parts<'_>, keyframe_id: u32) -> Result<(), EngineError> {
    let Some((lens, cam_from_world)) = camera(map, keyframe_id)? else {
        return Ok(());
    };
    let Some(registered) = map.keyframes.registered().get(&keyframe_id) else {
        return Ok(());
    };
    let depth = &registered.depth;
    let lens = lens.resized(depth.width_px, depth.height_px);
    let judge = |splats: &Splats, ix: usize| {
        let mean = DVec3::from(splats.means[ix].map(f64::from));
        let in_cam = cam_from_world.transform_point(mean);
        let at = lens.project(in_cam).and_then(|pixel| depth.pixel_at(pixel));
        let ratio = at
            .and_then(|at| depth.verified(at))
            .map(|(z, _)| in_cam.z / f64::from(z));
        match ratio {
            Some(ratio) if (ratio - 1.0).abs() < SAME_SURFACE => Guess::Confirmed,
            Some(ratio) if ratio < f64::from(seed::DEPTH_RATIO) => Guess::Replaced,
            _ if splats.anchors[ix] == keyframe_id => Guess::Replaced,
            _ => Guess::Open,
        }
    };
    map.splats.judge_guesses(judge, map.engine)
}

fn seeds(
    map: &mut Parts<'_>,
    rng: &mut impl Rng,
    (keyframe_id, depth): (u32, &DepthMap),
    fills_gaps: bool,
    budget: usize,
) -> Result<Seeds, EngineError> {
    let room = map
        .splats
        .cap(map.params, map.keyframes, map.engine)
        .saturating_sub(map.engine.len());
    if room == 0 {
        return Ok(Seeds::default());
    }
    let Some(camera) = camera(map, keyframe_id)? else {
        return Ok(Seeds::default());
    };
    let rendering = shown(map, &camera, 0)?;
    let Some(registered) = map
        .keyframes
        .registered()
        .get(&keyframe_id)
        .filter(|p| !p.is_held_out)
    else {
        return Ok(Seeds::default());
    };
    let view = SeedView {
        keyframe_id,
        image: &registered.image,
        intrinsics: &camera.0,
        world_from_cam: &camera.1.inverse(),
        depth,
        rendering: rendering.as_ref(),
        fills_gaps,
    };
    let mut seeds = seed::seed(&view, budget, map.params.train.sh_degree, rng);
    seeds.truncate(room);
    let n_seeds = seeds.splats.len();
    tracing::debug!(keyframe_id, n_seeds, fills_gaps, "seeded");
    Ok(seeds)
}

/// Transparent splats move to where others are, and some are added (3DGS-MCMC).
pub(crate) fn relocate(
    map: &mut Parts<'_>,
    n_trainable: usize,
    seed: u64,
) -> Result<(), EngineError> {
    let active_steps = (ACTIVE_ROUNDS * n_trainable).max(MIN_ACTIVE_STEPS);
    let is_over_all = map.params.mcmc.all_splats;
    let settings = McmcSettings {
        min_opacity: map.params.mcmc.min_opacity,
        copies: match map.params.mcmc.relocation {
            RelocationRule::Image => Relocation::Image,
            RelocationRule::Paper => Relocation::Line,
        },
        max_splats: map.splats.cap(map.params, map.keyframes, map.engine),
        growth: map.params.mcmc.growth,
        active_steps: if is_over_all { 0 } else { active_steps as u32 },
        keeps_age: is_over_all,
        seed: seed as u32,
    };
    map.engine.relocate_and_grow(&settings)?;
    map.splats.number(map.engine);
    Ok(())
}

/// A keyframe's camera as it is refined by now.
pub(crate) fn camera(
    map: &mut Parts<'_>,
    keyframe_id: u32,
) -> Result<Option<(Intrinsics, Rigid)>, EngineError> {
    let Some(registered) = map.keyframes.registered().get(&keyframe_id) else {
        return Ok(None);
    };
    let intrinsics = registered.intrinsics.refocused(map.engine.focal_scale()?);
    Ok(Some((intrinsics, map.engine.poses()?[registered.view_ix])))
}

/// What the map shows to a camera; `None` for an empty map.
pub(crate) fn shown(
    map: &mut Parts<'_>,
    camera: &(Intrinsics, Rigid),
    sh_degree: u8,
) -> Result<Option<Rendering>, EngineError> {
    let (intrinsics, cam_from_world) = camera;
    let is_empty = map.engine.len() == 0;
    (!is_empty)
        .then(|| map.engine.render(intrinsics, cam_from_world, sh_degree))
        .transpose()
}

pub(crate) fn mask_transients(map: &mut Parts<'_>, keyframe_id: u32) -> Result<(), EngineError> {
    if map.params.train.robust_inlier_fraction >= 1.0 {
        return Ok(());
    }
    let rendering = match camera(map, keyframe_id)? {
        Some(camera) => shown(map, &camera, map.params.train.sh_degree)?,
        None => None,
    };
    let registered = map.keyframes.registered().get(&keyframe_id);
    if let Some((registered, rendering)) = registered.zip(rendering) {
        if registered.image.is_unloaded() {
            return Ok(());
        }
        let mask = transient::mask(
            &registered.image,
            &rendering,
            map.params.train.robust_inlier_fraction,
        );
        map.engine.set_mask(registered.view_ix, mask)?;
    }
    Ok(())
}
