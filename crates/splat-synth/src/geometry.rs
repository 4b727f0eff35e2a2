//! Solids that a scene is made of, and where a ray meets them: (ray, solid) -> distance and face.
//!
//! Every solid lives in its own local frame; faces carry coordinates in metres for textures and light grids.
//! Knows nothing of colours.

use std::f64::consts::PI;

use glam::{DMat3, DVec2, DVec3};

/// Hits nearer than this are the surface that the ray left.
pub(crate) const MIN_DISTANCE: f64 = 1e-4;

#[derive(Debug, Clone, Copy)]
pub(crate) enum Shape {
    Block {
        half: DVec3,
    },
    /// A cone cut off at both ends, closed, its axis along z.
    Tube {
        half_height: f64,
        bottom: f64,
        top: f64,
    },
    Ball {
        radii: DVec3,
    },
    /// A flat piece in the xy plane that looks along +z; `round` cuts it to an ellipse. Seen from both sides.
    Sheet {
        half: DVec2,
        round: bool,
    },
}

/// Where a solid stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlacedShape {
    pub(crate) shape: Shape,
    pub(crate) centre: DVec3,
    pub(crate) world_from_local: DMat3,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) origin: DVec3,
    pub(crate) direction: DVec3,
}

/// A point on a face: metres from its centre, and half its size in the same measure.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FacePoint {
    pub(crate) uv: DVec2,
    pub(crate) half: DVec2,
    pub(crate) normal: DVec3,
}

impl PlacedShape {
    /// Nearest distance in `(MIN_DISTANCE, farthest)` along the ray and the face met there.
    pub(crate) fn meet(&self, ray: &Ray, farthest: f64) -> Option<(f64, u8)> {
        let local_from_world = self.world_from_local.transpose();
        let origin = local_from_world * (ray.origin - self.centre);
        let direction = local_from_world * ray.direction;
        let met = match self.shape {
            Shape::Block { half } => meet_block(origin, direction, half),
            Shape::Tube {
                half_height,
                bottom,
                top,
            } => meet_tube(origin, direction, [half_height, bottom, top]),
            Shape::Ball { radii } => meet_ball(origin, direction, radii),
            Shape::Sheet { half, round } => meet_sheet(origin, direction, half, round),
        };
        met.filter(|(distance, _)| *distance < farthest)
    }

    /// What textures need to know of a point on this solid.
    pub(crate) fn face_point(&self, point: DVec3, face: u8) -> FacePoint {
        let local = self.world_from_local.transpose() * (point - self.centre);
        let (uv, half, normal) = match self.shape {
            Shape::Block { half } => block_face(local, half, face),
            Shape::Tube {
                half_height,
                bottom,
                top,
            } => tube_face(local, [half_height, bottom, top], face),
            Shape::Ball { radii } => {
                let radius = radii.max_element();
                let unit = local / radii;
                let uv = DVec2::new(unit.y.atan2(unit.x), unit.z.clamp(-1.0, 1.0).asin()) * radius;
                (
                    uv,
                    DVec2::new(PI, PI / 2.0) * radius,
                    (unit / radii).normalize(),
                )
            }
            Shape::Sheet { half, .. } => (local.truncate(), half, DVec3::Z),
        };
        FacePoint {
            uv,
            half,
            normal: self.world_from_local * normal,
        }
    }

    pub(crate) fn n_faces(&self) -> u8 {
        match self.shape {
            Shape::Block { .. } => 6,
            Shape::Tube { .. } => 3,
            Shape::Ball { .. } | Shape::Sheet { .. } => 1,
        }
    }

    /// Half the size of a face in metres; `scaled` in [-1, 1] times it is the `uv` of `face_point`.
    pub(crate) fn face_half(&self, face: u8) -> DVec2 {
        match self.shape {
            Shape::Block { half } => block_face(DVec3::ZERO, half, face).1,
            Shape::Tube {
                half_height,
                bottom,
                top,
            } => tube_face(DVec3::X, [half_height, bottom, top], face).1,
            Shape::Ball { radii } => DVec2::new(PI, PI / 2.0) * radii.max_element(),
            Shape::Sheet { half, .. } => half,
        }
    }

    /// Point in the world and outward normal at `scaled` in [-1, 1]^2 of a face: the inverse of `face_point`.
    pub(crate) fn point_on_face(&self, face: u8, scaled: DVec2) -> (DVec3, DVec3) {
        let local = match self.shape {
            Shape::Block { half } => {
                let uv = scaled * block_face(DVec3::ZERO, half, face).1;
                match face {
                    0 => DVec3::new(half.x, uv.x, uv.y),
                    1 => DVec3::new(-half.x, -uv.x, uv.y),
                    2 => DVec3::new(-uv.x, half.y, uv.y),
                    3 => DVec3::new(uv.x, -half.y, uv.y),
                    4 => DVec3::new(uv.x, uv.y, half.z),
                    _ => DVec3::new(uv.x, -uv.y, -half.z),
                }
            }
            Shape::Tube {
                half_height,
                bottom,
                top,
            } => match face {
                0 => {
                    let (sin, cos) = (scaled.x * PI).sin_cos();
                    let radius = 0.5 * (bottom + top) + 0.5 * (top - bottom) * scaled.y;
                    DVec3::new(cos * radius, sin * radius, scaled.y * half_height)
                }
                1 => (scaled * top * 0.7).extend(half_height),
                _ => (scaled * bottom * 0.7).extend(-half_height),
            },
            Shape::Ball { radii } => {
                let (sin, cos) = (scaled.x * PI).sin_cos();
                let (up, out) = (scaled.y * PI / 2.0).sin_cos();
                radii * DVec3::new(cos * out, sin * out, up)
            }
            Shape::Sheet { half, .. } => (scaled * half).extend(0.0),
        };
        let point = self.world_from_local * local + self.centre;
        (point, self.face_point(point, face).normal)
    }

    /// Corners of the box around the solid in the world.
    pub(crate) fn bounds(&self) -> (DVec3, DVec3) {
        let half = match self.shape {
            Shape::Block { half } => half,
            Shape::Tube {
                half_height,
                bottom,
                top,
            } => DVec3::new(bottom.max(top), bottom.max(top), half_height),
            Shape::Ball { radii } => radii,
            Shape::Sheet { half, .. } => half.extend(0.0),
        };
        let m = self.world_from_local;
        let reach = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
        // A box without thickness is missed by rays that run inside it.
        let reach = reach + DVec3::splat(1e-6);
        (self.centre - reach, self.centre + reach)
    }
}

fn meet_block(origin: DVec3, direction: DVec3, half: DVec3) -> Option<(f64, u8)> {
    let inverse = direction.recip();
    let (a, b) = ((-half - origin) * inverse, (half - origin) * inverse);
    let (near, far) = (a.min(b), a.max(b));
    let (enter, exit) = (near.max_element(), far.min_element());
    if exit < enter || exit <= MIN_DISTANCE {
        return None;
    }
    // From inside the ray meets the far side, so that points within a block count as covered.
    let inside = enter <= MIN_DISTANCE;
    let (distance, per_axis) = if inside { (exit, far) } else { (enter, near) };
    let axis = if per_axis.x == distance {
        0
    } else if per_axis.y == distance {
        1
    } else {
        2
    };
    let positive = (direction[axis] > 0.0) == inside;
    Some((distance, axis as u8 * 2 + u8::from(!positive)))
}

fn meet_tube(
    origin: DVec3,
    direction: DVec3,
    [half_height, bottom, top]: [f64; 3],
) -> Option<(f64, u8)> {
    let middle = 0.5 * (bottom + top);
    let slope = (top - bottom) / (2.0 * half_height);
    let radius = middle + slope * origin.z;
    let grow = slope * direction.z;
    let a = direction.x * direction.x + direction.y * direction.y - grow * grow;
    let b = origin.x * direction.x + origin.y * direction.y - radius * grow;
    let c = origin.x * origin.x + origin.y * origin.y - radius * radius;
    let mut nearest: Option<(f64, u8)> = None;
    let mut offer = |distance: f64, face: u8| {
        if distance > MIN_DISTANCE && nearest.is_none_or(|(best, _)| distance < best) {
            nearest = Some((distance, face));
        }
    };
    let discriminant = b * b - a * c;
    if discriminant >= 0.0 && a.abs() > 1e-12 {
        let root = discriminant.sqrt();
        for distance in [(-b - root) / a, (-b + root) / a] {
            let z = origin.z + distance * direction.z;
            if z.abs() <= half_height {
                offer(distance, 0);
            }
        }
    }
    if direction.z.abs() > 1e-12 {
        for (z, radius, face) in [(half_height, top, 1), (-half_height, bottom, 2)] {
            let distance = (z - origin.z) / direction.z;
            let at = origin + direction * distance;
            if at.x * at.x + at.y * at.y <= radius * radius {
                offer(distance, face);
            }
        }
    }
    nearest
}

fn meet_ball(origin: DVec3, direction: DVec3, radii: DVec3) -> Option<(f64, u8)> {
    let (origin, direction) = (origin / radii, direction / radii);
    let a = direction.length_squared();
    let b = origin.dot(direction);
    let discriminant = b * b - a * (origin.length_squared() - 1.0);
    if discriminant < 0.0 {
        return None;
    }
    let root = discriminant.sqrt();
    let [near, far] = [(-b - root) / a, (-b + root) / a];
    let distance = if near > MIN_DISTANCE { near } else { far };
    (distance > MIN_DISTANCE).then_some((distance, 0))
}

fn meet_sheet(origin: DVec3, direction: DVec3, half: DVec2, round: bool) -> Option<(f64, u8)> {
    let distance = -origin.z / direction.z;
    if !distance.is_finite() || distance <= MIN_DISTANCE {
        return None;
    }
    let scaled = (origin + direction * distance).truncate() / half;
    let inside = if round {
        scaled.length_squared() <= 1.0
    } else {
        scaled.abs().max_element() <= 1.0
    };
    inside.then_some((distance, 0))
}

/// (uv, half, normal); u runs to the right and v up for someone who looks at the face from outside.
fn block_face(local: DVec3, half: DVec3, face: u8) -> (DVec2, DVec2, DVec3) {
    match face {
        0 => (
            DVec2::new(local.y, local.z),
            DVec2::new(half.y, half.z),
            DVec3::X,
        ),
        1 => (
            DVec2::new(-local.y, local.z),
            DVec2::new(half.y, half.z),
            DVec3::NEG_X,
        ),
        2 => (
            DVec2::new(-local.x, local.z),
            DVec2::new(half.x, half.z),
            DVec3::Y,
        ),
        3 => (
            DVec2::new(local.x, local.z),
            DVec2::new(half.x, half.z),
            DVec3::NEG_Y,
        ),
        4 => (
            DVec2::new(local.x, local.y),
            DVec2::new(half.x, half.y),
            DVec3::Z,
        ),
        _ => (
            DVec2::new(local.x, -local.y),
            DVec2::new(half.x, half.y),
            DVec3::NEG_Z,
        ),
    }
}

/// Faces: 0 side, 1 top, 2 bottom.
fn tube_face(
    local: DVec3,
    [half_height, bottom, top]: [f64; 3],
    face: u8,
) -> (DVec2, DVec2, DVec3) {
    match face {
        0 => {
            let radius = bottom.max(top);
            let uv = DVec2::new(local.y.atan2(local.x) * radius, local.z);
            let slope = (top - bottom) / (2.0 * half_height);
            let out = local.truncate().normalize_or_zero();
            (
                uv,
                DVec2::new(PI * radius, half_height),
                out.extend(-slope).normalize(),
            )
        }
        1 => (
            local.truncate(),
            DVec2::splat(top.max(1e-6) * 0.7),
            DVec3::Z,
        ),
        _ => (
            local.truncate(),
            DVec2::splat(bottom.max(1e-6) * 0.7),
            DVec3::NEG_Z,
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_round_trip(shape: Shape) {
        let placed = PlacedShape {
            shape,
            centre: DVec3::new(0.3, -2.0, 1.1),
            world_from_local: DMat3::from_rotation_z(0.7) * DMat3::from_rotation_x(-0.4),
        };
        for face in 0..placed.n_faces() {
            for scaled in [DVec2::new(0.3, -0.6), DVec2::new(-0.45, 0.2)] {
                let (point, normal) = placed.point_on_face(face, scaled);
                let found = placed.face_point(point, face);
                assert!(
                    (found.uv / found.half - scaled).length() < 1e-9,
                    "{shape:?} face {face}: {found:?}"
                );
                let ray = Ray {
                    origin: point + normal * 0.5,
                    direction: -normal,
                };
                let (distance, met) = placed.meet(&ray, 1e9).unwrap();
                assert!(
                    (distance - 0.5).abs() < 1e-9,
                    "{shape:?} face {face}: {distance}"
                );
                assert_eq!(met, face);
            }
        }
    }

    #[test]
    fn a_ray_along_the_normal_meets_the_point_it_started_over() {
        check_round_trip(Shape::Block {
            half: DVec3::new(0.5, 0.7, 0.2),
        });
        check_round_trip(Shape::Tube {
            half_height: 0.4,
            bottom: 0.3,
            top: 0.2,
        });
        check_round_trip(Shape::Ball {
            radii: DVec3::splat(0.6),
        });
        check_round_trip(Shape::Sheet {
            half: DVec2::new(0.8, 0.5),
            round: true,
        });
    }

    #[test]
    fn a_ray_from_inside_a_block_meets_its_far_side() {
        let met = meet_block(DVec3::ZERO, DVec3::X, DVec3::splat(2.0));
        assert_eq!(met, Some((2.0, 0)));
    }
}
