//! Points whose depth is a little off, and the pixels that show them -> the camera's pose, and how sure it is.
//!
//! Gauss-Newton on whitened reprojection errors under Cauchy's loss. A point's own error of depth moves its pixel along
//! the line to the keyframe that it was seen from, and counts there only as far as the camera has moved sideways.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix2x6, Matrix6, Vector2, Vector6};

use splat_geometry::pnp;
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

const MAX_ROUNDS: usize = 15;
/// Cauchy's scale, in standard deviations of the residuals.
const CAUCHY: f64 = 2.0;
/// Median of chi squared with two degrees of freedom.
const CHI2_MEDIAN: f64 = 1.386;
/// 99 % of chi squared with two degrees of freedom: what lies beyond is an outlier.
const CHI2_INLIER: f64 = 9.21;
/// Mean of chi squared with two degrees of freedom over mean of what the cut above leaves of it.
const CUT_CORRECTION: f64 = 1.049;
/// Residuals are never trusted to be smaller than so many stated standard deviations: a few lucky ones say little.
const MIN_SCALE: f64 = 0.3;
/// Cells of the image whose residuals may err together: neighbouring points lie on one surface, and stereo and networks
/// err by surface, not by point. Large enough to hold most surfaces whole: of errors that reach across cells the jackknife
/// reports only a part (6x4 cells left 8 % of the variance untold on a synthetic room).
const CELLS: (usize, usize) = (4, 3);
/// Variance of one unknown over that with all others known, from which it counts as open.
const MAX_CONDITION: f64 = 1e8;
/// Fewer points than this leave no residuals to judge by.
const MIN_OBSERVATIONS: usize = 8;

/// A landmark and the pixel that shows it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Correspondence {
    pub(crate) point_in_world: DVec3,
    /// Where the point goes when its depth grows by one standard deviation, less the point.
    pub(crate) depth_std_in_world: DVec3,
    pub(crate) pixel: DVec2,
    pub(crate) std_px: f64,
}

#[derive(Debug, Clone)]
pub(crate) struct Fit {
    pub(crate) cam_from_world: Rigid,
    /// Of the camera in its own axes, translation first, as `geometry::uncertainty` has it; residuals are taken for
    /// independent, see `design`.
    pub(crate) covariance: Matrix6<f64>,
    /// Indices of the observations that agree.
    pub(crate) inliers: Vec<usize>,
    /// Standard deviation of the residuals as a multiple of the stated one.
    pub(crate) scale: f64,
    /// By how much residuals that err together raise the variance of the pose (Kish 1965 calls it the design effect);
    /// 1 for independent ones. A noisy figure: the mean of several frames is worth more.
    pub(crate) design: f64,
}

/// Residual of an observation, its derivative by the pose and the inverse of its covariance applied to both.
struct Term {
    squared: f64,
    by_pose: Matrix2x6<f64>,
    weighted: Matrix2x6<f64>,
    weighted_residual: Vector2<f64>,
}

/// `None` where the observations leave the pose open, or lie behind the camera.
pub(crate) fn fit(
    observations: &[Correspondence],
    camera: &Intrinsics,
    start: &Rigid,
) -> Option<Fit> {
    let rough = settled(observations, camera, start, true)?;
    let inliers = find_inliers(observations, camera, &rough)?;
    // Cauchy's loss makes use of seven eighths of what good residuals say, and the covariance below is that of all of it.
    let kept: Vec<Correspondence> = inliers.iter().map(|i| observations[*i]).collect();
    let pose = settled(&kept, camera, &rough, false)?;
    judged(&kept, camera, pose, inliers)
}

/// Where Gauss-Newton comes to rest, under Cauchy's loss or plain squares.
fn settled(
    observations: &[Correspondence],
    camera: &Intrinsics,
    start: &Rigid,
    is_robust: bool,
) -> Option<Rigid> {
    let mut pose = *start;
    for _ in 0..MAX_ROUNDS {
        let terms = terms(observations, camera, &pose);
        if terms.len() < MIN_OBSERVATIONS {
            return None;
        }
        let scale = median_scale(&terms);
        let mut normal = Matrix6::<f64>::zeros();
        let mut slope = Vector6::<f64>::zeros();
        for (_, term) in &terms {
            let share = term.squared / (CAUCHY * scale).powi(2);
            let weight = if is_robust { 1.0 / (1.0 + share) } else { 1.0 };
            normal += term.by_pose.transpose() * term.weighted * weight;
            slope += term.by_pose.transpose() * term.weighted_residual * weight;
        }
        let damped = normal + Matrix6::from_diagonal(&normal.diagonal()) * 1e-6;
        let step = -damped.cholesky()?.solve(&slope);
        pose = (Rigid::exp(
            DVec3::new(step[0], step[1], step[2]),
            DVec3::new(step[3], step[4], step[5]),
        ) * pose)
            .renormalized();
        if !pose.is_finite() {
            return None;
        }
        // In standard deviations of the pose: what is left is far below its error.
        if step.dot(&(normal * step)) < 1e-6 * scale * scale {
            break;
        }
    }
    Some(pose)
}

fn find_inliers(
    observations: &[Correspondence],
    camera: &Intrinsics,
    pose: &Rigid,
) -> Option<Vec<usize>> {
    let terms = terms(observations, camera, pose);
    if terms.len() < MIN_OBSERVATIONS {
        return None;
    }
    let limit = CHI2_INLIER * median_scale(&terms).powi(2);
    let kept = terms.iter().filter(|(_, term)| term.squared <= limit);
    let kept: Vec<usize> = kept.map(|(i, _)| *i).collect();
    (kept.len() >= MIN_OBSERVATIONS).then_some(kept)
}

/// `inliers`: the numbers of `observations` among all.
fn judged(
    observations: &[Correspondence],
    camera: &Intrinsics,
    pose: Rigid,
    inliers: Vec<usize>,
) -> Option<Fit> {
    let terms = terms(observations, camera, &pose);
    let mut normal = Matrix6::<f64>::zeros();
    let mut cells = vec![(Matrix6::<f64>::zeros(), Vector6::<f64>::zeros()); CELLS.0 * CELLS.1];
    let mut squares = 0.0;
    for (i, term) in &terms {
        let information = term.by_pose.transpose() * term.weighted;
        normal += information;
        squares += term.squared;
        let cell = &mut cells[cell_of(observations[*i].pixel, camera)];
        cell.0 += information;
        cell.1 += term.by_pose.transpose() * term.weighted_residual;
    }
    let inverse = inverse(&normal)?;
    let freedom = (2 * terms.len()).checked_sub(6).filter(|n| *n > 0)? as f64;
    let scale = (CUT_CORRECTION * squares / freedom).sqrt().max(MIN_SCALE);
    let variance = scale * scale;
    let design = design_effect(&normal, &cells) / variance;
    Some(Fit {
        cam_from_world: pose,
        covariance: inverse * variance,
        inliers,
        scale,
        design,
    })
}

/// How far the pose would move without each cell, against what independent residuals of variance 1 would do: the
/// jackknife over clusters (Bell and McCaffrey 2002), which is not fooled by what the fit has already absorbed. With
/// this few cells it errs to the careful side.
fn design_effect(normal: &Matrix6<f64>, cells: &[(Matrix6<f64>, Vector6<f64>)]) -> f64 {
    let moves = cells.iter().filter_map(|(information, slope)| {
        let step = inverse(&(normal - information))? * slope;
        (slope.norm_squared() > 0.0).then_some(step.dot(&(normal * step)))
    });
    let (n, sum) = moves.fold((0.0, 0.0), |(n, sum), moved| (n + 1.0, sum + moved));
    sum * (n - 1.0) / (6.0 * f64::max(n, 1.0))
}

fn term(observation: &Correspondence, camera: &Intrinsics, pose: &Rigid) -> Option<Term> {
    let p = pose.transform_point(observation.point_in_world);
    let residual = camera.project(p)? - observation.pixel;
    let [along_x, along_y] = pnp::jacobian(camera, p);
    let by_pose = Matrix2x6::from_rows(&[along_x.transpose(), along_y.transpose()]);
    // The first three columns are the derivative by the point itself.
    let drift = pose.rotation * observation.depth_std_in_world;
    let drift = by_pose.fixed_columns::<3>(0) * nalgebra::Vector3::new(drift.x, drift.y, drift.z);
    // Inverse of std^2 I + d d^T (Sherman and Morrison 1950).
    let variance = observation.std_px * observation.std_px;
    let share = 1.0 / (variance + drift.norm_squared());
    let residual = Vector2::new(residual.x, residual.y);
    let weighted_residual = (residual - drift * (share * drift.dot(&residual))) / variance;
    let weighted = (by_pose - drift * (drift.transpose() * by_pose) * share) / variance;
    let squared = residual.dot(&weighted_residual);
    squared.is_finite().then_some(Term {
        squared,
        by_pose,
        weighted,
        weighted_residual,
    })
}

/// Of the observations in front of the camera, with their numbers.
fn terms(observations: &[Correspondence], camera: &Intrinsics, pose: &Rigid) -> Vec<(usize, Term)> {
    let found = observations.iter().enumerate();
    let found = found.filter_map(|(i, observation)| Some((i, term(observation, camera, pose)?)));
    found.collect()
}

fn median_scale(terms: &[(usize, Term)]) -> f64 {
    let mut squares: Vec<f64> = terms.iter().map(|(_, term)| term.squared).collect();
    let middle = squares.len() / 2;
    let (_, median, _) = squares.select_nth_unstable_by(middle, f64::total_cmp);
    (*median / CHI2_MEDIAN).sqrt().max(MIN_SCALE)
}

fn cell_of(pixel: DVec2, camera: &Intrinsics) -> usize {
    let along = |at: f64, side: u32, n: usize| {
        let cell = (at / f64::from(side.max(1)) * n as f64).max(0.0);
        (cell as usize).min(n - 1)
    };
    let column = along(pixel.x, camera.width_px, CELLS.0);
    along(pixel.y, camera.height_px, CELLS.1) * CELLS.0 + column
}

/// Lengths and angles differ by the scene's size: scaled to a unit diagonal, the inverse keeps its digits.
pub(crate) fn inverse(normal: &Matrix6<f64>) -> Option<Matrix6<f64>> {
    let scale = normal.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = Matrix6::from_fn(|i, j| normal[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    let is_open = inverse.diagonal().iter().any(|v| *v > MAX_CONDITION);
    let inverse = Matrix6::from_fn(|i, j| inverse[(i, j)] * scale[i] * scale[j]);
    (!is_open && inverse.iter().all(|v| v.is_finite())).then_some(inverse)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    const LENS: Intrinsics = Intrinsics {
        width_px: 320,
        height_px: 240,
        fx: 270.0,
        fy: 270.0,
        cx: 160.0,
        cy: 120.0,
    };
    const PIXEL_STD: f64 = 0.7;
    const DEPTH_STD: f64 = 0.02;

    fn gaussian(rng: &mut Pcg32) -> f64 {
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    /// A keyframe at the origin and a camera that has moved from it: (observations, true pose). Depth errs by point, or by
    /// the cell of the image where `together`.
    fn observations(n: usize, together: bool, rng: &mut Pcg32) -> (Vec<Correspondence>, Rigid) {
        let truth = Rigid::exp(DVec3::new(-0.5, 0.1, 0.2), DVec3::new(0.02, 0.09, -0.03));
        let by_cell: Vec<f64> = (0..24).map(|_| gaussian(rng)).collect();
        let mut out = Vec::new();
        while out.len() < n {
            let pixel = DVec2::new(rng.random_range(0.0..320.0), rng.random_range(0.0..240.0));
            let z = rng.random_range(2.0..6.0);
            let point = LENS.ray_in_cam(pixel) * z;
            let shown = LENS.project(truth.transform_point(point)).unwrap();
            let error = if together {
                by_cell[cell_of(pixel, &LENS)]
            } else {
                gaussian(rng)
            };
            let noise = DVec2::new(gaussian(rng), gaussian(rng)) * PIXEL_STD;
            out.push(Correspondence {
                point_in_world: point * (1.0 + DEPTH_STD * error),
                depth_std_in_world: point * DEPTH_STD,
                pixel: shown + noise,
                std_px: PIXEL_STD,
            });
        }
        (out, truth)
    }

    /// e^T C^-1 e of the camera in its own axes.
    fn nees(fit: &Fit, truth: &Rigid, covariance: &Matrix6<f64>) -> f64 {
        let off = fit.cam_from_world * truth.inverse();
        let rotation = if off.rotation.w < 0.0 {
            -off.rotation
        } else {
            off.rotation
        };
        let (rho, theta) = (off.translation, rotation.to_scaled_axis());
        let error = Vector6::new(rho.x, rho.y, rho.z, theta.x, theta.y, theta.z);
        error.dot(&(inverse(covariance).unwrap() * error))
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let (observations, pose) = observations(20, false, &mut Pcg32::seed_from_u64(3));
        for observation in &observations {
            let base = term(observation, &LENS, &pose).unwrap();
            for k in 0..6 {
                let shown = |by: f64| {
                    let mut v = [0.0; 6];
                    v[k] = by;
                    let (rho, theta) = (DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
                    let p =
                        (Rigid::exp(rho, theta) * pose).transform_point(observation.point_in_world);
                    LENS.project(p).unwrap()
                };
                let slope = (shown(1e-6) - shown(-1e-6)) / 2e-6;
                let stated = DVec2::new(base.by_pose[(0, k)], base.by_pose[(1, k)]);
                let error = (slope - stated).length();
                assert!(error < 1e-4 * slope.length().max(1.0), "{k}: {error}");
            }
        }
    }

    #[test]
    fn the_pose_is_found_in_spite_of_a_third_of_wrong_pairs() {
        let mut rng = Pcg32::seed_from_u64(8);
        let (mut observations, truth) = observations(150, false, &mut rng);
        for observation in observations.iter_mut().step_by(3) {
            observation.pixel +=
                DVec2::new(rng.random_range(-12.0..12.0), rng.random_range(8.0..15.0));
        }
        let start = Rigid::exp(DVec3::splat(0.02), DVec3::splat(0.01)) * truth;
        let fit = fit(&observations, &LENS, &start).unwrap();
        let off = (fit.cam_from_world * truth.inverse()).translation.length();
        assert!(
            off < 0.03 && (90..=102).contains(&fit.inliers.len()),
            "{off} {}",
            fit.inliers.len()
        );
    }

    /// Mean over many fits: 6 for a covariance that is right. Where all error of depth is in common, the few cells report most
    /// of it.
    #[test]
    fn stated_and_actual_errors_agree_and_errors_in_common_are_given() {
        for (together, low, high) in [(false, 5.0, 7.2), (true, 9.0, 60.0)] {
            let mut rng = Pcg32::seed_from_u64(5);
            let (mut alone, mut design, n) = (0.0, 0.0, 150);
            let mut fits = Vec::new();
            for _ in 0..n {
                let (observations, truth) = observations(200, together, &mut rng);
                let fit = fit(&observations, &LENS, &truth).unwrap();
                alone += nees(&fit, &truth, &fit.covariance) / f64::from(n);
                design += fit.design / f64::from(n);
                fits.push((fit, truth));
            }
            assert!((low..high).contains(&alone), "{together}: {alone}");
            let raised = fits.iter().map(|(fit, truth)| {
                nees(fit, truth, &(fit.covariance * design.max(1.0))) / f64::from(n)
            });
            let raised: f64 = raised.sum();
            assert!(
                (4.5..9.0).contains(&raised),
                "{together}: {raised}, {design}"
            );
        }
    }

    #[test]
    fn too_few_observations_and_observations_behind_the_camera_give_none() {
        let (observations, truth) = observations(40, false, &mut Pcg32::seed_from_u64(1));
        assert!(fit(&observations[..5], &LENS, &truth).is_none());
        let about_face = Rigid::exp(DVec3::ZERO, DVec3::Y * std::f64::consts::PI) * truth;
        assert!(fit(&observations, &LENS, &about_face).is_none());
        let one = vec![observations[0]; 30];
        assert!(fit(&one, &LENS, &truth).is_none());
    }
}
