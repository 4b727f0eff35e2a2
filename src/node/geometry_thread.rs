//! Batches -> geometry: the model as a stage, and the thread that it runs on live.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::node::backpressure::Backpressure;
use crate::node::threads::{Answer, Niceness, in_own_pool};
use crate::params::params::Params;
use splat_geometry::answer::GeometryBatch;
use splat_geometry::error::GeometryError;
use splat_geometry::model::GeometryModel;
use splat_io::queue::{Receiver, Sender};
use splat_types::frame::Batch;
use splat_types::time::Stopwatch;

pub(crate) struct GeometryStage {
    model: Box<dyn GeometryModel>,
    tally: Arc<Mutex<GeometryTally>>,
    /// The map goes on from a saved one, which is found again by depth.
    has_prior: bool,
    has_registered: bool,
}

/// What geometry leaves behind, even where it was given up at a batch.
#[derive(Debug, Clone, Default)]
pub(crate) struct GeometryTally {
    pub(crate) secs: f64,
    pub(crate) note: Option<String>,
}

impl GeometryStage {
    pub(crate) fn new(model: Box<dyn GeometryModel>, params: &Params) -> Self {
        Self {
            model,
            tally: Arc::default(),
            has_prior: !params.map.resume.is_empty(),
            has_registered: false,
        }
    }

    /// For a live run of this model.
    pub(crate) fn backpressure(&self) -> Backpressure {
        Backpressure::new(self.model.accepts_small_batches())
    }

    pub(crate) fn tally(&self) -> Arc<Mutex<GeometryTally>> {
        Arc::clone(&self.tally)
    }

    pub(crate) fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let geometry = self.model.infer(batch);
        self.account(&watch, geometry)
    }

    pub(crate) fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let geometry = self.model.finish();
        self.account(&watch, geometry)
    }

    /// Poses of a batch, whose depth is still to come; all of it where the model knows no poses sooner.
    fn sooner(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let watch = Stopwatch::start();
        let is_found = self.has_registered || !self.has_prior;
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
            self.has_registered |= !geometry.views.is_empty();
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
pub(crate) fn run_geometry(
    mut stage: GeometryStage,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
    backpressure: Option<&Backpressure>,
) -> Option<GeometryError> {
    if let Some(backpressure) = backpressure {
        return in_own_pool("geometry", Niceness::Geometry, || {
            run_live(stage, batches, answers, backpressure)
        });
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
    backpressure: &Backpressure,
) -> Option<GeometryError> {
    /// Selection must not wait for a thread that has ended, however it has.
    struct Ending<'a>(&'a Backpressure);
    impl Drop for Ending<'_> {
        fn drop(&mut self) {
            self.0.end();
        }
    }
    let _ending = Ending(backpressure);
    let mut newest = None;
    loop {
        let next = next_batch(&mut stage, batches);
        let took_batch = matches!(next, Next::Batch(_));
        let geometry = match next {
            Next::Depth(depth) => depth,
            Next::Batch(batch) => {
                let reported = stage.sooner(&batch);
                newest = Some(batch);
                match reported {
                    Ok(geometry) => geometry,
                    Err(error) => return Some(error),
                }
            }
            Next::Ended => return last_answer(stage, answers),
        };
        backpressure.note(stage.has_registered);
        if took_batch {
            backpressure.done();
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
