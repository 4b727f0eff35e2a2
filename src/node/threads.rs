//! What the threads of the source, of selection and of geometry do until their input ends.

use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;

use crate::node::backpressure::Backpressure;
use crate::node::map_stage::SelectStage;
use crate::node::source_thread::SourceStage;
use crate::node::track_thread::{TrackerInput, report};
use splat_geometry::answer::GeometryBatch;
use splat_io::queue::{Received, Receiver, Sender};
use splat_types::frame::{Batch, Frame};

/// Live, while no frame comes: time between looks at whether geometry stands idle.
const LIVE_TICK: Duration = Duration::from_millis(50);

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

/// Batches go out as soon as geometry takes them; while it takes none, frames are dropped before selection.
fn run_select_live(
    mut stage: SelectStage,
    frames: &Receiver<Frame>,
    batches: &Sender<Arc<Batch>>,
    backpressure: &Backpressure,
) -> SelectStage {
    loop {
        let full = match frames.recv_timeout(LIVE_TICK) {
            Received::Item(frame) => stage.push(frame),
            Received::Nothing => None,
            Received::Ended => break,
        };
        let batch = match full {
            None if backpressure.is_due(stage.n_new()) => stage.finish(),
            full => full,
        };
        if let Some(batch) = batch
            && !(backpressure.wait_to_send() && batches.send(Arc::new(batch)).is_ok())
        {
            return stage;
        }
    }
    if let Some(batch) = stage.finish() {
        drop(batches.send(Arc::new(batch)));
    }
    stage
}

/// Live, parallel loops of geometry must not wait behind those of the map in the pool that all share: threads of their
/// own get their part of the processors from the system.
pub(crate) fn in_own_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let named = |ix: usize| format!("geometry-{ix}");
    match rayon::ThreadPoolBuilder::new().thread_name(named).build() {
        Ok(pool) => pool.install(work),
        Err(e) => {
            tracing::warn!("geometry shares its threads with mapping and may be late: {e}");
            work()
        }
    }
}

pub(crate) fn joined<T>(name: &str, thread: std::thread::JoinHandle<T>) -> anyhow::Result<T> {
    thread.join().map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|t| (*t).to_owned()));
        anyhow!("stage {name} broke: {}", text.unwrap_or_default())
    })
}
