//! What every way of estimating geometry offers: batches of keyframes in, answers out.

use crate::answer::GeometryBatch;
use crate::error::GeometryError;
use splat_types::frame::Batch;

/// Estimates cameras and depth. One thread owns it; calls come in order of batches.
pub trait GeometryModel: Send {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError>;

    /// Called once after the last batch: whatever can still be registered or improved.
    fn finish(&mut self) -> Result<GeometryBatch, GeometryError>;

    /// Live, instead of `infer`: poses of a batch without depth, where they are known long before it is.
    fn poses(&mut self, _batch: &Batch) -> Option<GeometryBatch> {
        None
    }

    /// Depth of one keyframe whose pose `poses` reported; `None` when it is known of all.
    fn depth(&mut self) -> Option<GeometryBatch> {
        None
    }

    /// Whether it answers a batch of one new keyframe as well as a full one, once it has registered some.
    fn accepts_small_batches(&self) -> bool {
        false
    }
}
