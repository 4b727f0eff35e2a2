//! Splats that no step has moved yet -> the size, opacity and rotation that 3DGS-MCMC starts from (gsplat): a tenth of the distance to
//! the three nearest neighbours in the whole map, 0.5, any.

use glam::DVec3;
use rand::{Rng, RngExt};

use crate::mapper::parts::Parts;
use crate::mapper::train::nearest::spacings;
use splat_engine::error::EngineError;
use splat_types::splats::splats::Splats;

/// Standard deviation as a share of the distance to the neighbours.
const SHARE_OF_SPACING: f64 = 0.1;
/// Of opacity 0.5.
const OPACITY_LOGIT: f32 = 0.0;
/// Least distance that splats in one place are given, as a share of the scene's depth.
const LEAST_SPACING: f64 = 1e-6;

/// Reshapes all splats that have had no update.
pub(crate) fn reshape_fresh(map: &mut Parts<'_>, rng: &mut impl Rng) -> Result<(), EngineError> {
    let is_fresh: Vec<bool> = map
        .engine
        .update_counts()?
        .iter()
        .map(|n| *n == 0)
        .collect();
    if !is_fresh.contains(&true) {
        return Ok(());
    }
    let mut splats = map.engine.read()?;
    let least = LEAST_SPACING * f64::from(map.keyframes.scene_depth());
    reshape(&mut splats, &is_fresh, least, rng);
    map.engine.replace(&splats)
}

fn reshape(splats: &mut Splats, is_fresh: &[bool], least: f64, rng: &mut impl Rng) {
    let points: Vec<DVec3> = splats
        .means
        .iter()
        .map(|m| DVec3::from(m.map(f64::from)))
        .collect();
    let spacings = spacings(&points);
    for ix in (0..points.len()).filter(|ix| is_fresh[*ix]) {
        let scale = SHARE_OF_SPACING * spacings[ix].max(least);
        splats.log_scales[ix] = [scale.max(f64::from(f32::MIN_POSITIVE)).ln() as f32; 3];
        splats.opacity_logits[ix] = OPACITY_LOGIT;
        // As the authors draw it; it is normalised on use.
        splats.quats[ix] = std::array::from_fn(|_| rng.random_range(f32::EPSILON..1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn fresh_splats_are_a_tenth_as_wide_as_their_neighbours_are_far_and_others_stay() {
        let mut splats = Splats::default();
        for x in 0..5 {
            splats.means.push([x as f32 * 2.0, 0.0, 1.0]);
            splats.log_scales.push([0.0; 3]);
            splats.quats.push([1.0, 0.0, 0.0, 0.0]);
            splats.opacity_logits.push(3.0);
            splats.anchors.push(0);
            splats.sh.extend([0.0; 3]);
        }
        let before = splats.clone();
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        reshape(
            &mut splats,
            &[true, false, true, true, true],
            1e-6,
            &mut rng,
        );
        // The middle one has neighbours at 2, 2 and 4.
        let expected = 0.1 * (24.0_f32 / 3.0).sqrt();
        assert!((splats.log_scales[2][0].exp() - expected).abs() < 1e-6);
        assert_eq!(splats.opacity_logits[2], 0.0);
        assert_ne!(splats.quats[2], splats.quats[3]);
        assert_eq!(splats.log_scales[1], before.log_scales[1]);
        assert_eq!(
            (splats.quats[1], splats.opacity_logits[1]),
            (before.quats[1], 3.0)
        );
    }
}
