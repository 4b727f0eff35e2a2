//! Points or poses of the same things in two frames -> the similarity between the frames.

use glam::{DMat3, DQuat, DVec3, DVec4};
use nalgebra::{Matrix3, RowVector3, Vector3};

use splat_types::transform::{Rigid, Similarity};

/// Camera centres closer together than this share of their distance to the scene say nothing about scale.
const MIN_SPREAD: f64 = 1e-6;
/// A smaller scale is that of points that have all but fallen together.
const MIN_SCALE: f64 = 1e-6;
/// Where the decomposition of the covariance ends: some roundings of f64, and for weights that are found anew in rounds.
const PRECISION: f64 = 5.0 * f64::EPSILON;
const ROUND_PRECISION: f64 = 1e-12;
/// It takes a dozen; without an end, numbers that are none would never come to one.
const MAX_ROUNDS: usize = 200;

/// `target_from_source` of (target, source) pairs by least squares (Umeyama 1991). `None` of fewer than three, and of
/// points that have all but fallen together.
pub fn of_points(pairs: &[(DVec3, DVec3)]) -> Option<Similarity> {
    let n = pairs.len() as f64;
    if pairs.len() < 3 {
        return None;
    }
    let target_mean = pairs.iter().map(|p| p.0).sum::<DVec3>() / n;
    let source_mean = pairs.iter().map(|p| p.1).sum::<DVec3>() / n;
    let mut moments = Moments::around(target_mean, source_mean);
    for (t, s) in pairs {
        let (t, s) = (*t - target_mean, *s - source_mean);
        moments.covariance += column(t) * row(s) / n;
        moments.variance += s.length_squared() / n;
    }
    let found = moments.similarity(PRECISION)?;
    (found.scale > MIN_SCALE).then_some(found)
}

/// As `of_points`, with the last digits also where the points nearly lie on a line: there the decomposition leaves the
/// rotation about the line off by some 1e-5 rad. Newton steps on the same least squares: at the minimum `Rᵀ C` is
/// symmetric, for C the covariance of target by source.
pub fn of_points_refined(pairs: &[(DVec3, DVec3)]) -> Option<Similarity> {
    const N_STEPS: usize = 3;
    let mut found = of_points(pairs)?;
    let n = pairs.len() as f64;
    let target_mean = pairs.iter().map(|p| p.0).sum::<DVec3>() / n;
    let source_mean = pairs.iter().map(|p| p.1).sum::<DVec3>() / n;
    for _ in 0..=N_STEPS {
        // Of target, turned back, by source.
        let mut m = Matrix3::<f64>::zeros();
        let mut variance = 0.0;
        for (t, s) in pairs {
            let t = found.rotation.inverse() * (*t - target_mean);
            let s = *s - source_mean;
            m += column(t) * row(s);
            variance += s.length_squared();
        }
        let asymmetry = Vector3::new(
            m[(2, 1)] - m[(1, 2)],
            m[(0, 2)] - m[(2, 0)],
            m[(1, 0)] - m[(0, 1)],
        );
        let curvature = Matrix3::from_diagonal_element(m.trace()) - (m + m.transpose()) * 0.5;
        let Some(turn) = curvature.lu().solve(&asymmetry) else {
            return Some(found);
        };
        found.rotation = (found.rotation
            * DQuat::from_scaled_axis(DVec3::new(turn.x, turn.y, turn.z)))
        .normalize();
        found.scale = m.trace() / variance;
        found.translation = target_mean - found.rotation * source_mean * found.scale;
    }
    Some(found)
}

/// The same as `of_points` with a weight for each pair.
pub fn of_weighted_points(
    pairs: impl Iterator<Item = (DVec3, DVec3)> + Clone,
    weights: &[f64],
) -> Option<Similarity> {
    let total: f64 = weights.iter().sum();
    let weighted = pairs.zip(weights);
    let target_mean = weighted.clone().map(|(p, w)| p.0 * *w).sum::<DVec3>() / total;
    let source_mean = weighted.clone().map(|(p, w)| p.1 * *w).sum::<DVec3>() / total;
    let mut moments = Moments::around(target_mean, source_mean);
    for ((t, s), w) in weighted {
        let (t, s) = (t - target_mean, s - source_mean);
        moments.covariance += column(t) * row(s) * *w;
        moments.variance += w * s.length_squared();
    }
    moments.similarity(ROUND_PRECISION)
}

/// `target_from_source` from pairs (target_from_cam, source_from_cam) of the same cameras; `None` without pairs.
/// Rotation is the mean relative rotation, scale the ratio of the spreads of the centres (1 for a single place), so that a
/// straight drive (collinear centres) is no special case.
pub fn of_poses(pairs: &[(Rigid, Rigid)]) -> Option<Similarity> {
    let relative =
        |(target, source): &(Rigid, Rigid)| target.rotation * source.rotation.conjugate();
    let first = relative(pairs.first()?);
    let rotation = mean_rotation(pairs.iter().map(relative)).unwrap_or(first);
    let n = pairs.len() as f64;
    let target_mean = pairs.iter().map(|p| p.0.translation).sum::<DVec3>() / n;
    let source_mean = pairs.iter().map(|p| p.1.translation).sum::<DVec3>() / n;
    let spread = |points: &mut dyn Iterator<Item = DVec3>| {
        points.map(|d| d.length_squared()).sum::<f64>().sqrt()
    };
    let target_spread = spread(&mut pairs.iter().map(|p| p.0.translation - target_mean));
    let source_spread = spread(&mut pairs.iter().map(|p| p.1.translation - source_mean));
    let scale = if source_spread > MIN_SPREAD && target_spread > MIN_SPREAD {
        target_spread / source_spread
    } else {
        1.0
    };
    Some(Similarity {
        scale,
        rotation,
        translation: target_mean - rotation * source_mean * scale,
    })
}

/// Mean of rotations that lie close together: the sum of the quaternions of one hemisphere (Markley 2007 for small
/// spread). `None` where they cancel out, or there are none.
pub fn mean_rotation(rotations: impl Iterator<Item = DQuat>) -> Option<DQuat> {
    let mut first = None;
    let mut sum = DVec4::ZERO;
    for rotation in rotations {
        let first = *first.get_or_insert(rotation);
        let sign = if rotation.dot(first) < 0.0 { -1.0 } else { 1.0 };
        sum += DVec4::from(rotation) * sign;
    }
    let sum = DQuat::from_vec4(sum);
    (sum.length_squared() > 1e-12).then(|| sum.normalize())
}

/// What least squares has to know of pairs of points.
struct Moments {
    target_mean: DVec3,
    source_mean: DVec3,
    /// Of target by source.
    covariance: Matrix3<f64>,
    /// Of the source.
    variance: f64,
}

impl Moments {
    fn around(target_mean: DVec3, source_mean: DVec3) -> Self {
        Self {
            target_mean,
            source_mean,
            covariance: Matrix3::zeros(),
            variance: 0.0,
        }
    }

    /// Umeyama's equations 40 to 43.
    fn similarity(&self, precision: f64) -> Option<Similarity> {
        let svd = self.covariance.try_svd(true, true, precision, MAX_ROUNDS)?;
        let (u, v_t) = (svd.u?, svd.v_t?);
        let mut signs = Vector3::new(1.0, 1.0, 1.0);
        if u.determinant() * v_t.determinant() < 0.0 {
            signs[svd.singular_values.argmin().0] = -1.0;
        }
        let turn = u * Matrix3::from_diagonal(&signs) * v_t;
        let scale = svd.singular_values.dot(&signs) / self.variance;
        let rotation = DQuat::from_mat3(&DMat3::from_cols_slice(turn.as_slice())).normalize();
        let is_sound = scale.is_finite() && scale > 0.0 && rotation.is_finite();
        is_sound.then(|| Similarity {
            scale,
            rotation,
            translation: self.target_mean - rotation * self.source_mean * scale,
        })
    }
}

fn column(v: DVec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

fn row(v: DVec3) -> RowVector3<f64> {
    RowVector3::new(v.x, v.y, v.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(i: f64) -> Rigid {
        Rigid::exp(
            DVec3::new(i, 0.3 * i * i, -0.2 * i),
            DVec3::new(0.1 * i, -0.05, 0.2),
        )
    }

    fn truth() -> Similarity {
        Similarity {
            scale: 2.5,
            rotation: DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 0.7)),
            translation: DVec3::new(1.0, -2.0, 3.0),
        }
    }

    fn check(found: Option<Similarity>) {
        let (found, truth) = (found.unwrap(), truth());
        assert!((found.scale - truth.scale).abs() < 1e-12);
        assert!(found.rotation.angle_between(truth.rotation) < 1e-7);
        assert!((found.translation - truth.translation).length() < 1e-10);
    }

    #[test]
    fn a_similarity_is_found_again_from_poses_and_from_points() {
        let poses: Vec<_> = (0..5)
            .map(|i| pose(f64::from(i)))
            .map(|p| (truth().transform_pose(&p), p))
            .collect();
        check(of_poses(&poses));
        let mut points: Vec<_> = poses
            .iter()
            .map(|p| (p.0.translation, p.1.translation))
            .collect();
        check(of_points(&points));
        check(of_weighted_points(points.iter().copied(), &[2.0; 5]));
        points[3].0 += DVec3::ONE;
        let weights = [1.0, 3.0, 0.5, 0.0, 2.0];
        check(of_weighted_points(points.iter().copied(), &weights));
    }

    #[test]
    fn mirrored_points_give_a_rotation_all_the_same() {
        let pairs: Vec<_> = (0..6)
            .map(|i| pose(f64::from(i)).translation + DVec3::new(0.0, 0.0, f64::from(i % 3)))
            .map(|p| (p * DVec3::new(-1.0, 1.0, 1.0), p))
            .collect();
        let found = of_points(&pairs).unwrap();
        assert!(found.rotation.is_normalized() && found.scale > 0.0);
    }

    #[test]
    fn points_without_extent_and_numbers_that_are_none_give_nothing() {
        let at = |x: f64| DVec3::new(x, 2.0, 3.0);
        assert!(of_points(&[(at(1.0), at(1.0)); 3]).is_none());
        assert!(of_points(&[(at(0.0), at(0.0)), (at(1.0), at(1.0))]).is_none());
        assert!(
            of_points(&[
                (at(f64::NAN), at(0.0)),
                (at(1.0), at(1.0)),
                (at(2.0), at(3.0))
            ])
            .is_none()
        );
    }

    #[test]
    fn a_undistorted_drive_and_a_single_pose_are_no_special_cases() {
        let truth = Similarity {
            scale: 3.0,
            ..Similarity::IDENTITY
        };
        let line: Vec<_> = (0..4)
            .map(|i| Rigid::new(DQuat::IDENTITY, DVec3::Z * f64::from(i)))
            .collect();
        let pairs: Vec<_> = line.iter().map(|p| (truth.transform_pose(p), *p)).collect();
        assert!((of_poses(&pairs).unwrap().scale - 3.0).abs() < 1e-12);
        assert_eq!(of_poses(&pairs[..1]).unwrap().scale, 1.0);
        assert!(of_poses(&[]).is_none());
    }
}
