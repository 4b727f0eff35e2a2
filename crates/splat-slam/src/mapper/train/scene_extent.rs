//! How large the scene is by its cameras: what rates and the near plane can be shares of.

use glam::DVec3;

use crate::mapper::parts::Parts;
use splat_engine::error::EngineError;

/// Radius of the scene as a multiple of the largest distance of a camera from their mean, as the authors have it.
const RADIUS_OF_CAMERAS: f64 = 1.1;

/// Of the cameras that are trained on, in world units.
pub(crate) fn scene_radius(map: &mut Parts<'_>) -> Result<f32, EngineError> {
    let poses = map.engine.poses()?;
    let trained = map.keyframes.registered().values();
    let centres: Vec<DVec3> = trained
        .filter(|registered| !registered.is_held_out)
        .map(|registered| poses[registered.view_ix].inverse().translation)
        .collect();
    let radius = radius_of(&centres) as f32;
    // One camera, or several in one place: the depth of what they show is the only length.
    let has_motion = radius > f32::EPSILON * map.keyframes.scene_depth();
    Ok(if has_motion {
        radius
    } else {
        map.keyframes.scene_depth()
    })
}

fn radius_of(centres: &[DVec3]) -> f64 {
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let away = centres.iter().map(|centre| centre.distance(mean));
    RADIUS_OF_CAMERAS * away.fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scene_is_a_little_larger_than_the_ring_of_its_cameras() {
        let ring = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y].map(|p| 2.0 * p + DVec3::Z);
        assert!((radius_of(&ring) - 2.2).abs() < 1e-12);
        assert_eq!(radius_of(&[]), 0.0);
    }
}
