//! Batches -> geometry: the model as a stage, and the thread that it runs on live.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::clock::Stopwatch;
use crate::config::Params;
use crate::frame::Batch;
use crate::geometry::{GeometryBatch, GeometryError, GeometryModel};
use crate::node::pace::Pace;
use crate::node::threads::{Answer, in_own_pool};
use crate::queue::{Receiver, Sender};

pub(super) struct GeometryStage {
    model: Box<dyn GeometryModel>,
    tally: Arc<Mutex<GeometryTally>>,
    /// The map goes on from a saved one, which is found again by depth.
    has_past: bool,
    has_placed: bool,
}

/// What geometry leaves behind, even where it was given up at a batch.
#[derive(Debug, Clone, Default)]
pub(super) struct GeometryTally {
    pub(super) secs: f64,
    pub(super) note: Option<String>,
}

impl GeometryStage {
    pub(super) fn new(model: Box<dyn GeometryModel>, params: &Params) -> Self {
        Self {
            model,
            tally: Arc::default(),
            has_past: !params.map.load.is_empty(),
            has_placed: false,
        }
    }

    /// For a live run of this model.
    pub(super) fn pace(&self) -> Pace {
        Pace::new(self.model.takes_small_batches())
    }

    pub(super) fn tally(&self) -> Arc<Mutex<GeometryTally>> {
        Arc::clone(&self.tally)
    }

    pub(super) fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let geometry = self.model.infer(batch);
        self.account(&watch, geometry)
    }

    pub(super) fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let geometry = self.model.finish();
        self.account(&watch, geometry)
    }

    /// Poses of a batch, whose depth is still to come; all of it where the model knows no poses sooner.
    fn sooner(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let is_found = self.has_placed || !self.has_past;
        match is_found.then(|| self.model.poses(batch)).flatten() {
            Some(poses) => self.account(&watch, Ok(poses)),
            None => self.infer(batch),
        }
    }

    /// Depth of one more keyframe.
    fn depth(&mut self) -> Option<GeometryBatch> {
        let watch = Stopwatch::start();
        let depth = self.model.depth();
        self.lock().secs += watch.secs();
        depth
    }

    fn lock(&self) -> MutexGuard<'_, GeometryTally> {
        self.tally.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn account(
        &mut self,
        watch: &Stopwatch,
        geometry: Result<GeometryBatch, GeometryError>,
    ) -> Result<GeometryBatch, GeometryError> {
        let geometry = geometry.inspect(|geometry| {
            self.has_placed |= !geometry.views.is_empty();
            let note = geometry.note.as_ref();
            tracing::info!(
                "batch {}: {} views, {} revised{}",
                geometry.batch_id,
                geometry.views.len(),
                geometry.revised.len(),
                note.map(|n| format!(", {n}")).unwrap_or_default()
            );
        });
        let mut tally = self.lock();
        tally.secs += watch.secs();
        if let Ok(GeometryBatch {
            note: Some(note), ..
        }) = &geometry
        {
            tally.note = Some(note.clone());
        }
        drop(tally);
        geometry
    }
}

/// Live where there is a pace.
pub(super) fn run_geometry(
    mut stage: GeometryStage,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
    pace: Option<&Pace>,
) -> Option<GeometryError> {
    if let Some(pace) = pace {
        return in_own_pool(|| run_live(stage, batches, answers, pace));
    }
    while let Some(batch) = batches.recv() {
        match stage.infer(&batch) {
            Ok(geometry) => {
                if answers.send((Some(batch), geometry)).is_err() {
                    return None;
                }
            }
            Err(error) => return Some(error),
        }
    }
    last_answer(stage, answers)
}

/// Poses of a batch before the depth of earlier ones.
fn run_live(
    mut stage: GeometryStage,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
    pace: &Pace,
) -> Option<GeometryError> {
    /// Selection must not wait for a thread that has ended, however it has.
    struct Ending<'a>(&'a Pace);
    impl Drop for Ending<'_> {
        fn drop(&mut self) {
            self.0.end();
        }
    }
    let _ending = Ending(pace);
    let mut newest = None;
    loop {
        let next = next_batch(&mut stage, batches);
        let took_batch = matches!(next, Next::Batch(_));
        let geometry = match next {
            Next::Depth(depth) => depth,
            Next::Batch(batch) => {
                let told = stage.sooner(&batch);
                newest = Some(batch);
                match told {
                    Ok(geometry) => geometry,
                    Err(error) => return Some(error),
                }
            }
            Next::Ended => return last_answer(stage, answers),
        };
        let n_without_depth = stage.model.n_without_depth();
        pace.note(stage.has_placed, n_without_depth);
        if took_batch {
            pace.done();
        }
        if answers.send((newest.clone(), geometry)).is_err() {
            return None;
        }
    }
}

/// What geometry does next.
enum Next {
    Batch(Arc<Batch>),
    Depth(GeometryBatch),
    Ended,
}

/// A batch that has come, else depth that is outstanding, else whatever comes.
fn next_batch(stage: &mut GeometryStage, batches: &Receiver<Arc<Batch>>) -> Next {
    if let Ok(Some(batch)) = batches.try_recv() {
        return Next::Batch(batch);
    }
    let depth = stage.depth().map(Next::Depth);
    depth.unwrap_or_else(|| batches.recv().map_or(Next::Ended, Next::Batch))
}

fn last_answer(mut stage: GeometryStage, answers: &Sender<Answer>) -> Option<GeometryError> {
    match stage.finish() {
        Ok(geometry) => {
            drop(answers.send((None, geometry)));
            None
        }
        Err(error) => Some(error),
    }
}
