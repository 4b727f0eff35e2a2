//! Rays from known cameras -> the point where they meet, and how well they meet.

use glam::{DMat3, DVec2, DVec3};

use crate::camera::Intrinsics;
use crate::pose::Rigid;

/// One camera's sight of a point.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    pub cam_from_map: &'a Rigid,
    pub intrinsics: &'a Intrinsics,
    pub pixel: DVec2,
}

impl Sight<'_> {
    pub fn centre_in_map(&self) -> DVec3 {
        self.cam_from_map.inverse().translation
    }

    /// Unit length.
    pub fn ray_in_map(&self) -> DVec3 {
        self.cam_from_map.rotation.conjugate() * self.intrinsics.ray_in_cam(self.pixel).normalize()
    }

    /// Distance in pixels between the point's image and the sight; infinite behind the camera.
    pub fn error_px(&self, point_in_map: DVec3) -> f64 {
        let image = self
            .intrinsics
            .project(self.cam_from_map.transform_point(point_in_map));
        image.map_or(f64::INFINITY, |pixel| pixel.distance(self.pixel))
    }
}

/// The point nearest to all rays, then two Gauss-Newton steps on the reprojection error. `None` for parallel rays.
pub fn triangulate(sights: &[Sight<'_>]) -> Option<DVec3> {
    let mut matrix = DMat3::ZERO;
    let mut vector = DVec3::ZERO;
    for sight in sights {
        let (centre, ray) = (sight.centre_in_map(), sight.ray_in_map());
        let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
        matrix += across;
        vector += across * centre;
    }
    // The smallest eigenvalue of the sum is about n/2 times the squared angle between the rays.
    if sights.len() < 2 || matrix.determinant() < 1e-9 {
        return None;
    }
    let mut point = matrix.inverse() * vector;
    for _ in 0..2 {
        point = polished(sights, point)?;
    }
    point.is_finite().then_some(point)
}

/// Largest angle in radians between any two rays to the point.
pub fn widest_angle(centres: &[DVec3], point: DVec3) -> f64 {
    let rays: Vec<DVec3> = centres
        .iter()
        .map(|c| (point - *c).normalize_or_zero())
        .collect();
    let pairs = rays
        .iter()
        .enumerate()
        .flat_map(|(i, a)| rays[i + 1..].iter().map(move |b| (a, b)));
    pairs
        .map(|(a, b)| a.cross(*b).length().atan2(a.dot(*b)))
        .fold(0.0, f64::max)
}

fn polished(sights: &[Sight<'_>], point: DVec3) -> Option<DVec3> {
    let mut hessian = DMat3::ZERO;
    let mut gradient = DVec3::ZERO;
    for sight in sights {
        let p = sight.cam_from_map.transform_point(point);
        let image = sight.intrinsics.project(p)?;
        let residual = image - sight.pixel;
        let rotation = sight.cam_from_map.rotation_matrix();
        let (fx, fy) = (sight.intrinsics.fx / p.z, sight.intrinsics.fy / p.z);
        let rows = [
            DVec3::new(fx, 0.0, -fx * p.x / p.z),
            DVec3::new(0.0, fy, -fy * p.y / p.z),
        ];
        for (row, r) in rows.into_iter().zip([residual.x, residual.y]) {
            let j = rotation.transpose() * row;
            hessian += DMat3::from_cols(j * j.x, j * j.y, j * j.z);
            gradient += j * r;
        }
    }
    let damped = hessian
        + DMat3::IDENTITY * (1e-9 * (hessian.x_axis.x + hessian.y_axis.y + hessian.z_axis.z));
    (damped.determinant().abs() > 0.0).then(|| point - damped.inverse() * gradient)
}
