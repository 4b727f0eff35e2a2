//! Frames -> batches of keyframes: a struct that frames are pushed into, and knows no threads.

use std::sync::Arc;

use crate::params::params::Params;
use splat_ros::output::OutputHandles;
use splat_ros::reports::Reports;
use splat_ros::status::SelectStatus;
use splat_slam::select::selector::{Batcher, Selector};
use splat_types::frame::{Batch, Frame};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Stamps beyond this many are not kept for trajectory.tum: two weeks at 30 Hz would be 290 MB.
const MAX_STAMPS: usize = 10_000_000;

/// Frames -> batches.
#[derive(Debug)]
pub(crate) struct SelectStage {
    selector: Selector,
    batcher: Batcher,
    reports: Option<Arc<Reports>>,
    pub(crate) n_selected: usize,
    pub(crate) frame_stamps: Vec<Stamp>,
    pub(crate) truth: Vec<(Stamp, Rigid)>,
}

impl SelectStage {
    pub(crate) fn new(params: &Params, first_id: u32, output: Option<&OutputHandles>) -> Self {
        Self {
            selector: Selector::new(params.select.clone()).counting_from(first_id),
            batcher: Batcher::new(&params.select),
            reports: output.map(|output| Arc::clone(&output.reports)),
            n_selected: 0,
            frame_stamps: Vec::new(),
            truth: Vec::new(),
        }
    }

    /// Of a source of so many photos; `None` for the frames of a camera.
    pub(crate) fn of_photos(mut self, n_photos: Option<u64>) -> Self {
        self.selector = self.selector.of_photos(n_photos);
        self
    }

    pub(crate) fn push(&mut self, frame: Frame) -> Option<Batch> {
        if self.frame_stamps.len() < MAX_STAMPS {
            self.frame_stamps.push(frame.stamp);
        }
        let keyframe = self.selector.push(frame)?;
        self.n_selected += 1;
        let n_keyframes = self.n_selected as u64;
        self.report(|status| status.n_keyframes = n_keyframes);
        if let Some(truth) = keyframe.frame.truth {
            self.truth.push((keyframe.frame.stamp, truth));
        }
        self.batcher.push(keyframe)
    }

    /// Changes selection's part of the status; nothing where no status goes out.
    pub(crate) fn report(&self, change: impl FnOnce(&mut SelectStatus)) {
        if let Some(reports) = &self.reports {
            reports.select.update(change);
        }
    }

    /// Keyframes that were in no batch so far.
    pub(crate) fn n_new(&self) -> usize {
        self.batcher.n_new()
    }

    /// A batch that is not full; `None` when every keyframe has been in one.
    pub(crate) fn finish(&mut self) -> Option<Batch> {
        self.batcher.finish()
    }
}
