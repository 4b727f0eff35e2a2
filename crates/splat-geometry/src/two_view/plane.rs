//! Matches of points on one plane -> the two motions that explain them equally well.
//!
//! A homography is `R + t n^T / d`: decomposed as in Ma, Soatto, Kosecka, Sastry, "An Invitation to 3-D Vision" (2004),
//! section 5.3.3. Of the four solutions the plane lies in front of the camera for two; which of them is true, only a
//! third view shows, or points off the plane.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use splat_types::transform::Rigid;

/// Squared singular values that differ less belong to a camera that only turned.
const MIN_STRETCH: f64 = 1e-6;

/// Motions second from first, of unit translation, by a homography between rays `(x, y, 1)` (second ~ H first) and some rays of
/// the first camera to points on the plane. None where the camera only turned.
pub fn motions_by_plane(homography: &DMat3, rays_in_first: &[DVec3]) -> Vec<Rigid> {
    let raw = Matrix3::from_column_slice(&homography.to_cols_array());
    let mut singular = raw.singular_values();
    singular.as_mut_slice().sort_by(f64::total_cmp);
    if singular[1].is_nan() || singular[1] <= 0.0 {
        return Vec::new();
    }
    // The middle singular value of R + t n^T / d is 1, and no point passes the plane, so that its determinant is positive.
    let scale = homography.determinant().signum() / singular[1];
    let h = *homography * scale;
    let square = h.transpose() * h;
    let eigen = Matrix3::from_column_slice(&square.to_cols_array()).symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let vector = |i: usize| {
        let v = eigen.eigenvectors.column(order[i]);
        DVec3::new(v[0], v[1], v[2])
    };
    let (long, short) = (eigen.eigenvalues[order[0]], eigen.eigenvalues[order[2]]);
    let stretch = long - short;
    if stretch.is_nan() || stretch < MIN_STRETCH {
        return Vec::new();
    }
    let (along, across) = (
        vector(0) * (1.0 - short).max(0.0).sqrt(),
        vector(2) * (long - 1.0).max(0.0).sqrt(),
    );
    // Both directions within the plane keep their length: the middle one, and this.
    let kept = [along + across, along - across].map(|v| v / stretch.sqrt());
    let solution = |kept: DVec3| {
        let (middle, normal) = (vector(1), vector(1).cross(kept));
        let before = DMat3::from_cols(middle, kept, normal);
        let (moved, moved_kept) = (h * middle, h * kept);
        let after = DMat3::from_cols(moved, moved_kept, moved.cross(moved_kept));
        let rotation = after * before.transpose();
        let n_in_front: usize = rays_in_first
            .iter()
            .filter(|r| normal.dot(**r) > 0.0)
            .count();
        let side = if 2 * n_in_front >= rays_in_first.len() {
            1.0
        } else {
            -1.0
        };
        let shift = (h - rotation) * (normal * side);
        let rotation = DQuat::from_mat3(&rotation).normalize();
        let pose = Rigid::new(rotation, shift.try_normalize()?);
        pose.is_finite().then_some(pose)
    };
    kept.into_iter().filter_map(solution).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_plane(pose: &Rigid, normal: DVec3, distance: f64) -> DMat3 {
        let t = pose.translation / distance;
        let outer = DMat3::from_cols(t * normal.x, t * normal.y, t * normal.z);
        DMat3::from_quat(pose.rotation) + outer
    }

    fn rays() -> Vec<DVec3> {
        let at = |i: i32| 0.2 * f64::from(i);
        let row = |y: i32| (-2..3).map(move |x| DVec3::new(at(x), at(y), 1.0));
        (-2..3).flat_map(row).collect()
    }

    #[test]
    fn the_true_motion_is_one_of_two() {
        let pose = Rigid::exp(DVec3::new(0.4, 0.1, 0.25), DVec3::new(0.05, -0.1, 0.02));
        let normal = DVec3::new(0.6, -0.1, 0.8).normalize();
        for scale in [1.0, -3.0, 0.2] {
            let homography = of_plane(&pose, normal, 1.5) * scale;
            let found = motions_by_plane(&homography, &rays());
            assert_eq!(found.len(), 2);
            let along = pose.translation.normalize();
            let is_true =
                |m: &&Rigid| m.angle_to(&pose) < 1e-6 && m.translation.dot(along) > 1.0 - 1e-9;
            assert_eq!(found.iter().filter(is_true).count(), 1, "{found:?}");
        }
    }

    #[test]
    fn both_motions_map_the_plane_alike() {
        let pose = Rigid::exp(DVec3::new(0.4, 0.1, 0.25), DVec3::new(0.05, -0.1, 0.02));
        let homography = of_plane(&pose, DVec3::new(0.6, -0.1, 0.8).normalize(), 1.5);
        let found = motions_by_plane(&homography, &rays());
        for motion in &found {
            for ray in rays() {
                // The epipolar constraint holds for all points of the plane.
                let (first, second) = (motion.rotation * ray, homography * ray);
                assert!(motion.translation.cross(first).dot(second).abs() < 1e-9);
            }
        }
        assert!(found[0].angle_to(&found[1]) > 0.01);
    }

    #[test]
    fn a_turn_and_a_broken_matrix_give_none() {
        let turn = DMat3::from_quat(DQuat::from_rotation_y(0.2));
        assert!(motions_by_plane(&turn, &rays()).is_empty());
        assert!(motions_by_plane(&DMat3::ZERO, &rays()).is_empty());
        assert!(motions_by_plane(&DMat3::from_diagonal(DVec3::NAN), &rays()).is_empty());
    }
}
