//! Poses of one batch in two frames -> the similarity between the frames.
//!
//! Works on whole poses, not on positions alone, so that a straight drive (collinear centres) is no special case.

use glam::{DQuat, DVec3};

use crate::pose::{Rigid, Similarity};
use crate::splat::Splats;
use crate::splat::sh_rotation::ShRotation;

/// Camera centres closer together than this share of their distance to the scene say nothing about scale.
const MIN_SPREAD: f64 = 1e-6;

/// `target_from_source` from pairs (target_from_cam, source_from_cam) of the same cameras; `None` without pairs.
/// Rotation is the mean relative rotation, scale the ratio of the spreads of the centres (1 for a single place).
pub fn align(pairs: &[(Rigid, Rigid)]) -> Option<Similarity> {
    if pairs.is_empty() {
        return None;
    }
    let rotation = mean_rotation(
        pairs
            .iter()
            .map(|(target, source)| target.rotation * source.rotation.conjugate()),
    );
    let n = pairs.len() as f64;
    let target_mean = pairs
        .iter()
        .map(|(target, _)| target.translation)
        .sum::<DVec3>()
        / n;
    let source_mean = pairs
        .iter()
        .map(|(_, source)| source.translation)
        .sum::<DVec3>()
        / n;
    let spread = |points: &mut dyn Iterator<Item = DVec3>| {
        points.map(|d| d.length_squared()).sum::<f64>().sqrt()
    };
    let target_spread = spread(
        &mut pairs
            .iter()
            .map(|(target, _)| target.translation - target_mean),
    );
    let source_spread = spread(
        &mut pairs
            .iter()
            .map(|(_, source)| source.translation - source_mean),
    );
    let scale = if source_spread > MIN_SPREAD && target_spread > MIN_SPREAD {
        target_spread / source_spread
    } else {
        1.0
    };
    let translation = target_mean - rotation * source_mean * scale;
    Some(Similarity {
        scale,
        rotation,
        translation,
    })
}

/// Mean of rotations that lie close together: the sum of the quaternions of one hemisphere (Markley 2007 for small spread).
fn mean_rotation(rotations: impl Iterator<Item = DQuat>) -> DQuat {
    let mut first = None;
    let mut sum = glam::DVec4::ZERO;
    for rotation in rotations {
        let first = *first.get_or_insert(rotation);
        let sign = if rotation.dot(first) < 0.0 { -1.0 } else { 1.0 };
        sum += glam::DVec4::from(rotation) * sign;
    }
    let sum = DQuat::from_vec4(sum);
    if sum.length_squared() > 1e-12 {
        sum.normalize()
    } else {
        first.unwrap_or(DQuat::IDENTITY)
    }
}

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
    pub fn carry(&self, splats: &mut Splats, i: usize) {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(i: f64) -> Rigid {
        Rigid::exp(
            DVec3::new(i, 0.3 * i * i, -0.2 * i),
            DVec3::new(0.1 * i, -0.05, 0.2),
        )
    }

    #[test]
    fn a_similarity_is_found_again() {
        let truth = Similarity {
            scale: 2.5,
            rotation: DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 0.7)),
            translation: DVec3::new(1.0, -2.0, 3.0),
        };
        let pairs: Vec<_> = (0..5)
            .map(|i| pose(f64::from(i)))
            .map(|p| (truth.transform_pose(&p), p))
            .collect();
        let found = align(&pairs).unwrap();
        assert!((found.scale - truth.scale).abs() < 1e-12);
        assert!(found.rotation.angle_between(truth.rotation) < 1e-7);
        assert!((found.translation - truth.translation).length() < 1e-10);
    }

    #[test]
    fn a_straight_drive_and_a_single_pose_are_no_special_cases() {
        let truth = Similarity {
            scale: 3.0,
            ..Similarity::IDENTITY
        };
        let line: Vec<_> = (0..4)
            .map(|i| Rigid::new(DQuat::IDENTITY, DVec3::Z * f64::from(i)))
            .collect();
        let pairs: Vec<_> = line.iter().map(|p| (truth.transform_pose(p), *p)).collect();
        assert!((align(&pairs).unwrap().scale - 3.0).abs() < 1e-12);
        assert_eq!(align(&pairs[..1]).unwrap().scale, 1.0);
        assert!(align(&[]).is_none());
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
        Carry::new(motion, 1).carry(&mut splats, 0);
        let back = new
            .inverse()
            .transform_point(DVec3::from(splats.means[0].map(f64::from)));
        assert!((back - in_cam * 1.5).length() < 1e-5, "{back}");
        assert!((splats.log_scales[0][2] - 1.5f32.ln()).abs() < 1e-6);
        assert!((f64::from(splats.quats[0][0]) - motion.rotation.w.abs()).abs() < 1e-6);
        assert_eq!(splats.sh[..3], [0.5; 3]);
    }
}
