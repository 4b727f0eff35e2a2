//! How far off a pose may be, as robots exchange it.

/// Covariance of a pose: translation along the camera's x, y, z (in the unit of the poses), then rotation about these axes
/// (rad). Row by row.
pub type Covariance = [[f64; 6]; 6];
