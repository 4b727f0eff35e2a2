//! What the threads of the source, of selection and of geometry do until their input ends.

use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;

use crate::frame::{Batch, Frame};
use crate::geometry::GeometryBatch;
use crate::node::pace::Pace;
use crate::node::source_stage::SourceStage;
use crate::node::stages::SelectStage;
use crate::node::track_stage::{Heard, tell};
use crate::queue::{Received, Receiver, Sender};

/// Live, while no frame comes: time between looks at whether geometry stands idle.
const LIVE_TICK: Duration = Duration::from_millis(50);

/// What crosses from geometry to the map; no batch at the model's end.
pub(super) type Answer = (Option<Arc<Batch>>, GeometryBatch);

pub(super) fn run_source(
    mut stage: SourceStage,
    frames: &Sender<Frame>,
    heard: Option<&Sender<Heard>>,
) -> (SourceStage, u64) {
    while let Some(frame) = stage.next() {
        tell(heard, &frame);
        if frames.send(frame).is_err() {
            break;
        }
    }
    (stage, frames.dropped())
}

/// Live where there is a pace.
pub(super) fn run_select(
    mut stage: SelectStage,
    frames: &Receiver<Frame>,
    batches: &Sender<Arc<Batch>>,
    heard: Option<&Sender<Heard>>,
    pace: Option<&Pace>,
) -> SelectStage {
    if let Some(pace) = pace {
        return run_select_live(stage, frames, batches, pace);
    }
    // The tracker hears of a batch before geometry does: news of a batch can always be taken, so that nobody waits in
    // a circle.
    let send = |batch: Batch| {
        if let Some(heard) = heard {
            drop(heard.send(Heard::Batch));
        }
        batches.send(Arc::new(batch)).is_ok()
    };
    while let Some(frame) = frames.recv() {
        tell(heard, &frame);
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
    pace: &Pace,
) -> SelectStage {
    loop {
        let full = match frames.recv_timeout(LIVE_TICK) {
            Received::Item(frame) => stage.push(frame),
            Received::Nothing => None,
            Received::Ended => break,
        };
        let batch = match full {
            None if pace.is_due(stage.n_new()) => stage.finish(),
            full => full,
        };
        if let Some(batch) = batch
            && !(pace.wait_to_send() && batches.send(Arc::new(batch)).is_ok())
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
pub(super) fn in_own_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let named = |ix: usize| format!("geometry-{ix}");
    match rayon::ThreadPoolBuilder::new().thread_name(named).build() {
        Ok(pool) => pool.install(work),
        Err(e) => {
            tracing::warn!("geometry shares its threads with mapping and may be late: {e}");
            work()
        }
    }
}

pub(super) fn joined<T>(name: &str, thread: std::thread::JoinHandle<T>) -> anyhow::Result<T> {
    thread.join().map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|t| (*t).to_owned()));
        anyhow!("stage {name} broke: {}", text.unwrap_or_default())
    })
}
