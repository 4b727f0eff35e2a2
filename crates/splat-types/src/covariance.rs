//! How far off a pose may be, as robots exchange it.

/// Covariance of a pose: translation along the camera's x, y, z (in the unit of the poses), then rotation about these axes
/// (rad). Row by row.
pub type Covariance = [[f64; 6]; 6];

/// Standard deviations along and about the least certain axes: (the unit of the poses, radians).
pub fn worst_std(covariance: &Covariance) -> (f64, f64) {
    let worst = |axes: std::ops::Range<usize>| {
        let variances = axes.map(|i| covariance[i][i]);
        variances.fold(0.0, f64::max).sqrt()
    };
    (worst(0..3), worst(3..6))
}
