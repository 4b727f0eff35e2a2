//! Batches -> geometry: the model as a stage, and the thread that it runs on live.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::node::backpressure::Backpressure;
use crate::node::threads::{Answer, Niceness, in_own_pool};
use crate::params::params::Params;
use splat_geometry::answer::GeometryBatch;
use splat_geometry::error::GeometryError;
use splat_geometry::model::{DepthTask, GeometryModel};
use splat_geometry::mvs::depth_stream::{SweepJob, SweptDepth};
use splat_io::queue::{Received, Receiver, Sender, WhenFull, queue};
use splat_types::frame::Batch;
use splat_types::time::Stopwatch;

/// Live, while depth is worked on: time between looks at whether a batch has come.
const DEPTH_TICK: Duration = Duration::from_millis(5);

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

    /// Better poses of keyframes that came earlier.
    fn refine(&mut self) -> Option<GeometryBatch> {
        let watch = Stopwatch::start();
        let refined = self.model.refine();
        self.lock().secs += watch.secs();
        refined
    }

    /// Depth of one more keyframe, or the work that it takes.
    fn depth(&mut self) -> Option<DepthTask> {
        let watch = Stopwatch::start();
        let depth = self.model.depth();
        self.lock().secs += watch.secs();
        depth
    }

    /// Depth that another thread has worked out in so many seconds.
    fn take_depth(&mut self, (swept, secs): (SweptDepth, f64)) -> Option<GeometryBatch> {
        let watch = Stopwatch::start();
        let depth = self.model.take_depth(swept);
        self.lock().secs += watch.secs() + secs;
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

/// Poses of a batch as soon as it comes; depth of earlier keyframes is worked out beside it, by a thread of its own.
fn run_live(
    stage: GeometryStage,
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
    let (jobs_tx, jobs) = queue("depth jobs", 1, WhenFull::Wait);
    let (swept_tx, swept) = queue("depth", 1, WhenFull::Wait);
    std::thread::scope(|scope| {
        scope.spawn(move || in_own_pool("depth", Niceness::Depth, || run_depth(&jobs, &swept_tx)));
        let depth = DepthWork {
            jobs: jobs_tx,
            swept,
            is_at_work: false,
        };
        give_poses(stage, depth, batches, answers, backpressure)
    })
}

/// The thread that works out depth, seen from the one of poses.
struct DepthWork {
    jobs: Sender<SweepJob>,
    swept: Receiver<(SweptDepth, f64)>,
    is_at_work: bool,
}

/// Ends when no more jobs come.
fn run_depth(jobs: &Receiver<SweepJob>, swept: &Sender<(SweptDepth, f64)>) {
    while let Some(job) = jobs.recv() {
        let watch = Stopwatch::start();
        let found = job.run();
        if swept.send((found, watch.secs())).is_err() {
            return;
        }
    }
}

fn give_poses(
    mut stage: GeometryStage,
    mut depth: DepthWork,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
    backpressure: &Backpressure,
) -> Option<GeometryError> {
    let mut newest = None;
    loop {
        let geometry = match next(&mut stage, &mut depth, batches) {
            Next::Answer(geometry) => geometry,
            Next::Batch(batch) => {
                let reported = stage.sooner(&batch);
                newest = Some(batch);
                backpressure.note(stage.has_registered);
                backpressure.done();
                match reported {
                    Ok(geometry) => geometry,
                    Err(error) => return Some(error),
                }
            }
            Next::Nothing => continue,
            Next::Ended => return last_answer(stage, answers),
        };
        if answers.send((newest.clone(), geometry)).is_err() {
            return None;
        }
    }
}

/// What geometry does next.
enum Next {
    Batch(Arc<Batch>),
    /// Better poses, or depth, of keyframes that came earlier.
    Answer(GeometryBatch),
    /// Looks again.
    Nothing,
    Ended,
}

/// A batch that has come, else poses that can be improved, else depth that has been worked out, else whatever comes.
fn next(stage: &mut GeometryStage, depth: &mut DepthWork, batches: &Receiver<Arc<Batch>>) -> Next {
    if let Ok(Some(batch)) = batches.try_recv() {
        return Next::Batch(batch);
    }
    if let Some(refined) = stage.refine() {
        let has_changed =
            refined.is_loop || !(refined.views.is_empty() && refined.revised.is_empty());
        return if has_changed {
            Next::Answer(refined)
        } else {
            Next::Nothing
        };
    }
    if depth.is_at_work {
        match depth.swept.recv_timeout(DEPTH_TICK) {
            Received::Item(swept) => {
                depth.is_at_work = false;
                let found = stage.take_depth(swept);
                return found.map_or(Next::Nothing, Next::Answer);
            }
            // Its thread has died: what it had in hand never comes back.
            Received::Ended => return Next::Ended,
            Received::Nothing => return Next::Nothing,
        }
    }
    match stage.depth() {
        Some(DepthTask::Known(known)) => Next::Answer(known),
        Some(DepthTask::Sweep(job)) => {
            depth.is_at_work = depth.jobs.send(*job).is_ok();
            Next::Nothing
        }
        None => batches.recv().map_or(Next::Ended, Next::Batch),
    }
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
