//! What the threads of the source, of selection and of geometry do until their input ends.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;

use crate::machine::priority;
use crate::node::backpressure::Backpressure;
use crate::node::select_stage::SelectStage;
use crate::node::source_thread::SourceStage;
use crate::node::track_thread::{TrackerInput, report};
use splat_geometry::answer::GeometryBatch;
use splat_io::queue::{Received, Receiver, Sender};
use splat_types::frame::{Batch, Frame};

/// Live, while no frame comes: time between looks at whether geometry stands idle.
const LIVE_TICK: Duration = Duration::from_millis(10);
/// Live: full batches that wait for geometry, about 8 MB each with the default size. Of more, the oldest goes.
const MAX_BATCHES_WAITING: usize = 12;

/// What crosses from geometry to the map; no batch at the model's end.
pub(crate) type Answer = (Option<Arc<Batch>>, GeometryBatch);

pub(crate) fn run_source(
    mut stage: SourceStage,
    frames: &Sender<Frame>,
    received: Option<&Sender<TrackerInput>>,
) -> (SourceStage, u64) {
    while let Some(frame) = stage.next() {
        report(received, &frame);
        if frames.send(frame).is_err() {
            break;
        }
    }
    (stage, frames.dropped())
}

/// Live where there is a pace.
pub(crate) fn run_select(
    mut stage: SelectStage,
    frames: &Receiver<Frame>,
    batches: &Sender<Arc<Batch>>,
    received: Option<&Sender<TrackerInput>>,
    backpressure: Option<&Backpressure>,
) -> SelectStage {
    if let Some(backpressure) = backpressure {
        return run_select_live(stage, frames, batches, backpressure);
    }
    // The tracker receives of a batch before geometry does: updates of a batch can always be taken, so that nobody waits in
    // a circle.
    let send = |batch: Batch| {
        if let Some(received) = received {
            drop(received.send(TrackerInput::Batch));
        }
        batches.send(Arc::new(batch)).is_ok()
    };
    while let Some(frame) = frames.recv() {
        report(received, &frame);
        report_queues(&stage, frames, 0);
        if let Some(batch) = stage.push(frame)
            && !send(batch)
        {
            return stage;
        }
    }
    if let Some(batch) = stage.finish() {
        send(batch);
    }
    stage
}

fn report_queues(stage: &SelectStage, frames: &Receiver<Frame>, n_batches: usize) {
    stage.report(|status| {
        status.n_dropped_frames = frames.dropped();
        status.n_queued_frames = frames.len();
        status.n_queued_batches = n_batches;
    });
}

/// Live: batches go out when geometry takes them, and selection waits for nobody: keyframes gather until then.
fn run_select_live(
    mut stage: SelectStage,
    frames: &Receiver<Frame>,
    batches: &Sender<Arc<Batch>>,
    backpressure: &Backpressure,
) -> SelectStage {
    let mut full = VecDeque::new();
    loop {
        match frames.recv_timeout(LIVE_TICK) {
            Received::Item(frame) => {
                full.extend(stage.push(frame));
                report_queues(&stage, frames, full.len());
            }
            Received::Nothing => {}
            Received::Ended => break,
        }
        while full.len() > MAX_BATCHES_WAITING {
            full.pop_front();
            backpressure.count_dropped_batch();
        }
        if !backpressure.is_open() {
            continue;
        }
        let batch = full.pop_front().or_else(|| {
            let is_due = backpressure.is_due(stage.n_new());
            is_due.then(|| stage.finish()).flatten()
        });
        if let Some(batch) = batch
            && !(backpressure.send() && batches.send(Arc::new(batch)).is_ok())
        {
            return stage;
        }
    }
    for batch in full.into_iter().chain(stage.finish()) {
        if batches.send(Arc::new(batch)).is_err() {
            break;
        }
    }
    stage
}

/// Who yields to whom where processors are few, as Linux counts it: 0 for everything that a frame's pose waits for. Beside one of
/// niceness 0, one of 3 gets a third of the time, one of 12 a fifteenth, one of 15 a thirtieth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Niceness {
    /// Poses of keyframes.
    Geometry = 3,
    /// The adjustment of all together.
    Adjustment = 8,
    /// Their depth.
    Depth = 12,
    /// Optimiser steps.
    Steps = 15,
}

/// Live: parallel loops of one stage must not wait behind those of another in the pool that all share. They get threads of
/// their own, and the system shares the processors among them by their niceness.
pub(crate) fn in_own_pool<T: Send>(
    name: &'static str,
    niceness: Niceness,
    work: impl FnOnce() -> T + Send,
) -> T {
    match own_pool(name, niceness) {
        Some(pool) => pool.install(work),
        None => work(),
    }
}

/// `None`, with a warning: the system has no threads left.
pub(crate) fn own_pool(name: &'static str, niceness: Niceness) -> Option<rayon::ThreadPool> {
    let pool = rayon::ThreadPoolBuilder::new()
        .thread_name(move |ix| format!("{name}-{ix}"))
        .start_handler(move |_| priority::lower_this_thread(niceness as i32))
        .build();
    if let Err(e) = &pool {
        tracing::warn!("{name} shares its threads with other stages; poses may be late: {e}");
    }
    pool.ok()
}

pub(crate) fn joined<T>(name: &str, thread: std::thread::JoinHandle<T>) -> anyhow::Result<T> {
    thread.join().map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|t| (*t).to_owned()));
        anyhow!("stage {name} broke: {}", text.unwrap_or_default())
    })
}
