//! Things that are somewhere else in each image: what people leave lying about, or who walks by, between photos (as in the scenes of RobustNeRF).
//!
//! Striped balls between the camera and what it sees, for each image anew. Depth and ground truth know nothing of them, and every tenth image
//! has none: by those a map is measured.

use glam::{DVec2, DVec3, Vec3};

use crate::geometry::Ray;
use crate::noise::{hash, pick};
use crate::scene::Scene;
use splat_types::camera::CameraModel;
use splat_types::transform::Rigid;

/// Of so many images one is without, those that `select.holdout_frames=10` holds out.
const CLEAN_EVERY: u32 = 10;
const CLEAN: u32 = 5;
/// Distance of a ball, as a share of that of the scene behind it.
const DISTANCE: [f64; 2] = [0.45, 0.75];
/// Radius as a share of its distance: some 6 to 14 degrees across.
const RADIUS: [f64; 2] = [0.05, 0.12];
const STRIPES: f64 = 5.0;
const AMBIENT: f32 = 0.3;

#[derive(Debug, Clone, Copy)]
pub(crate) struct Mover {
    centre: DVec3,
    radius: f64,
    colours: [Vec3; 2],
}

/// Whether none is in image `ix`, however many there are in others.
pub(crate) fn is_clean(ix: u32) -> bool {
    ix % CLEAN_EVERY == CLEAN
}

/// Those of image `ix`.
pub(crate) fn movers(
    scene: &Scene,
    lens: &CameraModel,
    (pose, ix): (Rigid, u32),
    (n, seed): (u32, u64),
) -> Vec<Mover> {
    if is_clean(ix) {
        return Vec::new();
    }
    let size = DVec2::new(
        f64::from(lens.intrinsics.width_px),
        f64::from(lens.intrinsics.height_px),
    );
    let one = |k: u32| {
        let random = |what: u32| f64::from(pick(hash(seed as u32 ^ hash(ix)) ^ k, what));
        let between = |what: u32, [low, high]: [f64; 2]| low + (high - low) * random(what);
        let pixel = size * DVec2::new(random(0), random(1));
        let direction = pose.rotation * lens.ray_in_cam(pixel)?.normalize();
        let ray = Ray {
            origin: pose.translation,
            direction,
        };
        let distance = scene.meet(&ray, f64::MAX)?.distance * between(2, DISTANCE);
        let colour = |what: u32| {
            let channel = |c: u32| 0.05 + 0.85 * random(what + c) as f32;
            Vec3::new(channel(0), channel(1), channel(2))
        };
        Some(Mover {
            centre: pose.translation + direction * distance,
            radius: distance * between(3, RADIUS),
            colours: [colour(4), colour(7)],
        })
    };
    (0..n).filter_map(one).collect()
}

/// Distance along the ray, whose direction has length 1, and light of the nearest one.
pub(crate) fn meet<'a>(movers: &'a [Mover], ray: &Ray) -> Option<(f64, Vec3)> {
    let one = |mover: &'a Mover| {
        let to_centre = mover.centre - ray.origin;
        let along = to_centre.dot(ray.direction);
        let squared = mover.radius * mover.radius - (to_centre.length_squared() - along * along);
        let distance = along - squared.max(0.0).sqrt();
        (squared > 0.0 && distance > 0.0).then_some((distance, mover))
    };
    let nearest = movers.iter().filter_map(one);
    let (distance, mover) = nearest.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let normal = (ray.origin + ray.direction * distance - mover.centre) / mover.radius;
    let is_odd = (normal.z * STRIPES).floor() as i64 % 2 != 0;
    let colour = mover.colours[usize::from(is_odd)];
    let lit = (0.5 + 0.5 * normal.z as f32).mul_add(1.0 - AMBIENT, AMBIENT);
    Some((distance, colour * lit))
}
