//! Batches -> geometry: the model as a stage, and the thread that it runs on live.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::node::backpressure::Backpressure;
use crate::node::threads::{Answer, Niceness, in_own_pool};
use crate::params::params::Params;
use splat_geometry::answer::GeometryBatch;
use splat_geometry::error::GeometryError;
use splat_geometry::model::{DepthTask, GeometryModel, Work};
use splat_geometry::mvs::depth_stream::{SweepJob, SweptDepth};
use splat_io::queue::{Ended, Received, Receiver, Sender, WhenFull, queue};
use splat_types::frame::Batch;
use splat_types::time::Stopwatch;

/// Live, while depth is worked on: time between looks at whether a batch has come.
const DEPTH_TICK: Duration = Duration::from_millis(5);
/// Live, while poses are at work: time between looks at whether they are done, and how old a sweep gets before it waits no more.
const POSE_TICK: Duration = Duration::from_millis(2);
const MAX_DEPTH_SECS: f64 = 1.0;
/// Live: poses that came earlier are improved when no keyframe has come for so long: the next one would wait for it.
const QUIET_SECS: f64 = 0.1;

/// Live: all keyframes are adjusted together again after so many times as long as that took, so that it takes one part of five of a
/// processor at most, however large the map is.
const REST_PER_ADJUSTMENT: f64 = 4.0;

pub(crate) struct GeometryStage {
    model: Box<dyn GeometryModel>,
    tally: Arc<Mutex<GeometryTally>>,
    /// The map goes on from a saved one, which is found again by depth.
    has_prior: bool,
    has_registered: bool,
    /// Live: seconds that depth waited for poses.
    waited_secs: f64,
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
            waited_secs: 0.0,
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
        self.timed(|model| model.refine())
    }

    /// The adjustment of all keyframes as work for another thread.
    fn adjustment(&mut self) -> Option<Work> {
        self.timed(|model| model.adjustment())
    }

    /// What that work has found in so many seconds.
    fn take_adjustment(&mut self, secs: f64) -> Option<GeometryBatch> {
        let watch = Stopwatch::start();
        let found = self.model.take_adjustment();
        let own_secs = watch.secs();
        tracing::debug!(
            is_used = found.is_some(),
            "all keyframes adjusted in {secs:.2} s, taken over in {own_secs:.2} s"
        );
        self.lock().secs += own_secs + secs;
        found
    }

    /// Depth of one more keyframe, or the work that it takes.
    fn depth(&mut self) -> Option<DepthTask> {
        self.timed(|model| model.depth())
    }

    /// Depth that another thread has worked out in so many seconds.
    fn take_depth(&mut self, swept: Swept) -> Option<GeometryBatch> {
        self.waited_secs += swept.waited_secs;
        self.lock().secs += swept.secs;
        self.timed(|model| model.take_depth(swept.found))
    }

    /// What the model says, whose time counts as geometry's.
    fn timed<T>(&mut self, ask: impl FnOnce(&mut dyn GeometryModel) -> T) -> T {
        let watch = Stopwatch::start();
        let said = ask(&mut *self.model);
        self.lock().secs += watch.secs();
        said
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
    let (work_tx, work) = queue("adjustments", 1, WhenFull::Wait);
    let (adjusted_tx, adjusted) = queue("adjusted", 1, WhenFull::Wait);
    // Not joined: one of a large map takes seconds, and at the end of a run nothing waits for it.
    let adjust = move || {
        let work = || run_adjustment(&work, &adjusted_tx);
        in_own_pool("adjust", Niceness::Adjustment, work);
    };
    if let Err(e) = std::thread::Builder::new()
        .name("adjust".to_owned())
        .spawn(adjust)
    {
        tracing::warn!("keyframes are not adjusted together before the end: no thread for it: {e}");
    }
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let work = || run_depth(&jobs, &swept_tx, backpressure);
            in_own_pool("depth", Niceness::Depth, work);
        });
        let beside = Beside {
            depth: Worker::new(jobs_tx, swept),
            adjustment: Worker::new(work_tx, adjusted),
            adjusted: None,
        };
        give_poses(stage, beside, batches, answers, backpressure)
    })
}

/// A thread that works for the one of poses, seen from there: one job at a time.
struct Worker<Job, Done> {
    jobs: Sender<Job>,
    done: Receiver<Done>,
    is_at_work: bool,
}

impl<Job, Done> Worker<Job, Done> {
    fn new(jobs: Sender<Job>, done: Receiver<Done>) -> Self {
        Self {
            jobs,
            done,
            is_at_work: false,
        }
    }

    fn begin(&mut self, job: Job) {
        self.is_at_work = self.jobs.send(job).is_ok();
    }

    /// What it has done, if it has; an error once the thread has died: what it had in hand never comes back.
    fn take(&mut self) -> Result<Option<Done>, Ended> {
        let done = self.done.try_recv()?;
        self.is_at_work &= done.is_none();
        Ok(done)
    }
}

/// Depth that was worked out, the seconds that it took, and those among them that it waited for poses.
struct Swept {
    found: SweptDepth,
    secs: f64,
    waited_secs: f64,
}

/// What goes on beside poses.
struct Beside {
    depth: Worker<SweepJob, Swept>,
    adjustment: Worker<Work, f64>,
    /// Since when the last adjustment is done, and how many seconds it took.
    adjusted: Option<(Stopwatch, f64)>,
}

/// Ends when no more work comes.
fn run_adjustment(work: &Receiver<Work>, adjusted: &Sender<f64>) {
    while let Some(work) = work.recv() {
        let watch = Stopwatch::start();
        work();
        if adjusted.send(watch.secs()).is_err() {
            return;
        }
    }
}

/// Ends when no more jobs come. Depth waits while poses are at work: beside it, they would take half as long again on few cores.
fn run_depth(jobs: &Receiver<SweepJob>, swept: &Sender<Swept>, backpressure: &Backpressure) {
    while let Some(job) = jobs.recv() {
        let watch = Stopwatch::start();
        let waited = AtomicU64::new(0);
        let give_way = || {
            let waiting = Stopwatch::start();
            while backpressure.is_at_work() && watch.secs() < MAX_DEPTH_SECS {
                std::thread::sleep(POSE_TICK);
            }
            waited.fetch_add((waiting.secs() * 1e6) as u64, Ordering::Relaxed);
        };
        let found = job.run_giving_way(&give_way);
        let done = Swept {
            found,
            secs: watch.secs(),
            waited_secs: waited.into_inner() as f64 * 1e-6,
        };
        if swept.send(done).is_err() {
            return;
        }
    }
}

fn give_poses(
    mut stage: GeometryStage,
    mut beside: Beside,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
    backpressure: &Backpressure,
) -> Option<GeometryError> {
    let mut newest = None;
    let mut since_batch = Stopwatch::start();
    loop {
        let is_quiet = since_batch.secs() > QUIET_SECS;
        let mut geometry = match next(&mut stage, &mut beside, batches, is_quiet) {
            Next::Answer(geometry) => geometry,
            Next::Batch(batch) => {
                let reported = stage.sooner(&batch);
                since_batch = Stopwatch::start();
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
        geometry.load_shed.depth_secs = stage.waited_secs;
        backpressure.answer();
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

/// A batch that has come, else what other threads have worked out, else poses that can be improved while it is quiet, else whatever
/// comes. Work for the other threads is handed out on the way.
fn next(
    stage: &mut GeometryStage,
    beside: &mut Beside,
    batches: &Receiver<Arc<Batch>>,
    is_quiet: bool,
) -> Next {
    if let Ok(Some(batch)) = batches.try_recv() {
        return Next::Batch(batch);
    }
    match beside.next(stage) {
        Next::Nothing => {}
        other => return other,
    }
    if let Some(refined) = is_quiet.then(|| stage.refine()).flatten() {
        let is_empty = refined.views.is_empty() && refined.revised.is_empty();
        return if is_empty && !refined.is_loop {
            Next::Nothing
        } else {
            Next::Answer(refined)
        };
    }
    if is_quiet && !beside.is_at_work() && beside.may_adjust() {
        return batches.recv().map_or(Next::Ended, Next::Batch);
    }
    match batches.recv_timeout(DEPTH_TICK) {
        Received::Item(batch) => Next::Batch(batch),
        // Depth that is begun is worth waiting for; all keyframes are adjusted together once more in any case.
        Received::Ended if beside.depth.is_at_work => {
            std::thread::sleep(DEPTH_TICK);
            Next::Nothing
        }
        Received::Ended => Next::Ended,
        Received::Nothing => Next::Nothing,
    }
}

impl Beside {
    fn is_at_work(&self) -> bool {
        self.depth.is_at_work || self.adjustment.is_at_work
    }

    /// What a thread has found; otherwise gives those work that have none.
    fn next(&mut self, stage: &mut GeometryStage) -> Next {
        if self.adjustment.is_at_work {
            match self.adjustment.take() {
                Ok(Some(secs)) => {
                    self.adjusted = Some((Stopwatch::start(), secs));
                    if let Some(found) = stage.take_adjustment(secs) {
                        return Next::Answer(found);
                    }
                }
                Ok(None) => {}
                Err(Ended) => return Next::Ended,
            }
        } else if self.may_adjust()
            && let Some(work) = stage.adjustment()
        {
            self.adjustment.begin(work);
        }
        if self.depth.is_at_work {
            return match self.depth.take() {
                Ok(swept) => {
                    let found = swept.and_then(|swept| stage.take_depth(swept));
                    found.map_or(Next::Nothing, Next::Answer)
                }
                Err(Ended) => Next::Ended,
            };
        }
        match stage.depth() {
            Some(DepthTask::Known(known)) => return Next::Answer(known),
            Some(DepthTask::Sweep(job)) => self.depth.begin(*job),
            None => {}
        }
        Next::Nothing
    }

    fn may_adjust(&self) -> bool {
        self.adjusted
            .is_none_or(|(since, secs)| since.secs() >= REST_PER_ADJUSTMENT * secs)
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
