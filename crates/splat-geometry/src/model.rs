//! What every way of estimating geometry offers: batches of keyframes in, answers out.

use crate::answer::GeometryBatch;
use crate::error::GeometryError;
use crate::mvs::depth_stream::{SweepJob, SweptDepth};
use splat_types::frame::Batch;

/// Depth of a keyframe.
#[derive(Debug)]
pub enum DepthTask {
    Known(GeometryBatch),
    /// Long work for another thread, so that poses need not wait for it; then `take_depth`.
    Sweep(Box<SweepJob>),
}

/// Work for another thread, whose outcome the model keeps for itself.
pub type Work = Box<dyn FnOnce() + Send>;

/// Estimates cameras and depth. One thread owns it; calls come in order of batches.
pub trait GeometryModel: Send {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError>;

    /// Called once after the last batch: whatever can still be registered or improved.
    fn finish(&mut self) -> Result<GeometryBatch, GeometryError>;

    /// Live, instead of `infer`: poses of a batch without depth, where they are known long before it is.
    fn poses(&mut self, _batch: &Batch) -> Option<GeometryBatch> {
        None
    }

    /// Live, while no batch waits: poses that are better by what `poses` left for later; `None` where nothing was left.
    fn refine(&mut self) -> Option<GeometryBatch> {
        None
    }

    /// Live: better poses of all keyframes as long work for another thread; `take_adjustment` when it has run. `None` while there is
    /// no need.
    fn adjustment(&mut self) -> Option<Work> {
        None
    }

    /// What the work that `adjustment` handed out has found, for the keyframes of before and of since.
    fn take_adjustment(&mut self) -> Option<GeometryBatch> {
        None
    }

    /// Depth of one keyframe whose pose `poses` reported; `None` when it is known of all, or is being worked on.
    fn depth(&mut self) -> Option<DepthTask> {
        None
    }

    /// What the work that `depth` handed out has found.
    fn take_depth(&mut self, _swept: SweptDepth) -> Option<GeometryBatch> {
        None
    }

    /// Whether depth and poses have one scale, view by view: depth that comes of matching the views by their poses.
    fn has_depth_of_poses(&self) -> bool {
        false
    }

    /// Whether it answers a batch of one new keyframe as well as a full one, once it has registered some.
    fn accepts_small_batches(&self) -> bool {
        false
    }
}
