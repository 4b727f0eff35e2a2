//! Matches between two images -> the matches that agree with one rigid scene, and the motion between the cameras.
//!
//! Five-point essential matrix with known cameras, eight-point fundamental matrix without; RANSAC with truncated
//! costs, seeded, so equal inputs give equal outputs.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{DMatrix, Matrix3, SMatrix, SVector};
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::ransac::{self, Tries};
use crate::stats::median;
use crate::two_view::five_point::essential_matrices;
use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, skew};

const MIN_TRIES: usize = 10;
const MAX_TRIES: usize = 400;
/// Share of the matches that is taken to agree at least.
const LEAST_SHARE: f64 = 0.05;
/// Samples for the plane.
const PLANE_TRIES: usize = 100;
/// Chance of having missed a sample without outliers at which the search ends.
const MISS: f64 = 1e-3;

/// Two calibrated cameras; the translation has unit length.
#[derive(Debug, Clone)]
pub struct Motion {
    pub second_from_first: Rigid,
    /// Indices of the matches that agree.
    pub inliers: Vec<usize>,
    /// Median angle in degrees between the two rays of a match; near 0 for a camera that only turns.
    pub parallax_deg: f64,
}

/// Motion between two calibrated images; `pairs` are (pixel in first, pixel in second).
pub fn motion(
    pairs: &[(DVec2, DVec2)],
    cameras: [&Intrinsics; 2],
    max_error_px: f64,
    seed: u64,
) -> Option<Motion> {
    let ray = |camera: &Intrinsics, pixel: DVec2| camera.ray_in_cam(pixel).truncate();
    let rays: Vec<(DVec2, DVec2)> = pairs
        .iter()
        .map(|(a, b)| (ray(cameras[0], *a), ray(cameras[1], *b)))
        .collect();
    let focal = 0.25 * (cameras[0].fx + cameras[0].fy + cameras[1].fx + cameras[1].fy);
    let limit = max_error_px / focal;
    let solve = |sample: &[usize]| {
        let first = std::array::from_fn(|i| rays[sample[i]].0);
        let second = std::array::from_fn(|i| rays[sample[i]].1);
        essential_matrices(&first, &second)
    };
    let essential = consensus::<5>(&rays, limit, seed, solve)?;
    let within = |e: &DMat3| -> Vec<usize> {
        (0..rays.len())
            .filter(|&i| sampson(e, rays[i]) <= limit * limit)
            .collect()
    };
    let mut inliers = within(&essential);
    let picked: Vec<(DVec2, DVec2)> = inliers.iter().map(|&i| rays[i]).collect();
    let mut pose = facing(&essential, &picked)?;
    for _ in 0..2 {
        let picked: Vec<(DVec2, DVec2)> = inliers.iter().map(|&i| rays[i]).collect();
        pose = polished(&pose, &picked, limit);
        inliers = within(&essential_of(&pose));
    }
    inliers.retain(|&i| is_in_front(&pose, rays[i]));
    let mut angles: Vec<f64> = inliers.iter().map(|&i| ray_angle(&pose, rays[i])).collect();
    let parallax_deg = median(&mut angles)?.to_degrees();
    Some(Motion {
        second_from_first: pose,
        inliers,
        parallax_deg,
    })
}

/// Fundamental matrix (`second^T F first = 0`) and the matches that agree with it.
pub fn fundamental(
    pairs: &[(DVec2, DVec2)],
    max_error_px: f64,
    seed: u64,
) -> Option<(DMat3, Vec<usize>)> {
    let solve = |sample: &[usize]| {
        let picked: Vec<(DVec2, DVec2)> = sample.iter().map(|&i| pairs[i]).collect();
        eight_point(&picked).into_iter().collect()
    };
    let limit = max_error_px * max_error_px;
    let within = |f: &DMat3| -> Vec<usize> {
        (0..pairs.len())
            .filter(|&i| sampson(f, pairs[i]) <= limit)
            .collect()
    };
    let matrix = consensus::<8>(pairs, max_error_px, seed, solve)?;
    let inliers = within(&matrix);
    let fit = |inliers: &[usize]| {
        let picked: Vec<(DVec2, DVec2)> = inliers.iter().map(|&i| pairs[i]).collect();
        eight_point(&picked)
    };
    Some(ransac::refit((matrix, inliers), 3, fit, within))
}

/// Share of the matches that one plane, or a camera that only turns, explains.
pub fn homography_share(pairs: &[(DVec2, DVec2)], max_error_px: f64, seed: u64) -> f64 {
    let n = pairs.len();
    if n < 8 {
        return 1.0;
    }
    homography(pairs, max_error_px, seed).map_or(0.0, |found| found.1 as f64 / n as f64)
}

/// The homography (second ~ H first, in pixels) that most of the matches agree with, and their number.
pub fn homography(
    pairs: &[(DVec2, DVec2)],
    max_error_px: f64,
    seed: u64,
) -> Option<(DMat3, usize)> {
    let n = pairs.len();
    let error = |matrix: &DMat3, (a, b): &(DVec2, DVec2)| {
        let image = *matrix * a.extend(1.0);
        if image.z.abs() < 1e-12 {
            f64::INFINITY
        } else {
            (image.truncate() / image.z).distance(*b)
        }
    };
    let models = |sample: [usize; 4]| four_point(&sample.map(|i| pairs[i]));
    let loss = |matrix: &DMat3, _| {
        let inliers = pairs.iter().filter(|p| error(matrix, p) <= max_error_px);
        Some((n - inliers.count()) as f64)
    };
    let mut rng = Pcg32::seed_from_u64(seed);
    let best = ransac::search(&mut rng, n, &Tries::fixed(PLANE_TRIES), models, loss);
    best.map(|(matrix, n_off)| (matrix, n - n_off as usize))
}

/// RANSAC with truncated costs. Errors are Sampson distances in the unit of `data`.
fn consensus<const N: usize>(
    data: &[(DVec2, DVec2)],
    limit: f64,
    seed: u64,
    solve: impl Fn(&[usize]) -> Vec<DMat3>,
) -> Option<DMat3> {
    let n = data.len();
    if n < 2 * N {
        return None;
    }
    let models = |sample: [usize; N]| {
        if ransac::repeats(&sample) {
            Vec::new()
        } else {
            solve(&sample)
        }
    };
    let loss = |matrix: &DMat3, bound| truncated_cost(data, matrix, limit * limit, bound);
    let tries = Tries {
        min: MIN_TRIES,
        max: MAX_TRIES,
        miss: MISS,
        all_wrong: n as f64 * limit * limit,
        least_share: LEAST_SHARE,
    };
    let mut rng = Pcg32::seed_from_u64(seed);
    ransac::search(&mut rng, n, &tries, models, loss).map(|best| best.0)
}

/// `None` as soon as the cost passes `bound`.
fn truncated_cost(data: &[(DVec2, DVec2)], matrix: &DMat3, limit: f64, bound: f64) -> Option<f64> {
    let mut cost = 0.0;
    for chunk in data.chunks(32) {
        cost += chunk
            .iter()
            .map(|pair| sampson(matrix, *pair).min(limit))
            .sum::<f64>();
        if cost >= bound {
            return None;
        }
    }
    cost.is_finite().then_some(cost)
}

/// Squared distance of a match to the epipolar constraint, to first order (Sampson 1982).
fn sampson(matrix: &DMat3, (a, b): (DVec2, DVec2)) -> f64 {
    let (a, b) = (a.extend(1.0), b.extend(1.0));
    let line = *matrix * a;
    let back = matrix.transpose() * b;
    let value = b.dot(line);
    value * value
        / (line.x * line.x + line.y * line.y + back.x * back.x + back.y * back.y).max(1e-300)
}

fn essential_of(pose: &Rigid) -> DMat3 {
    skew(pose.translation) * pose.rotation_matrix()
}

/// Of the four motions of an essential matrix, the one that has most matches in front of both cameras.
fn facing(essential: &DMat3, rays: &[(DVec2, DVec2)]) -> Option<Rigid> {
    let svd = Matrix3::from_column_slice(&essential.to_cols_array()).svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let (mut best, mut most) = (None, 0);
    for turn in [w, w.transpose()] {
        let mut r = u * turn * vt;
        if r.determinant() < 0.0 {
            r = -r;
        }
        let rotation = DQuat::from_mat3(&DMat3::from_cols_slice(r.as_slice()));
        for sign in [1.0, -1.0] {
            let t = u.column(2) * sign;
            let pose = Rigid::new(rotation, DVec3::new(t[0], t[1], t[2]));
            let count = rays
                .iter()
                .filter(|pair| is_in_front(&pose, **pair))
                .count();
            if count > most {
                (best, most) = (Some(pose), count);
            }
        }
    }
    best.filter(Rigid::is_finite)
}

/// Depth signs of the midpoint; matches at infinity count as in front.
fn is_in_front(pose: &Rigid, (a, b): (DVec2, DVec2)) -> bool {
    let first = pose.rotation * a.extend(1.0);
    let second = b.extend(1.0);
    let normal = first.cross(second);
    let square = normal.length_squared();
    if square < 1e-8 * first.length_squared() * second.length_squared() {
        return first.dot(second) > 0.0;
    }
    // first * d1 + t = second * d2
    let d1 = second.cross(pose.translation).dot(normal) / square;
    let d2 = first.cross(pose.translation).dot(normal) / square;
    d1 > 0.0 && d2 > 0.0
}

fn ray_angle(pose: &Rigid, (a, b): (DVec2, DVec2)) -> f64 {
    let first = pose.rotation * a.extend(1.0);
    first
        .cross(b.extend(1.0))
        .length()
        .atan2(first.dot(b.extend(1.0)))
}

/// Gauss-Newton on the Sampson distance over rotation and direction of translation, derivatives by differences.
fn polished(start: &Rigid, rays: &[(DVec2, DVec2)], limit: f64) -> Rigid {
    let mut pose = *start;
    let signed = |pose: &Rigid, pair: &(DVec2, DVec2)| {
        let e = essential_of(pose);
        let sign = pair.1.extend(1.0).dot(e * pair.0.extend(1.0)).signum();
        sign * sampson(&e, *pair).sqrt()
    };
    for _ in 0..4 {
        let (side, up) = pose.translation.any_orthonormal_pair();
        let moved = |i: usize, by: f64| {
            let turn = [DVec3::X, DVec3::Y, DVec3::Z];
            if i < 3 {
                return Rigid::new(
                    DQuat::from_scaled_axis(turn[i] * by) * pose.rotation,
                    pose.translation,
                );
            }
            let shift = if i == 3 { side } else { up };
            Rigid::new(pose.rotation, (pose.translation + shift * by).normalize())
        };
        let mut hessian = SMatrix::<f64, 5, 5>::zeros();
        let mut gradient = SVector::<f64, 5>::zeros();
        const STEP: f64 = 1e-6;
        let nudged: [Rigid; 5] = std::array::from_fn(|i| moved(i, STEP));
        for pair in rays {
            let here = signed(&pose, pair);
            let row = SVector::<f64, 5>::from_fn(|i, _| (signed(&nudged[i], pair) - here) / STEP);
            let weight = 1.0 / (1.0 + here * here / (limit * limit));
            hessian += weight * row * row.transpose();
            gradient += weight * here * row;
        }
        hessian += SMatrix::<f64, 5, 5>::identity() * (1e-6 * hessian.trace());
        let Some(step) = hessian.cholesky().map(|c| -c.solve(&gradient)) else {
            break;
        };
        let turned = DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2])) * pose.rotation;
        let shifted = (pose.translation + side * step[3] + up * step[4]).normalize();
        pose = Rigid::new(turned, shifted).renormalized();
    }
    if pose.is_finite() { pose } else { *start }
}

/// Shift and scale that bring points to mean 0 and mean distance sqrt(2) (Hartley 1997).
fn conditioning(points: impl Iterator<Item = DVec2> + Clone) -> DMat3 {
    let n = points.clone().count().max(1) as f64;
    let mean = points.clone().sum::<DVec2>() / n;
    let spread = points.map(|p| p.distance(mean)).sum::<f64>() / n;
    let scale = std::f64::consts::SQRT_2 / spread.max(1e-12);
    DMat3::from_cols(
        DVec3::X * scale,
        DVec3::Y * scale,
        DVec3::new(-mean.x * scale, -mean.y * scale, 1.0),
    )
}

/// Least squares over all pairs (Hartley 1997); at least eight.
pub fn eight_point(pairs: &[(DVec2, DVec2)]) -> Option<DMat3> {
    if pairs.len() < 8 {
        return None;
    }
    let first = conditioning(pairs.iter().map(|p| p.0));
    let second = conditioning(pairs.iter().map(|p| p.1));
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in pairs {
        let (a, b) = (first * a.extend(1.0), second * b.extend(1.0));
        let row = SVector::<f64, 9>::from_column_slice(&[
            b.x * a.x,
            b.x * a.y,
            b.x,
            b.y * a.x,
            b.y * a.y,
            b.y,
            a.x,
            a.y,
            1.0,
        ]);
        normal += row * row.transpose();
    }
    let vector = smallest_eigenvector(&normal);
    let f = Matrix3::from_row_slice(vector.as_slice());
    let mut svd = f.svd(true, true);
    let (smallest, _) = svd.singular_values.argmin();
    svd.singular_values[smallest] = 0.0;
    let flat = svd.recompose().ok()?;
    let matrix = second.transpose() * DMat3::from_cols_slice(flat.as_slice()) * first;
    let length = matrix
        .to_cols_array()
        .iter()
        .map(|v| v * v)
        .sum::<f64>()
        .sqrt();
    (length.is_finite() && length > 0.0).then(|| matrix * (1.0 / length))
}

fn smallest_eigenvector(normal: &SMatrix<f64, 9, 9>) -> SVector<f64, 9> {
    let eigen = normal.symmetric_eigen();
    let (smallest, _) = eigen.eigenvalues.argmin();
    eigen.eigenvectors.column(smallest).into_owned()
}

fn four_point(pairs: &[(DVec2, DVec2); 4]) -> Option<DMat3> {
    let mut system = DMatrix::<f64>::zeros(8, 8);
    let mut right = nalgebra::DVector::<f64>::zeros(8);
    for (i, (a, b)) in pairs.iter().enumerate() {
        let rows = [
            [a.x, a.y, 1.0, 0.0, 0.0, 0.0, -b.x * a.x, -b.x * a.y],
            [0.0, 0.0, 0.0, a.x, a.y, 1.0, -b.y * a.x, -b.y * a.y],
        ];
        for (k, row) in rows.iter().enumerate() {
            for (column, value) in row.iter().enumerate() {
                system[(2 * i + k, column)] = *value;
            }
            right[2 * i + k] = if k == 0 { b.x } else { b.y };
        }
    }
    let h = system.lu().solve(&right)?;
    let matrix = DMat3::from_cols(
        DVec3::new(h[0], h[3], h[6]),
        DVec3::new(h[1], h[4], h[7]),
        DVec3::new(h[2], h[5], 1.0),
    );
    matrix.is_finite().then_some(matrix)
}

#[cfg(test)]
mod tests;
