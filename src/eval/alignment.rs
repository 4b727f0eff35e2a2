//! Two lists of poses of the same cameras in different frames -> the similarity between the frames.
//!
//! Knows nothing of time or files: pose i of one list belongs to pose i of the other.

use glam::{DQuat, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};

use splat_geometry::similarity;
use splat_types::transform::{Rigid, Similarity};

/// Spread across a path over spread along it, below which the positions are a line and say nothing of the roll
/// about it. A car that drives straight for 60 m and wanders 30 cm is at 1e-2.
const LINE_RATIO: f64 = 1e-3;

/// The same, up to which a path may be too near to a line for its own errors: they then turn the roll.
const NEAR_LINE_RATIO: f64 = 0.05;

/// A turn about the line by which the errors of the positions may have rolled the path, from which on it is reported.
const LOOSE_ROLL_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// Spread over distance from the origin below which all positions are one: rounding of the coordinates.
const POINT_RATIO: f64 = 1e-12;

#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    pub reference_from_estimate: Similarity,
    /// The positions lie on a line, so the orientations had to say how the path is rolled about it.
    pub is_line: bool,
    /// The positions are no line, but so near to one that they hardly say how the path is rolled about it.
    pub loose_roll: Option<LooseRoll>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct LooseRoll {
    /// RMS distances to the middle of the path, along the line and across it, in units of the reference.
    pub along: f64,
    pub across: f64,
    /// Turn about the line that errors of the size of those that are left can make up.
    pub std_rad: f64,
    /// The alignment with the roll that the orientations ask for.
    pub by_orientations: Similarity,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AlignError {
    #[error("{found} poses in common, a similarity needs at least 3")]
    TooFew { found: usize },
    #[error("the positions of the {of} are all one point, so scale and orientation are unknown")]
    Point { of: &'static str },
}

/// Least squares over the positions (Umeyama 1991). Where they lie on a line the roll about it comes from the orientations.
pub fn align(estimate: &[Rigid], reference: &[Rigid]) -> Result<Alignment, AlignError> {
    assert_eq!(estimate.len(), reference.len(), "poses come in pairs");
    if estimate.len() < 3 {
        return Err(AlignError::TooFew {
            found: estimate.len(),
        });
    }
    let positions = |poses: &[Rigid]| {
        poses
            .iter()
            .map(|pose| pose.translation)
            .collect::<Vec<_>>()
    };
    let (source, target) = (positions(estimate), positions(reference));
    let source_line = principal_axis(&source).ok_or(AlignError::Point { of: "run" })?;
    let target_line = principal_axis(&target).ok_or(AlignError::Point { of: "reference" })?;
    let pairs: Vec<(DVec3, DVec3)> = target.iter().copied().zip(source.iter().copied()).collect();
    let similarity =
        similarity::of_points_refined(&pairs).ok_or(AlignError::Point { of: "run" })?;

    let is_line = source_line.ratio.min(target_line.ratio) < LINE_RATIO;
    // The list that is nearer to a line names the axis; seen from the reference.
    let axis = if target_line.ratio <= source_line.ratio {
        target_line.axis
    } else {
        similarity.rotation * source_line.axis
    };
    let rolled = || {
        let roll = roll_about(axis, &similarity, estimate, reference);
        let rotation = (roll * similarity.rotation).normalize();
        let scale = similarity.scale;
        Similarity {
            scale,
            rotation,
            translation: mean(&target) - rotation * mean(&source) * scale,
        }
    };
    if is_line {
        return Ok(Alignment {
            reference_from_estimate: rolled(),
            is_line,
            loose_roll: None,
        });
    }
    let across = target_line.ratio * target_line.spread;
    let errors = source.iter().zip(&target);
    let square: f64 = errors
        .map(|(s, t)| similarity.transform_point(*s).distance_squared(*t))
        .sum();
    let std_rad = (square / source.len() as f64).sqrt() / across;
    let is_loose = target_line.ratio < NEAR_LINE_RATIO && std_rad > LOOSE_ROLL_RAD;
    Ok(Alignment {
        reference_from_estimate: similarity,
        is_line,
        loose_roll: is_loose.then(|| LooseRoll {
            along: target_line.spread,
            across,
            std_rad,
            by_orientations: rolled(),
        }),
    })
}

/// The turn about `axis` after which the orientations agree best: the twist part of the residual rotations,
/// averaged as quaternions (the largest eigenvector of a 2x2 matrix, so the sign of each quaternion is of no matter).
fn roll_about(
    axis: DVec3,
    similarity: &Similarity,
    estimate: &[Rigid],
    reference: &[Rigid],
) -> DQuat {
    let (mut ww, mut wv, mut vv) = (0.0, 0.0, 0.0);
    for (e, r) in estimate.iter().zip(reference) {
        let residual = r.rotation * (similarity.rotation * e.rotation).conjugate();
        let (w, v) = (
            residual.w,
            DVec3::new(residual.x, residual.y, residual.z).dot(axis),
        );
        ww += w * w;
        wv += w * v;
        vv += v * v;
    }
    let half_angle = 0.5 * (2.0 * wv).atan2(ww - vv);
    DQuat::from_axis_angle(axis, 2.0 * half_angle)
}

struct Axis {
    axis: DVec3,
    /// Second largest spread over the largest: 0 on a line, 1 in a disc or ball.
    ratio: f64,
    /// The largest.
    spread: f64,
}

/// Direction of the largest spread; `None` when there is none.
fn principal_axis(points: &[DVec3]) -> Option<Axis> {
    let centre = mean(points);
    let mut covariance = Matrix3::zeros();
    for point in points {
        let v = nalgebra::Vector3::from((*point - centre).to_array());
        covariance += v * v.transpose();
    }
    let eigen = SymmetricEigen::new(covariance / points.len() as f64);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let spread = |ix: usize| eigen.eigenvalues[order[ix]].max(0.0).sqrt();
    if spread(0) <= POINT_RATIO * centre.length().max(f64::MIN_POSITIVE) {
        return None;
    }
    let v = eigen.eigenvectors.column(order[0]);
    Some(Axis {
        axis: DVec3::new(v[0], v[1], v[2]).normalize(),
        ratio: spread(1) / spread(0),
        spread: spread(0),
    })
}

fn mean(points: &[DVec3]) -> DVec3 {
    points.iter().sum::<DVec3>() / points.len().max(1) as f64
}
