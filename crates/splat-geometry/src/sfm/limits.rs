//! What a match, a start and a place in the scene must pass.

use crate::sfm::params::LocalBaPrior;

/// `SfmParams` in pixels of the working image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) max_error_px: f64,
    pub(crate) min_inliers: usize,
    pub(crate) min_parallax_deg: f64,
    pub(crate) local_ba_prior: LocalBaPrior,
    /// Live: large submaps are adjusted as a whole by another thread (`GlobalAdjustment`).
    pub(crate) is_global_deferred: bool,
    pub(crate) seed: u64,
}
