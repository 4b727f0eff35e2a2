//! The stages between the queues: each is a struct with push-like methods and knows no threads.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::clock::{Stamp, Stopwatch};
use crate::config::{MapParams, Params};
use crate::frame::{Batch, Frame};
use crate::geometry::GeometryBatch;
use crate::map::SplatMap;
use crate::map::schedule::{self, Phase};
use crate::map::snapshot::Snapshot;
use crate::node::autosave::Autosave;
use crate::node::fitting::Fitter;
use crate::node::outward::Clerk;
use crate::node::{Grace, Progress, Stop};
use crate::pose::Rigid;
use crate::publish::outbox::Outbox;
use crate::select::{Batcher, Selector};

/// Stamps beyond this many are not kept for trajectory.tum: two weeks at 30 Hz would be 290 MB.
const MAX_STAMPS: usize = 10_000_000;
/// Steps between looks at the clock, the queue and the stop.
const STEPS_AT_ONCE: u64 = 10;
/// The same live, where a keyframe waits for them.
const LIVE_STEPS_AT_ONCE: u64 = 2;
/// Seconds that geometry gets to end after a stop.
const SECS_AFTER_STOP: f64 = 0.7;
/// Live: most steps that a keyframe is worth; the optimiser rests when the loss falls no more or all are spent.
const LIVE_STEPS_PER_KEYFRAME: u64 = 600;

/// Frames -> batches.
#[derive(Debug)]
pub(super) struct SelectStage {
    selector: Selector,
    batcher: Batcher,
    pub(super) n_selected: usize,
    pub(super) frame_stamps: Vec<Stamp>,
    pub(super) truth: Vec<(Stamp, Rigid)>,
}

/// Geometry -> the map, its steps and its snapshots.
pub(super) struct MapStage {
    pub(super) map: SplatMap,
    params: MapParams,
    is_live: bool,
    stop: Stop,
    n_frames: Option<u64>,
    pub(super) clerk: Clerk,
    /// Live: frames of the tracker to look at while there is nothing else to do.
    pub(super) fitter: Option<Fitter>,
    outbox: Option<Arc<Outbox>>,
    /// Age of keyframes that no snapshot has shown.
    unpublished: BTreeMap<u32, Stopwatch>,
    pub(super) autosave: Option<Autosave>,
    since_snapshot: Stopwatch,
    grace: Grace,
    n_keyframes: usize,
    pub(super) optimise_secs: f64,
    pub(super) keyframe_to_pose_secs: Vec<f64>,
    pub(super) keyframe_to_snapshot_secs: Vec<f64>,
}

impl SelectStage {
    pub(super) fn new(params: &Params, first_id: u32) -> Self {
        Self {
            selector: Selector::new(params.select.clone()).counting_from(first_id),
            batcher: Batcher::new(&params.select),
            n_selected: 0,
            frame_stamps: Vec::new(),
            truth: Vec::new(),
        }
    }

    pub(super) fn push(&mut self, frame: Frame) -> Option<Batch> {
        if self.frame_stamps.len() < MAX_STAMPS {
            self.frame_stamps.push(frame.stamp);
        }
        let keyframe = self.selector.push(frame)?;
        self.n_selected += 1;
        if let Some(truth) = keyframe.frame.truth {
            self.truth.push((keyframe.frame.stamp, truth));
        }
        self.batcher.push(keyframe)
    }

    /// Keyframes that were in no batch so far.
    pub(super) fn n_new(&self) -> usize {
        self.batcher.n_new()
    }

    /// A batch that is not full; `None` when every keyframe has been in one.
    pub(super) fn finish(&mut self) -> Option<Batch> {
        self.batcher.finish()
    }
}

impl MapStage {
    pub(super) fn new(
        map: SplatMap,
        params: &Params,
        (is_live, n_frames): (bool, Option<u64>),
        stop: Stop,
        outbox: Option<Arc<Outbox>>,
    ) -> Self {
        let calls = outbox.as_ref().and_then(|outbox| outbox.take_calls());
        Self {
            map,
            params: params.map.clone(),
            is_live,
            clerk: Clerk::new(calls, &params.track, stop.clone()),
            grace: Grace::new(stop.clone()),
            stop,
            n_frames,
            fitter: None,
            outbox,
            unpublished: BTreeMap::new(),
            autosave: None,
            since_snapshot: Stopwatch::start(),
            n_keyframes: 0,
            optimise_secs: 0.0,
            keyframe_to_pose_secs: Vec::new(),
            keyframe_to_snapshot_secs: Vec::new(),
        }
    }

    /// Adds a batch; in a replay makes the steps that are due by then. `None`: what the model said at its end.
    pub(super) fn add(
        &mut self,
        batch: Option<&Batch>,
        geometry: GeometryBatch,
        publish: &mut dyn FnMut(Arc<Snapshot>, Progress),
    ) {
        let newest = batch
            .and_then(|b| b.keyframes.last())
            .map(|k| k.frame.seq + 1);
        let progress = self
            .n_frames
            .zip(newest)
            .map(|(all, seen)| (seen as f64 / all.max(1) as f64).min(1.0));
        for keyframe in batch.iter().flat_map(|b| &b.keyframes) {
            self.n_keyframes = self.n_keyframes.max(keyframe.id as usize + 1);
            if !self.map.has_keyframe(keyframe.id) {
                self.unpublished.insert(keyframe.id, keyframe.age);
            }
        }
        let watch = Stopwatch::start();
        for id in self.map.add(batch, geometry, progress) {
            if let Some(age) = self.unpublished.get(&id) {
                let secs = age.secs();
                tracing::debug!("keyframe {id} has its pose after {secs:.2} s");
                self.keyframe_to_pose_secs.push(secs);
                if let Some(outbox) = &self.outbox {
                    outbox.note(|standing| standing.keyframe_to_pose.note(secs));
                }
            }
        }
        self.optimise_secs += watch.secs();
        self.note();
        if !self.is_live {
            let due = schedule::due(&self.params, progress.unwrap_or(0.0));
            self.step_until(due, publish);
        }
    }

    /// Live: a few steps, if any are left to make. Returns whether some were made.
    pub(super) fn step_while_waiting(
        &mut self,
        publish: &mut dyn FnMut(Arc<Snapshot>, Progress),
    ) -> bool {
        if self.map.is_settled() {
            return false;
        }
        let cap = LIVE_STEPS_PER_KEYFRAME * self.map.n_keyframes() as u64;
        let target = (self.map.n_steps() + LIVE_STEPS_AT_ONCE).min(cap);
        let before = self.map.n_steps();
        self.step_until(target, publish);
        self.map.n_steps() > before
    }

    /// The steps after the last keyframe, the poses of held-out views, and the last snapshot.
    pub(super) fn finish(
        &mut self,
        publish: &mut dyn FnMut(Arc<Snapshot>, Progress),
    ) -> Arc<Snapshot> {
        let watch = Stopwatch::start();
        let (first, last) = (self.map.n_steps(), self.params.steps);
        let phase = |n_steps| Phase::Final((n_steps - first) as f32 / (last - first) as f32);
        self.make_steps(last, &phase, publish);
        // Splats as they were seeded say less of a pose than the geometry that seeded them.
        if self.map.n_steps() > 0 && !self.stop.is_asked() {
            self.map.refine_held_out();
        }
        self.optimise_secs += watch.secs();
        // The last map file must not be overtaken by an older one.
        self.autosave = None;
        let snapshot = self.snapshot();
        self.note();
        let last = Progress {
            has_ended: true,
            ..self.progress()
        };
        publish(Arc::clone(&snapshot), last);
        snapshot
    }

    /// Calls from outside and frames of the tracker, while nothing else is to be done.
    pub(super) fn serve(&mut self) {
        self.clerk.serve(&mut self.map);
        if let Some(fitter) = &self.fitter {
            fitter.fit_one(&mut self.map);
        }
    }

    /// After a stop, geometry gets a moment for the batch that it is at, and no more: a network can take minutes.
    pub(super) fn gives_up(&mut self) -> bool {
        self.grace.is_over(SECS_AFTER_STOP)
    }

    /// Writes the map's part of the status.
    fn note(&self) {
        let Some(outbox) = &self.outbox else { return };
        let (map, optimise_secs) = (&self.map, self.optimise_secs);
        outbox.note(|standing| {
            standing.n_placed = map.n_keyframes() as u64;
            standing.n_components = map.components().len() as u64;
            standing.n_splats = map.n_splats() as u64;
            standing.n_steps = map.n_steps();
            standing.gpu_bytes = map.peak_gpu_bytes();
            if optimise_secs > 0.0 {
                standing.steps_per_s = map.n_steps() as f64 / optimise_secs;
            }
        });
    }

    fn step_until(&mut self, target: u64, publish: &mut dyn FnMut(Arc<Snapshot>, Progress)) {
        let watch = Stopwatch::start();
        self.make_steps(target, &|_| Phase::Streaming, publish);
        self.optimise_secs += watch.secs();
        if self.map.fault().is_some() {
            // Nothing that still comes could be mapped.
            self.stop.ask();
        }
        self.snapshot_if_due(publish);
    }

    /// Steps up to `target`, as long as nobody asks to stop; `phase` of the steps made so far.
    fn make_steps(
        &mut self,
        target: u64,
        phase: &dyn Fn(u64) -> Phase,
        publish: &mut dyn FnMut(Arc<Snapshot>, Progress),
    ) {
        while self.map.n_steps() < target && !self.stop.is_asked() {
            let n = STEPS_AT_ONCE.min(target - self.map.n_steps());
            if self.map.step(n, phase(self.map.n_steps())) == 0 {
                break;
            }
            self.clerk.serve(&mut self.map);
            self.snapshot_if_due(publish);
        }
    }

    fn snapshot_if_due(&mut self, publish: &mut dyn FnMut(Arc<Snapshot>, Progress)) {
        if self.since_snapshot.secs() >= self.params.snapshot_secs && self.map.n_splats() > 0 {
            let snapshot = self.snapshot();
            publish(snapshot, self.progress());
        }
        Autosave::save_if_due(self.autosave.as_mut(), &mut self.map, &mut self.clerk);
    }

    fn snapshot(&mut self) -> Arc<Snapshot> {
        self.note();
        if let (Some(moved), Some(outbox)) = (self.map.take_correction(), &self.outbox) {
            outbox.note_move(moved.reason);
        }
        let snapshot = self.map.snapshot();
        self.since_snapshot = Stopwatch::start();
        for pose in &snapshot.poses {
            if let Some(age) = self.unpublished.remove(&pose.keyframe_id) {
                self.keyframe_to_snapshot_secs.push(age.secs());
            }
        }
        // Keyframes that never get a pose must not pile up.
        while self.unpublished.len() > crate::map::MAX_WAITING {
            self.unpublished.pop_first();
        }
        snapshot
    }

    fn progress(&self) -> Progress {
        Progress {
            n_keyframes: self.n_keyframes,
            n_placed: self.map.n_keyframes(),
            n_splats: self.map.n_splats(),
            n_steps: self.map.n_steps(),
            steps_planned: if self.is_live { 0 } else { self.params.steps },
            has_ended: false,
        }
    }
}
