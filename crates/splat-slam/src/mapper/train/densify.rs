//! Splats come and go by the threshold on their screen gradients (3D Gaussian Splatting, Kerbl et al. 2023): when, and with which
//! lengths. Who is cloned, split or removed is `splat_engine::densify`'s.

use crate::mapper::params::DensifyParams;
use crate::mapper::parts::Parts;
use crate::mapper::train::scene_extent::scene_radius;
use splat_engine::densify::{self, DensifySettings, Fate};
use splat_engine::error::EngineError;

/// Opacities are held to this multiple of the least one, 0.01 in 3DGS: what is needed has time to come back.
const RESET_OF_MIN_OPACITY: f32 = 2.0;

/// What is due after so many steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Due {
    pub(crate) densifies: bool,
    pub(crate) resets: bool,
}

/// Whether a step adds up gradients, of which `n_steps` were made before.
pub(crate) fn accumulates(params: &DensifyParams, n_steps: u64) -> bool {
    params.enabled && n_steps < params.until
}

/// What follows the `n_steps`-th step.
pub(crate) fn due(params: &DensifyParams, n_steps: u64) -> Due {
    let is_on = params.enabled && n_steps < params.until;
    let resets_ever = params.opacity_reset_every > 0;
    Due {
        densifies: is_on && n_steps > params.start && n_steps.is_multiple_of(params.every),
        resets: is_on && resets_ever && n_steps.is_multiple_of(params.opacity_reset_every),
    }
}

/// Does what is due after the `n_steps`-th step.
pub(crate) fn densify_if_due(
    map: &mut Parts<'_>,
    n_steps: u64,
    seed: u64,
) -> Result<(), EngineError> {
    let due = due(&map.params.densify, n_steps);
    if due.densifies && map.engine.len() > 0 {
        densify(map, n_steps, seed)?;
    }
    if due.resets {
        let most = RESET_OF_MIN_OPACITY * map.params.densify.min_opacity;
        map.engine.reset_opacities(most.min(0.5))?;
    }
    Ok(())
}

fn densify(map: &mut Parts<'_>, n_steps: u64, seed: u64) -> Result<(), EngineError> {
    let params = &map.params.densify;
    let radius = scene_radius(map)?;
    // Before the first reset nothing is too large: what is far away begins as one large splat.
    let bounds_size = params.max_share > 0.0 && n_steps > params.opacity_reset_every;
    let settings = DensifySettings {
        gradient: params.gradient,
        dense_scale: params.dense_share * radius,
        max_scale: if bounds_size {
            params.max_share * radius
        } else {
            f32::INFINITY
        },
        min_opacity: params.min_opacity,
        max_splats: map.splats.cap(map.params, map.keyframes, map.engine),
        seed: (seed ^ n_steps) as u32,
    };
    let gradients = map.engine.take_screen_gradients()?;
    let (splats, update_counts) = (map.engine.read()?, map.engine.update_counts()?);
    let fates = densify::fates(&splats, &gradients, &settings);
    let made = densify::densify(&splats, &fates, settings.seed);
    if made.keep.contains(&false) {
        map.splats.retain(&made.keep, map.engine)?;
    }
    let first = map.engine.len();
    if !made.parents.is_empty() {
        map.splats.append(&made.added, map.engine)?;
        // They are as old as those they stem from: bands of colour go on.
        let counts: Vec<u16> = made.parents.iter().map(|ix| update_counts[*ix]).collect();
        map.engine.set_update_counts(first, &counts)?;
    }
    let n_of = |wanted: Fate| fates.iter().filter(|fate| **fate == wanted).count();
    tracing::debug!(
        n_steps,
        n_cloned = n_of(Fate::Cloned),
        n_split = n_of(Fate::Split),
        n_removed = n_of(Fate::Removed),
        n_splats = map.engine.len(),
        radius,
        "densified"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_come_when_the_paper_has_them() {
        let params = DensifyParams {
            enabled: true,
            ..DensifyParams::default()
        };
        let at = |n| {
            let due = due(&params, n);
            (due.densifies, due.resets)
        };
        assert_eq!(at(500), (false, false));
        assert_eq!(at(600), (true, false));
        assert_eq!(at(650), (false, false));
        assert_eq!(at(3000), (true, true));
        assert_eq!(at(14_900), (true, false));
        assert_eq!(at(15_000), (false, false));
        assert!(accumulates(&params, 0) && accumulates(&params, 14_999));
        assert!(!accumulates(&params, 15_000));
        assert!(!accumulates(&DensifyParams::default(), 0));
        let never = DensifyParams {
            opacity_reset_every: 0,
            ..params
        };
        assert!(!due(&never, 3000).resets && due(&never, 3000).densifies);
    }
}
