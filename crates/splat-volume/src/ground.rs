//! Points of keyframes -> the plane that the robot stands on.

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// The plane's normal is no farther from the guessed vertical, degrees: a camera that nobody mounted is held so, not on its side.
const MAX_TILT_DEG: f64 = 25.0;
/// A point this near is on the plane, metres.
const INLIER: f64 = 0.03;
/// Least share of points on it.
const MIN_SHARE: f64 = 0.03;
/// Points that lie farther below, metres, are below it; of more than this share it would be a table.
const BELOW: f64 = 0.12;
const MAX_SHARE_BELOW: f64 = 0.04;
const N_SAMPLES: usize = 1000;
/// The three points of a sample are at most so far apart in the list: near each other in one image, they are more often on one plane.
const NEAR: usize = 60;
/// Fewer say nothing.
const MIN_POINTS: usize = 300;

/// Points with `normal` . point = `height`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundPlane {
    /// Of unit length, upwards.
    pub normal: DVec3,
    /// Metres along the normal.
    pub height: f64,
    /// Of the points that lie on it.
    pub share: f64,
}

impl GroundPlane {
    /// Points that come from one image lie side by side. The lowest large plane that lies nearly across `up` (RANSAC, then a fit to all that lies on it); `None` where there is none.
    pub fn find(points: &[DVec3], up: DVec3, seed: u64) -> Option<Self> {
        if points.len() < MIN_POINTS {
            return None;
        }
        let mut rng = Pcg32::seed_from_u64(seed);
        let mut best: Option<(usize, DVec3, f64)> = None;
        for _ in 0..N_SAMPLES {
            let first = rng.random_range(0..points.len() - NEAR);
            let [a, b, c] = [0, 1, 2].map(|_| points[first + rng.random_range(0..NEAR)]);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let normal = normal * normal.dot(up).signum();
            if normal.dot(up) < MAX_TILT_DEG.to_radians().cos() {
                continue;
            }
            let height = normal.dot(a);
            let on = on_plane(points, (normal, height)).count();
            if best.is_none_or(|(most, ..)| on > most) {
                best = Some((on, normal, height));
            }
        }
        // Tables, shelves and the floor are parallel: the largest of them has the normal, the lowest is the floor.
        let (_, normal, height) = best?;
        let (normal, _) = (0..3).fold((normal, height), |plane, _| refit(points, plane));
        let height = lowest(points, normal)?;
        let (normal, height) = (0..3).fold((normal, height), |plane, _| refit(points, plane));
        let n_on = on_plane(points, (normal, height)).count();
        let share = n_on as f64 / points.len() as f64;
        (share >= MIN_SHARE && normal.is_finite()).then_some(Self {
            normal,
            height,
            share,
        })
    }

    /// Turns the normal upwards along z.
    pub fn level_from_map(&self) -> DQuat {
        DQuat::from_rotation_arc(self.normal, DVec3::Z)
    }

    pub fn tilt_deg(&self, up: DVec3) -> f64 {
        self.normal.dot(up).clamp(-1.0, 1.0).acos().to_degrees()
    }
}

/// The lowest height along the normal that many points have, and hardly any less.
fn lowest(points: &[DVec3], normal: DVec3) -> Option<f64> {
    let mut heights: Vec<f64> = points.iter().map(|p| normal.dot(*p)).collect();
    heights.sort_unstable_by(f64::total_cmp);
    let n = heights.len() as f64;
    let within = |low: f64, high: f64| {
        heights.partition_point(|h| *h <= high) - heights.partition_point(|h| *h < low)
    };
    let on = |height: f64| within(height - INLIER, height + INLIER);
    let mut first = heights
        .iter()
        .copied()
        .find(|height| on(*height) as f64 >= MIN_SHARE * n)?;
    // Up to where most points are.
    let top = first + 2.0 * INLIER;
    for step in 1..=8 {
        let height = top - 2.0 * INLIER * (1.0 - f64::from(step) / 8.0);
        if on(height) > on(first) {
            first = height;
        }
    }
    let below = heights.partition_point(|h| *h < first - BELOW) as f64;
    (below <= MAX_SHARE_BELOW * n).then_some(first)
}

/// Points that lie on the plane normal . point = height.
fn on_plane(points: &[DVec3], (normal, height): (DVec3, f64)) -> impl Iterator<Item = &DVec3> {
    let is_on = move |p: &&DVec3| (normal.dot(**p) - height).abs() <= INLIER;
    points.iter().filter(is_on)
}

/// Least squares over the points that lie on it, heights along the old normal.
fn refit(points: &[DVec3], (normal, height): (DVec3, f64)) -> (DVec3, f64) {
    let (u, v) = normal.any_orthonormal_pair();
    let on: Vec<DVec3> = on_plane(points, (normal, height))
        .map(|p| DVec3::new(u.dot(*p), v.dot(*p), normal.dot(*p) - height))
        .collect();
    if on.len() < 3 {
        return (normal, height);
    }
    let middle = on.iter().sum::<DVec3>() / on.len() as f64;
    let [mut xx, mut xy, mut yy, mut xz, mut yz] = [0.0; 5];
    for p in &on {
        let d = *p - middle;
        xx += d.x * d.x;
        xy += d.x * d.y;
        yy += d.y * d.y;
        xz += d.x * d.z;
        yz += d.y * d.z;
    }
    let determinant = xx * yy - xy * xy;
    if determinant.abs() < 1e-9 * (xx * yy).max(1e-12) {
        return (normal, height);
    }
    // z = slope . (x, y): the normal leans against the slope.
    let slope_x = (xz * yy - yz * xy) / determinant;
    let slope_y = (yz * xx - xz * xy) / determinant;
    let turned = (normal - u * slope_x - v * slope_y).normalize();
    let place = u * middle.x + v * middle.y + normal * (middle.z + height);
    (turned, turned.dot(place))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor, a table that shows more points than it, walls, and noise of a centimetre.
    fn scene(tilt: DQuat) -> Vec<DVec3> {
        let mut rng = Pcg32::seed_from_u64(3);
        let mut noisy = |x: f64, y: f64, z: f64| {
            let mut noise = || rng.random_range(-0.01..0.01);
            tilt * DVec3::new(x + noise(), y + noise(), z + noise())
        };
        let mut points = Vec::new();
        for i in 0..2000 {
            let (a, b) = (f64::from(i % 50) / 12.0, f64::from(i / 50) / 12.0);
            points.push(noisy(a, b, -1.1));
            points.push(noisy(a / 3.0, b / 3.0, -0.4));
            points.push(noisy(a / 2.0, b / 2.0, -0.4));
            points.push(noisy(4.2, a, b - 1.1));
        }
        points
    }

    #[test]
    fn finds_the_floor_and_not_the_table() {
        let tilt = DQuat::from_rotation_x(0.2) * DQuat::from_rotation_y(-0.1);
        let plane = GroundPlane::find(&scene(tilt), DVec3::Z, 0).unwrap();
        assert!((plane.height + 1.1).abs() < 0.005, "{plane:?}");
        assert!(plane.normal.angle_between(tilt * DVec3::Z) < 0.005);
        assert!((plane.level_from_map() * plane.normal - DVec3::Z).length() < 1e-9);
        assert!((plane.tilt_deg(DVec3::Z) - 12.8).abs() < 0.5);
    }

    #[test]
    fn says_that_there_is_none() {
        let all = scene(DQuat::IDENTITY);
        let wall: Vec<DVec3> = all.iter().copied().filter(|p| p.x > 4.1).collect();
        assert_eq!(GroundPlane::find(&wall, DVec3::Z, 0), None);
        assert_eq!(GroundPlane::find(&all[..50], DVec3::Z, 0), None);
        assert_eq!(
            GroundPlane::find(&[DVec3::ZERO; 1000], DVec3::Z, 0),
            None,
            "points in one place are no plane"
        );
    }
}
