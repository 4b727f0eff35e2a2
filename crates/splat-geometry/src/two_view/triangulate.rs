//! Rays from known cameras -> the point where they meet, and how well they meet.

use glam::{DMat3, DVec2, DVec3};

use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// One camera's observation of a point.
#[derive(Debug, Clone, Copy)]
pub struct Observation<'a> {
    pub cam_from_world: &'a Rigid,
    pub intrinsics: &'a Intrinsics,
    pub pixel: DVec2,
}

impl Observation<'_> {
    pub fn centre_in_world(&self) -> DVec3 {
        self.cam_from_world.inverse().translation
    }

    /// Unit length.
    pub fn ray_in_world(&self) -> DVec3 {
        self.cam_from_world.rotation.conjugate()
            * self.intrinsics.ray_in_cam(self.pixel).normalize()
    }

    /// Distance in pixels between the point's image and the observation; infinite behind the camera.
    pub fn error_px(&self, point_in_world: DVec3) -> f64 {
        let image = self
            .intrinsics
            .project(self.cam_from_world.transform_point(point_in_world));
        image.map_or(f64::INFINITY, |pixel| pixel.distance(self.pixel))
    }
}

/// The point nearest to all rays, then two Gauss-Newton steps on the reprojection error. `None` for parallel rays.
pub fn triangulate(observations: &[Observation<'_>]) -> Option<DVec3> {
    let mut matrix = DMat3::ZERO;
    let mut vector = DVec3::ZERO;
    for observation in observations {
        let (centre, ray) = (observation.centre_in_world(), observation.ray_in_world());
        let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
        matrix += across;
        vector += across * centre;
    }
    // The smallest eigenvalue of the sum is about n/2 times the squared angle between the rays.
    if observations.len() < 2 || matrix.determinant() < 1e-9 {
        return None;
    }
    let mut point = matrix.inverse() * vector;
    for _ in 0..2 {
        point = polished(observations, point)?;
    }
    point.is_finite().then_some(point)
}

/// Largest angle in radians between any two rays to the point.
pub fn widest_angle(centres: &[DVec3], point: DVec3) -> f64 {
    let rays: Vec<DVec3> = rays(centres.iter().copied(), point).collect();
    let mut widest: Option<(f64, DVec3, DVec3)> = None;
    for (i, a) in rays.iter().enumerate() {
        for b in &rays[i + 1..] {
            // Between unit vectors the distance grows with the angle, and takes no arctangent.
            let distance = a.distance_squared(*b);
            if widest.is_none_or(|(most, ..)| distance > most) {
                widest = Some((distance, *a, *b));
            }
        }
    }
    widest.map_or(0.0, |(_, a, b)| a.cross(b).length().atan2(a.dot(b)))
}

/// Whether two of the rays to the point are `min_angle` radians apart or more; looks at no more of them than that takes.
pub fn has_angle(centres: impl Iterator<Item = DVec3>, point: DVec3, min_angle: f64) -> bool {
    let least = (2.0 * (0.5 * min_angle).sin()).powi(2);
    let mut seen: Vec<DVec3> = Vec::new();
    for ray in rays(centres, point) {
        if seen
            .iter()
            .any(|other| ray.distance_squared(*other) >= least)
        {
            return true;
        }
        seen.push(ray);
    }
    false
}

/// Unit vectors from the centres to the point; none from a centre that is the point.
fn rays(centres: impl Iterator<Item = DVec3>, point: DVec3) -> impl Iterator<Item = DVec3> {
    centres.filter_map(move |centre| (point - centre).try_normalize())
}

fn polished(observations: &[Observation<'_>], point: DVec3) -> Option<DVec3> {
    let mut hessian = DMat3::ZERO;
    let mut gradient = DVec3::ZERO;
    for observation in observations {
        let p = observation.cam_from_world.transform_point(point);
        let image = observation.intrinsics.project(p)?;
        let residual = image - observation.pixel;
        let rotation = observation.cam_from_world.rotation_matrix();
        let (fx, fy) = (
            observation.intrinsics.fx / p.z,
            observation.intrinsics.fy / p.z,
        );
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
