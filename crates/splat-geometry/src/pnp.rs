//! Known points and their pixels -> the camera's pose, in spite of wrong pairs.
//!
//! Three-point pose (Grunert 1841, coefficients as in Haralick et al. 1994) inside RANSAC, then Gauss-Newton.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::ransac::{self, Tries};
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

#[derive(Debug, Clone)]
pub struct Placement {
    pub cam_from_world: Rigid,
    /// Indices of the pairs that agree.
    pub inliers: Vec<usize>,
}

const MIN_TRIES: usize = 20;
const MAX_TRIES: usize = 2000;
/// Chance of having missed a sample without outliers at which the search ends.
const MISS: f64 = 1e-4;
/// Share of the pairs that is taken to agree at least.
const LEAST_SHARE: f64 = 0.02;

/// `None` when fewer than `min_inliers` pairs agree within `max_error_px`.
pub fn place(
    points: &[DVec3],
    pixels: &[DVec2],
    camera: &Intrinsics,
    limits: (f64, usize),
    seed: u64,
) -> Option<Placement> {
    let (max_error_px, min_inliers) = limits;
    let n = points.len();
    if n < min_inliers.max(4) || n != pixels.len() {
        return None;
    }
    let rays: Vec<DVec3> = pixels
        .iter()
        .map(|p| camera.ray_in_cam(*p).normalize())
        .collect();
    let models = |sample: [usize; 3]| {
        if ransac::repeats(&sample) {
            Vec::new()
        } else {
            three_point(sample.map(|i| points[i]), sample.map(|i| rays[i]))
        }
    };
    let loss = |pose: &Rigid, _| Some(truncated_cost(points, pixels, camera, pose, max_error_px));
    let tries = Tries {
        min: MIN_TRIES,
        max: MAX_TRIES,
        miss: MISS,
        all_wrong: n as f64 * max_error_px * max_error_px,
        least_share: LEAST_SHARE,
    };
    let mut rng = Pcg32::seed_from_u64(seed);
    let (mut pose, _) = ransac::search(&mut rng, n, &tries, models, loss)?;
    let mut inliers = Vec::new();
    for _ in 0..3 {
        inliers = find_inliers(points, pixels, camera, &pose, max_error_px);
        if inliers.len() < min_inliers {
            return None;
        }
        let picked = |i: &usize| (points[*i], pixels[*i]);
        let pairs: Vec<(DVec3, DVec2)> = inliers.iter().map(picked).collect();
        pose = refine(&pairs, camera, &pose, max_error_px);
    }
    Some(Placement {
        cam_from_world: pose,
        inliers,
    })
}

/// Gauss-Newton on the reprojection error under Cauchy's loss.
pub fn refine(
    pairs: &[(DVec3, DVec2)],
    camera: &Intrinsics,
    start: &Rigid,
    scale_px: f64,
) -> Rigid {
    let mut pose = *start;
    for _ in 0..8 {
        let mut hessian = Matrix6::<f64>::zeros();
        let mut gradient = Vector6::<f64>::zeros();
        for (point, pixel) in pairs {
            let p = pose.transform_point(*point);
            let Some(image) = camera.project(p) else {
                continue;
            };
            let residual = image - *pixel;
            let weight = 1.0 / (1.0 + residual.length_squared() / (scale_px * scale_px));
            for (row, r) in jacobian(camera, p)
                .into_iter()
                .zip([residual.x, residual.y])
            {
                hessian += weight * row * row.transpose();
                gradient += weight * r * row;
            }
        }
        let damped = hessian + Matrix6::identity() * (1e-9 * hessian.trace());
        let Some(step) = damped.cholesky().map(|c| -c.solve(&gradient)) else {
            break;
        };
        pose = (Rigid::exp(
            DVec3::new(step[0], step[1], step[2]),
            DVec3::new(step[3], step[4], step[5]),
        ) * pose)
            .renormalized();
        if step.norm() < 1e-10 {
            break;
        }
    }
    if pose.is_finite() { pose } else { *start }
}

/// Rows du/dxi and dv/dxi for `exp(xi) * p`, translation first.
pub fn jacobian(camera: &Intrinsics, p: DVec3) -> [Vector6<f64>; 2] {
    let (x, y, iz) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
    let (fx, fy) = (camera.fx, camera.fy);
    [
        Vector6::new(
            fx * iz,
            0.0,
            -fx * x * iz,
            -fx * x * y,
            fx * (1.0 + x * x),
            -fx * y,
        ),
        Vector6::new(
            0.0,
            fy * iz,
            -fy * y * iz,
            -fy * (1.0 + y * y),
            fy * x * y,
            fy * x,
        ),
    ]
}

fn find_inliers(
    points: &[DVec3],
    pixels: &[DVec2],
    camera: &Intrinsics,
    pose: &Rigid,
    max_error_px: f64,
) -> Vec<usize> {
    let error = |i: usize| {
        camera
            .project(pose.transform_point(points[i]))
            .map(|p| p.distance(pixels[i]))
    };
    (0..points.len())
        .filter(|&i| error(i).is_some_and(|e| e <= max_error_px))
        .collect()
}

/// Squared errors, each at most the squared limit (MSAC).
fn truncated_cost(
    points: &[DVec3],
    pixels: &[DVec2],
    camera: &Intrinsics,
    pose: &Rigid,
    max_error_px: f64,
) -> f64 {
    let rotation = pose.rotation_matrix();
    let limit = max_error_px * max_error_px;
    let error = |(point, pixel): (&DVec3, &DVec2)| {
        let image = camera.project(rotation * *point + pose.translation);
        image.map_or(limit, |p| p.distance_squared(*pixel).min(limit))
    };
    points.iter().zip(pixels).map(error).sum()
}

/// Poses (at most four) that put three points on three unit rays.
fn three_point(points: [DVec3; 3], rays: [DVec3; 3]) -> Vec<Rigid> {
    let [a2, b2, c2] = [
        points[1] - points[2],
        points[0] - points[2],
        points[0] - points[1],
    ]
    .map(DVec3::length_squared);
    let [ca, cb, cg] = [
        rays[1].dot(rays[2]),
        rays[0].dot(rays[2]),
        rays[0].dot(rays[1]),
    ];
    if a2.min(b2).min(c2) < 1e-18 {
        return Vec::new();
    }
    let (q, s, r) = ((a2 - c2) / b2, (a2 + c2) / b2, (b2 - c2) / b2);
    let coefficients = [
        (1.0 + q).powi(2) - 4.0 * a2 / b2 * cg * cg,
        4.0 * (-q * (1.0 + q) * cb + 2.0 * a2 / b2 * cg * cg * cb - (1.0 - s) * ca * cg),
        2.0 * (q * q - 1.0 + 2.0 * q * q * cb * cb + 2.0 * r * ca * ca - 4.0 * s * ca * cb * cg
            + 2.0 * (b2 - a2) / b2 * cg * cg),
        4.0 * (q * (1.0 - q) * cb - (1.0 - s) * ca * cg + 2.0 * c2 / b2 * ca * ca * cb),
        (q - 1.0).powi(2) - 4.0 * c2 / b2 * ca * ca,
    ];
    let mut poses = Vec::with_capacity(4);
    for v in positive_roots(&coefficients) {
        let below = 2.0 * (cg - v * ca);
        let u = ((q - 1.0) * v * v - 2.0 * q * cb * v + 1.0 + q) / below;
        let square = b2 / (1.0 + v * v - 2.0 * v * cb);
        if below.abs() > 1e-12 && u > 0.0 && square > 0.0 {
            let first = square.sqrt();
            let in_cam = [
                rays[0] * first,
                rays[1] * (u * first),
                rays[2] * (v * first),
            ];
            poses.extend(aligned(points, in_cam));
        }
    }
    poses
}

/// Positive real roots of a quartic, lowest power first: sign changes between the extrema, found by the derivative's roots.
fn positive_roots(c: &[f64; 5]) -> Vec<f64> {
    // A quartic's roots lie between neighbouring roots of its derivative; descending to a line makes each level easy.
    let mut derivatives = vec![c.to_vec()];
    for _ in 0..3 {
        let last = &derivatives[derivatives.len() - 1];
        derivatives.push((1..last.len()).map(|i| last[i] * i as f64).collect());
    }
    let highest = c.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    if !highest.is_finite() || c[4].abs() <= 1e-12 * highest {
        return Vec::new();
    }
    let far = 1.0 + highest / c[4].abs();
    let mut stops: Vec<f64> = vec![0.0, far];
    for polynomial in derivatives.iter().rev() {
        let value = |x: f64| polynomial.iter().rev().fold(0.0, |sum, k| sum * x + k);
        let mut roots = Vec::new();
        for pair in stops.windows(2) {
            let (mut low, mut high) = (pair[0], pair[1]);
            let rising = value(low) < 0.0;
            if rising == (value(high) < 0.0) {
                continue;
            }
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                if (value(middle) < 0.0) == rising {
                    low = middle;
                } else {
                    high = middle;
                }
                if high - low <= 1e-13 * high {
                    break;
                }
            }
            roots.push(0.5 * (low + high));
        }
        stops = [vec![0.0], roots, vec![far]].concat();
    }
    stops[1..stops.len() - 1].to_vec()
}

/// The motion that takes one triangle onto a congruent one.
fn aligned(from: [DVec3; 3], to: [DVec3; 3]) -> Option<Rigid> {
    let frame = |t: [DVec3; 3]| {
        let x = (t[1] - t[0]).try_normalize()?;
        let z = x.cross(t[2] - t[0]).try_normalize()?;
        Some(DMat3::from_cols(x, z.cross(x), z))
    };
    let rotation = frame(to)? * frame(from)?.transpose();
    let pose = Rigid::new(DQuat::from_mat3(&rotation), to[0] - rotation * from[0]);
    pose.is_finite().then_some(pose)
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;

    #[test]
    fn the_pose_is_found_among_forty_percent_wrong_pairs() {
        let camera = Intrinsics {
            width_px: 640,
            height_px: 480,
            fx: 500.0,
            fy: 510.0,
            cx: 322.0,
            cy: 237.0,
        };
        let truth = Rigid::exp(DVec3::new(0.3, -0.2, 1.0), DVec3::new(0.2, -0.4, 0.1));
        let mut rng = Pcg32::seed_from_u64(5);
        let (mut points, mut pixels) = (Vec::new(), Vec::new());
        while points.len() < 100 {
            let point =
                DVec3::from_array([(); 3].map(|()| rng.random_range(-2.0..2.0))) + DVec3::Z * 4.0;
            if let Some(pixel) = camera.project(truth.transform_point(point)) {
                let noise = DVec2::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5));
                let wrong = points.len() % 5 < 2;
                let anywhere =
                    DVec2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
                pixels.push(if wrong { anywhere } else { pixel + noise });
                points.push(point);
            }
        }
        let found = place(&points, &pixels, &camera, (2.0, 30), 1).unwrap();
        assert!(found.inliers.len() >= 58, "{} inliers", found.inliers.len());
        assert!(
            found.cam_from_world.angle_to(&truth) < 2e-3,
            "{}",
            found.cam_from_world.angle_to(&truth)
        );
        assert!(found.cam_from_world.translation.distance(truth.translation) < 1e-2);
        assert!(place(&points[..4], &pixels[..4], &camera, (2.0, 30), 1).is_none());
    }

    #[test]
    fn three_exact_points_give_the_true_pose_among_the_answers() {
        for seed in 0..50 {
            let mut rng = Pcg32::seed_from_u64(seed);
            let mut vector = || DVec3::from_array([(); 3].map(|()| rng.random_range(-1.0..1.0)));
            let truth = Rigid::exp(vector(), vector());
            let in_cam = [vector(), vector(), vector()].map(|v| v + DVec3::Z * 3.0);
            let points = in_cam.map(|p| truth.inverse().transform_point(p));
            let answers = three_point(points, in_cam.map(DVec3::normalize));
            let best = answers
                .iter()
                .map(|p| p.angle_to(&truth))
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-5, "seed {seed}: {best} of {}", answers.len());
        }
    }
}
