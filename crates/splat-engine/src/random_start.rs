//! Cameras alone -> the size of the scene, and splats to begin with where no points are known.

use glam::{DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::view::TrainingView;
use splat_types::splats::splats::Splats;

/// Depths of the first splats, in extents of the cameras.
const DEPTHS: std::ops::Range<f64> = 0.3..3.0;
/// Size of the first splats, in extents of the cameras, and the logit of their opacity (0.12).
const SIZE: f64 = 0.03;
const OPACITY_LOGIT: f32 = -2.0;

/// Largest distance of a camera from the middle of all, in world units: the length that learning rates of means scale with
/// in 3DGS. 0 for one camera or none.
pub fn camera_extent(views: &[TrainingView]) -> f64 {
    let centre = |view: &TrainingView| view.cam_from_world.inverse().translation;
    let middle = views.iter().map(centre).sum::<DVec3>() / views.len().max(1) as f64;
    let distances = views.iter().map(|view| centre(view).distance(middle));
    distances.fold(0.0, f64::max)
}

/// Grey splats on rays through random pixels of the views, at random depths of the order of the cameras' extent, with one SH
/// coefficient each. Equal views and seeds give equal splats; none without views.
pub fn random_splats(views: &[TrainingView], n: usize, seed: u64) -> Splats {
    let n = if views.is_empty() { 0 } else { n };
    let extent = camera_extent(views);
    let mut rng = Pcg32::seed_from_u64(seed);
    let mut point = || {
        let view = &views[rng.random_range(0..views.len())];
        let size = DVec2::new(view.image.width_px.into(), view.image.height_px.into());
        let pixel = size * DVec2::new(rng.random(), rng.random());
        let in_cam = view.intrinsics.ray_in_cam(pixel) * rng.random_range(DEPTHS) * extent;
        let in_world = view.cam_from_world.inverse().transform_point(in_cam);
        in_world.as_vec3().to_array()
    };
    Splats {
        means: (0..n).map(|_| point()).collect(),
        log_scales: vec![[(SIZE * extent).ln() as f32; 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![OPACITY_LOGIT; n],
        sh: vec![0.0; 3 * n],
        sh_degree: 0,
        anchors: vec![0; n],
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DQuat;

    use super::*;
    use splat_types::camera::Intrinsics;
    use splat_types::image::RgbImage;
    use splat_types::transform::Rigid;

    fn view(centre: DVec3) -> TrainingView {
        let (width_px, height_px) = (32, 24);
        TrainingView {
            image: Arc::new(RgbImage {
                width_px,
                height_px,
                pixels: vec![0; 3 * 32 * 24],
            }),
            intrinsics: Intrinsics {
                width_px,
                height_px,
                fx: 30.0,
                fy: 30.0,
                cx: 16.0,
                cy: 12.0,
            },
            cam_from_world: Rigid::new(DQuat::IDENTITY, centre).inverse(),
            depth: None,
            mask: None,
        }
    }

    #[test]
    fn splats_lie_in_view_of_a_camera_at_depths_of_the_cameras_extent() {
        let views = [view(DVec3::ZERO), view(DVec3::new(4.0, 0.0, 0.0))];
        assert!((camera_extent(&views) - 2.0).abs() < 1e-12);
        let splats = random_splats(&views, 200, 3);
        assert_eq!(splats.len(), 200);
        for mean in &splats.means {
            let is_shown = |view: &TrainingView| {
                let in_world = DVec3::from(mean.map(f64::from));
                let in_cam = view.cam_from_world.transform_point(in_world);
                let pixel = view.intrinsics.project(in_cam);
                (0.59..6.01).contains(&in_cam.z) && pixel.is_some_and(|p| p.x > -0.1 && p.x < 32.1)
            };
            assert!(views.iter().any(is_shown), "{mean:?}");
        }
        assert_eq!(random_splats(&views, 200, 3).means, splats.means);
        assert!(random_splats(&[], 200, 3).is_empty());
    }
}
