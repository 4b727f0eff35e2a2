//! A motion of cameras -> the splats that they saw, moved along.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use splat_engine::error::EngineError;
use splat_engine::sh_rotation::ShRotation;
use splat_engine::traits::Engine;
use splat_types::splats::splats::Splats;
use splat_types::transform::Similarity;

/// A motion of cameras that carries splats along: their means, sizes, orientations and view-dependent colours.
#[derive(Debug, Clone)]
pub struct Carry {
    motion: Similarity,
    log_scale: f32,
    bands: ShRotation,
}

impl Carry {
    /// For splats of this SH degree.
    pub fn new(motion: Similarity, sh_degree: u8) -> Self {
        Self {
            bands: ShRotation::new(motion.rotation, sh_degree),
            log_scale: motion.scale.ln() as f32,
            motion,
        }
    }

    /// Moves splat `i`.
    pub fn transform(&self, splats: &mut Splats, i: usize) {
        let mean = &mut splats.means[i];
        let moved = self
            .motion
            .transform_point(DVec3::from(mean.map(f64::from)));
        *mean = moved.as_vec3().to_array();
        splats.log_scales[i] = splats.log_scales[i].map(|l| l + self.log_scale);
        let [w, x, y, z] = splats.quats[i].map(f64::from);
        let turned = self.motion.rotation * DQuat::from_xyzw(x, y, z, w);
        splats.quats[i] = [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32);
        let stride = splats.sh_stride();
        self.bands
            .apply(&mut splats.sh[i * stride..(i + 1) * stride]);
    }
}

/// Moves all splats of the engine.
pub(crate) fn transform_all(
    motion: Similarity,
    engine: &mut dyn Engine,
) -> Result<(), EngineError> {
    let mut splats = engine.read()?;
    carry_all(motion, &mut splats);
    engine.replace(&splats)
}

/// Moves the splats that were seeded from each of these keyframes.
pub(crate) fn transform_seeded(
    motions: &BTreeMap<u32, Similarity>,
    engine: &mut dyn Engine,
) -> Result<(), EngineError> {
    let mut splats = engine.read()?;
    carry_seeded(motions, &mut splats);
    engine.replace(&splats)
}

/// The same of splats that are not in an engine.
pub(crate) fn carry_seeded(motions: &BTreeMap<u32, Similarity>, splats: &mut Splats) {
    let carries: BTreeMap<u32, Carry> = motions
        .iter()
        .map(|(id, motion)| (*id, Carry::new(*motion, splats.sh_degree)))
        .collect();
    for i in 0..splats.len() {
        if let Some(carry) = carries.get(&splats.anchors[i]) {
            carry.transform(splats, i);
        }
    }
}

/// Moves all of them.
pub(crate) fn carry_all(motion: Similarity, splats: &mut Splats) {
    let carry = Carry::new(motion, splats.sh_degree);
    (0..splats.len()).for_each(|i| carry.transform(splats, i));
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_types::transform::Rigid;

    fn pose(i: f64) -> Rigid {
        Rigid::exp(
            DVec3::new(i, 0.3 * i * i, -0.2 * i),
            DVec3::new(0.1 * i, -0.05, 0.2),
        )
    }

    #[test]
    fn a_carried_splat_keeps_its_place_before_the_camera() {
        let (old, new) = (pose(1.0), pose(1.2));
        let unit = Similarity {
            scale: 1.5,
            ..Similarity::IDENTITY
        };
        let motion = Similarity::from(new) * unit * old.inverse().into();
        let in_cam = DVec3::new(0.1, 0.2, 2.0);
        let mut splats = Splats {
            means: vec![old.transform_point(in_cam).as_vec3().to_array()],
            log_scales: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.0],
            sh: vec![0.5; 12],
            sh_degree: 1,
            anchors: vec![0],
        };
        Carry::new(motion, 1).transform(&mut splats, 0);
        let back = new
            .inverse()
            .transform_point(DVec3::from(splats.means[0].map(f64::from)));
        assert!((back - in_cam * 1.5).length() < 1e-5, "{back}");
        assert!((splats.log_scales[0][2] - 1.5f32.ln()).abs() < 1e-6);
        assert!((f64::from(splats.quats[0][0]) - motion.rotation.w.abs()).abs() < 1e-6);
        assert_eq!(splats.sh[..3], [0.5; 3]);
    }
}
