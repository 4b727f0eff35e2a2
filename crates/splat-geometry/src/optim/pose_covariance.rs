//! How well the points that a camera sees fix its pose.
//!
//! Covariance of a least-squares fit: the residuals' variance times the inverse of the normal matrix (Hartley and
//! Zisserman 2004, 5.2). The points count as exact, so that it is a lower bound; see `MIN_STD_PX`.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix6, SMatrix};

use splat_types::camera::Intrinsics;
use splat_types::covariance::Covariance;
use splat_types::transform::Rigid;

/// Pixels of a point are never known better, whatever a few lucky residuals say.
const MIN_STD_PX: f64 = 0.1;
/// Of normally distributed values: standard deviation per median of the absolute length in two dimensions.
const STD_PER_MEDIAN: f64 = 0.849_321_8;

/// `None` where the points leave a direction open: too few, or all in one place.
pub fn pose_covariance(
    cam_from_world: &Rigid,
    intrinsics: &Intrinsics,
    observations: &[(DVec3, DVec2)],
) -> Option<Covariance> {
    let mut normal = Matrix6::<f64>::zeros();
    let mut errors = Vec::with_capacity(observations.len());
    for (point, pixel) in observations {
        let p = cam_from_world.transform_point(*point);
        let Some(image) = intrinsics.project(p) else {
            continue;
        };
        errors.push(image.distance(*pixel));
        let rows = by_pose(p, intrinsics);
        normal += rows.transpose() * rows;
    }
    if errors.len() < 6 {
        return None;
    }
    let middle = errors.len() / 2;
    let (_, median, _) = errors.select_nth_unstable_by(middle, f64::total_cmp);
    let std_px = (STD_PER_MEDIAN * *median).max(MIN_STD_PX);
    // Lengths and angles differ by the scene's size: scaled to a unit diagonal, the inverse keeps its digits.
    let scale = normal.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = SMatrix::<f64, 6, 6>::from_fn(|i, j| normal[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    let covariance: Covariance = std::array::from_fn(|i| {
        std::array::from_fn(|j| std_px * std_px * inverse[(i, j)] * scale[i] * scale[j])
    });
    covariance
        .as_flattened()
        .iter()
        .all(|v| v.is_finite())
        .then_some(covariance)
}

/// What observations of exact points indicate a pose, in px^-2: the inverse covariance for pixels of standard deviation 1.
/// Cauchy's loss weighs each by how well it fits.
pub fn pose_information(
    cam_from_world: &Rigid,
    intrinsics: &Intrinsics,
    observations: impl Iterator<Item = (DVec3, DVec2)>,
    loss_px: f64,
) -> [[f64; 6]; 6] {
    let mut normal = Matrix6::<f64>::zeros();
    for (point, pixel) in observations {
        let p = cam_from_world.transform_point(point);
        if let Some(image) = intrinsics.project(p) {
            let share = image.distance_squared(pixel) / (loss_px * loss_px);
            let rows = by_pose(p, intrinsics);
            normal += rows.transpose() * rows / (1.0 + share);
        }
    }
    std::array::from_fn(|i| std::array::from_fn(|j| normal[(i, j)]))
}

/// Pixel of a point in the camera, derived by a small shift and turn of the camera in its own axes.
fn by_pose(p: DVec3, intrinsics: &Intrinsics) -> SMatrix<f64, 2, 6> {
    let (x, y, over) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
    let (fx, fy) = (intrinsics.fx, intrinsics.fy);
    SMatrix::<f64, 2, 6>::from_row_slice(&[
        -fx * over,
        0.0,
        fx * x * over,
        fx * x * y,
        -fx * (1.0 + x * x),
        fx * y,
        0.0,
        -fy * over,
        fy * y * over,
        fy * (1.0 + y * y),
        -fy * x * y,
        -fy * x,
    ])
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    const LENS: Intrinsics = Intrinsics {
        width_px: 640,
        height_px: 480,
        fx: 500.0,
        fy: 500.0,
        cx: 320.0,
        cy: 240.0,
    };

    fn gaussian(rng: &mut Pcg32) -> f64 {
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    fn points(n: usize, rng: &mut Pcg32) -> Vec<DVec3> {
        let mut share = |low: f64, high: f64| rng.random_range(low..high);
        (0..n)
            .map(|_| DVec3::new(share(-2.0, 2.0), share(-1.5, 1.5), share(4.0, 9.0)))
            .collect()
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let p = DVec3::new(0.7, -0.4, 3.0);
        let rows = by_pose(p, &LENS);
        for k in 0..6 {
            let moved = |by: f64| {
                let mut v = [0.0; 6];
                v[k] = by;
                let camera_moved =
                    Rigid::exp(DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
                LENS.project(camera_moved.inverse().transform_point(p))
                    .unwrap()
            };
            let slope = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            let error = (slope - DVec2::new(rows[(0, k)], rows[(1, k)])).length();
            assert!(error < 1e-4 * slope.length().max(1.0), "{k}: {error}");
        }
    }

    /// Mean of e^T C^-1 e over poses fitted to noisy pixels: 6 for a covariance that is right.
    #[test]
    fn stated_and_actual_errors_agree() {
        let mut rng = Pcg32::seed_from_u64(5);
        let (mut nees, tries) = (0.0, 120);
        for _ in 0..tries {
            let points = points(60, &mut rng);
            let observations: Vec<(DVec3, DVec2)> = points
                .iter()
                .map(|p| {
                    let noise = DVec2::new(gaussian(&mut rng), gaussian(&mut rng)) * 0.7;
                    (*p, LENS.project(*p).unwrap() + noise)
                })
                .collect();
            let fitted = fit(&observations);
            let covariance = pose_covariance(&fitted, &LENS, &observations).unwrap();
            let matrix = Matrix6::from_fn(|i, j| covariance[i][j]);
            // The true camera is the identity: where it stands as seen from the fitted one.
            let off = fitted.inverse();
            let (rho, theta) = (off.translation, off.rotation.to_scaled_axis());
            let error = nalgebra::Vector6::new(rho.x, rho.y, rho.z, theta.x, theta.y, theta.z);
            nees += (error.transpose() * matrix.try_inverse().unwrap() * error)[0];
        }
        let mean = nees / f64::from(tries);
        assert!((4.5..8.5).contains(&mean), "{mean}");
    }

    /// Gauss and Newton from the true pose.
    fn fit(observations: &[(DVec3, DVec2)]) -> Rigid {
        let mut pose = Rigid::IDENTITY;
        for _ in 0..6 {
            let (mut a, mut b) = (Matrix6::zeros(), nalgebra::Vector6::zeros());
            for (point, pixel) in observations {
                let p = pose.transform_point(*point);
                let r = LENS.project(p).unwrap() - *pixel;
                let rows = by_pose(p, &LENS);
                a += rows.transpose() * rows;
                b += rows.transpose() * nalgebra::Vector2::new(r.x, r.y);
            }
            let step = -a.try_inverse().unwrap() * b;
            let moved = Rigid::exp(
                DVec3::new(step[0], step[1], step[2]),
                DVec3::new(step[3], step[4], step[5]),
            );
            pose = moved.inverse() * pose;
        }
        pose
    }

    #[test]
    fn information_is_the_inverse_of_covariance() {
        let mut rng = Pcg32::seed_from_u64(3);
        let points = points(50, &mut rng);
        let exact: Vec<(DVec3, DVec2)> = points
            .iter()
            .map(|p| (*p, LENS.project(*p).unwrap()))
            .collect();
        let covariance = pose_covariance(&Rigid::IDENTITY, &LENS, &exact).unwrap();
        let reported = pose_information(&Rigid::IDENTITY, &LENS, exact.into_iter(), 1.0);
        let product = Matrix6::from_fn(|i, j| covariance[i][j])
            * Matrix6::from_fn(|i, j| reported[i][j])
            / (MIN_STD_PX * MIN_STD_PX);
        assert!(
            (product - Matrix6::identity()).abs().max() < 1e-6,
            "{product}"
        );
    }

    #[test]
    fn points_that_leave_the_pose_open_give_none() {
        let mut rng = Pcg32::seed_from_u64(2);
        let few: Vec<(DVec3, DVec2)> = points(4, &mut rng)
            .into_iter()
            .map(|p| (p, DVec2::ZERO))
            .collect();
        assert_eq!(pose_covariance(&Rigid::IDENTITY, &LENS, &few), None);
        let one = vec![(DVec3::new(0.1, 0.2, 5.0), DVec2::new(330.0, 260.0)); 20];
        assert_eq!(pose_covariance(&Rigid::IDENTITY, &LENS, &one), None);
    }

    #[test]
    fn more_points_and_less_noise_give_more() {
        let mut rng = Pcg32::seed_from_u64(9);
        let mut std = |n: usize, noise: f64| {
            let observations: Vec<(DVec3, DVec2)> = points(n, &mut rng)
                .into_iter()
                .map(|p| (p, LENS.project(p).unwrap() + DVec2::splat(noise)))
                .collect();
            pose_covariance(&Rigid::IDENTITY, &LENS, &observations).unwrap()[0][0].sqrt()
        };
        let (coarse, fine, many) = (std(50, 1.0), std(50, 0.3), std(800, 0.3));
        assert!(
            coarse > 2.0 * fine && fine > 2.0 * many,
            "{coarse} {fine} {many}"
        );
    }
}
