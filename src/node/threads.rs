//! What the threads of the source, of selection and of geometry do until their input ends.

use std::sync::Arc;

use anyhow::anyhow;

use crate::frame::{Batch, Frame};
use crate::geometry::{GeometryBatch, GeometryError};
use crate::node::source_stage::SourceStage;
use crate::node::stages::{GeometryStage, SelectStage};
use crate::node::track_stage::{Heard, tell};
use crate::queue::{Receiver, Sender};

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

pub(super) fn run_select(
    mut stage: SelectStage,
    frames: &Receiver<Frame>,
    batches: &Sender<Arc<Batch>>,
    heard: Option<&Sender<Heard>>,
) -> SelectStage {
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

pub(super) fn run_geometry(
    mut stage: GeometryStage,
    batches: &Receiver<Arc<Batch>>,
    answers: &Sender<Answer>,
) -> Option<GeometryError> {
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
    match stage.finish() {
        Ok(geometry) => {
            drop(answers.send((None, geometry)));
            None
        }
        Err(error) => Some(error),
    }
}

pub(super) fn joined<T>(name: &str, thread: std::thread::JoinHandle<T>) -> anyhow::Result<T> {
    thread.join().map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|t| (*t).to_owned()));
        anyhow!("stage {name} broke: {}", text.unwrap_or_default())
    })
}
