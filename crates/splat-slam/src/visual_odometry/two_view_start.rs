//! A first image and one that was taken beside it -> the motion between them and the points that both show.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use splat_geometry::stats::median;
use splat_geometry::two_view::epipolar::{self, homography_share};
use splat_geometry::two_view::triangulate::{Observation, triangulate, widest_angle};
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// Motion of the corners, as a share of the longer side, below which no motion of the camera is looked for.
const MIN_FLOW: f64 = 0.012;
/// Error of a corner, as a share of the longer side: a pixel of 640.
const MAX_ERROR: f64 = 1.0 / 640.0;
/// Corners that must be seen in both images, and agree on a motion.
const MIN_SHARED: usize = 40;
const MIN_SHARE: f64 = 0.7;
/// Median angle between the rays of the points.
const MIN_PARALLAX_DEG: f64 = 1.2;
/// Share of the corners that one plane explains, above which two motions explain them nearly as well (Longuet-Higgins 1986).
const MAX_PLANE_SHARE: f64 = 0.9;
/// Of a single point.
const MIN_ANGLE_RAD: f64 = 0.01;

/// The start of a segment; the first image's camera is its frame, and the median depth there is 1.
#[derive(Debug, Clone)]
pub(crate) struct TwoViewStart {
    pub(crate) second_from_first: Rigid,
    /// By the corner's number.
    pub(crate) points: BTreeMap<u32, DVec3>,
}

/// Why there is no start yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NoStart {
    /// Too few corners of the first image are left: another one should take its place.
    Lost,
    /// The camera has not moved, has only turned, has not moved far enough, or sees one plane alone.
    NoParallax,
}

/// `seen` are corners of both images: (number, pixel in the first, pixel in the second), of a pinhole.
pub(crate) fn start(
    seen: &[(u32, DVec2, DVec2)],
    camera: &Intrinsics,
    seed: u64,
) -> Result<TwoViewStart, NoStart> {
    if seen.len() < MIN_SHARED {
        return Err(NoStart::Lost);
    }
    let longest = f64::from(camera.width_px.max(camera.height_px));
    let mut flow: Vec<f64> = seen.iter().map(|(_, a, b)| a.distance(*b)).collect();
    if median(&mut flow).is_none_or(|flow| flow < MIN_FLOW * longest) {
        return Err(NoStart::NoParallax);
    }
    let pairs: Vec<(DVec2, DVec2)> = seen.iter().map(|(_, a, b)| (*a, *b)).collect();
    let max_error_px = MAX_ERROR * longest;
    let motion = epipolar::motion(&pairs, [camera; 2], max_error_px, seed);
    let motion = motion.ok_or(NoStart::NoParallax)?;
    let agree = motion.inliers.len();
    if motion.parallax_deg < MIN_PARALLAX_DEG
        || agree < MIN_SHARED
        || (agree as f64) < MIN_SHARE * seen.len() as f64
    {
        return Err(NoStart::NoParallax);
    }
    if homography_share(&pairs, max_error_px, seed) > MAX_PLANE_SHARE {
        return Err(NoStart::NoParallax);
    }
    let poses = [Rigid::IDENTITY, motion.second_from_first];
    let centres = poses.map(|pose| pose.inverse().translation);
    let point = |&ix: &usize| {
        let (id, first, second) = seen[ix];
        let observations = [(&poses[0], first), (&poses[1], second)];
        let observations = observations.map(|(cam_from_world, pixel)| Observation {
            cam_from_world,
            intrinsics: camera,
            pixel,
        });
        let point = triangulate(&observations)?;
        let fits = |o: &Observation<'_>| o.error_px(point) <= 2.0 * max_error_px;
        let is_sure = widest_angle(&centres, point) >= MIN_ANGLE_RAD;
        (is_sure && observations.iter().all(fits)).then_some((id, point))
    };
    let mut points: BTreeMap<u32, DVec3> = motion.inliers.iter().filter_map(point).collect();
    let mut depths: Vec<f64> = points.values().map(|point| point.z).collect();
    let depth = median(&mut depths).ok_or(NoStart::NoParallax)?;
    if points.len() < MIN_SHARED / 2 {
        return Err(NoStart::NoParallax);
    }
    points.values_mut().for_each(|point| *point /= depth);
    let mut second_from_first = motion.second_from_first;
    second_from_first.translation /= depth;
    Ok(TwoViewStart {
        second_from_first,
        points,
    })
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    const CAMERA: Intrinsics = Intrinsics {
        width_px: 640,
        height_px: 480,
        fx: 500.0,
        fy: 500.0,
        cx: 320.0,
        cy: 240.0,
    };

    fn seen(second_from_first: &Rigid, n: usize) -> Vec<(u32, DVec2, DVec2)> {
        seen_between(second_from_first, n, 3.0..8.0)
    }

    /// Points at these depths.
    fn seen_between(
        second_from_first: &Rigid,
        n: usize,
        depths: std::ops::Range<f64>,
    ) -> Vec<(u32, DVec2, DVec2)> {
        let mut rng = Pcg32::seed_from_u64(1);
        let one = |id: u32| {
            let x = DVec3::new(
                rng.random_range(-2.0..2.0),
                rng.random_range(-1.5..1.5),
                rng.random_range(depths.clone()),
            );
            let mut noise = || DVec2::new(rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2));
            let first = CAMERA.project(x)? + noise();
            let second = CAMERA.project(second_from_first.transform_point(x))? + noise();
            Some((id, first, second))
        };
        (0..n as u32).filter_map(one).collect()
    }

    #[test]
    fn a_step_aside_starts_a_segment_with_points_of_median_depth_one() {
        let truth = Rigid::new(DQuat::from_rotation_y(0.05), DVec3::new(-0.4, 0.05, 0.1));
        let found = start(&seen(&truth, 150), &CAMERA, 7).unwrap();
        assert!(found.second_from_first.angle_to(&truth) < 3e-3);
        let (a, b) = (found.second_from_first.translation, truth.translation);
        assert!(a.normalize().dot(b.normalize()) > 0.998);
        let mut depths: Vec<f64> = found.points.values().map(|p| p.z).collect();
        assert!((median(&mut depths).unwrap() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_turn_a_standing_camera_and_a_single_plane_start_nothing() {
        let turn = Rigid::new(DQuat::from_rotation_y(0.08), DVec3::ZERO);
        for truth in [turn, Rigid::IDENTITY] {
            let found = start(&seen(&truth, 150), &CAMERA, 7);
            assert_eq!(found.unwrap_err(), NoStart::NoParallax);
        }
        let aside = Rigid::new(DQuat::from_rotation_y(0.05), DVec3::new(-0.4, 0.05, 0.1));
        let wall = seen_between(&aside, 150, 4.0..4.001);
        let found = start(&wall, &CAMERA, 7);
        assert_eq!(
            found.unwrap_err(),
            NoStart::NoParallax,
            "a plane has two motions"
        );
        let few = seen(&turn, 20);
        assert_eq!(start(&few, &CAMERA, 7).unwrap_err(), NoStart::Lost);
    }
}
