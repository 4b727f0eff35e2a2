//! Runs the stages: on threads joined by queues, or in sequence. The map is the same either way.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::node::backpressure::Backpressure;
use crate::node::geometry_thread::{GeometryStage, GeometryTally, run_geometry};
use crate::node::grid_thread::{GridInput, GridStage, run_grid};
use crate::node::job::{InputSummary, Job, Outcome, Progress, StageSecs, model, spawn};
use crate::node::map_stage::{MapStage, Publish};
use crate::node::publish_threads::{
    LiveStage, Outgoing, OutputStages, SnapshotStage, run_live, run_publisher, stages_of,
    streams_of,
};
use crate::node::select_stage::SelectStage;
use crate::node::source_thread::SourceStage;
use crate::node::threads::{Answer, Niceness, joined, own_pool, run_select, run_source};
use crate::node::track_thread::{KeyframeUpdate, TrackStage, TrackingSummary, run_track};
use crate::node::{open, refinement};
use splat_geometry::error::GeometryError;
use splat_geometry::model::GeometryModel;
use splat_io::queue::{Ended, Received, Receiver, Sender, WhenFull, queue};
use splat_ros::output::{Output, Streams};
use splat_ros::publisher::Publisher;
use splat_slam::track::params::Photometric;
use splat_types::correction::MapCorrection;
use splat_types::frame::Batch;
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::time::Stopwatch;

/// Frames between source and selection.
const FRAME_QUEUE: usize = 4;
/// Frames before the tracker: live, an older one is worth nothing once two newer ones are there.
const INPUT_QUEUE: usize = 2;
/// Poses on their way out.
const EVENT_QUEUE: usize = 8;
/// How long a call from outside may wait while the map has nothing to do.
const CALL_TICK: Duration = Duration::from_millis(100);
/// Live: time between looks of the map at whether poses of keyframes are still at work.
const POSE_TICK: Duration = Duration::from_millis(4);
/// How long a run says nothing at most.
const PROGRESS_TICK: Duration = Duration::from_millis(1500);
/// Live, while no keyframe comes: seconds between looks of the tracker at what steps have made of the poses.
const UPDATE_SECS: f64 = 1.0;

/// Runs a job to its end; a reset on the way throws the map away and goes on with the same source. `on_progress` is
/// called on this thread.
pub fn run(mut job: Job, on_progress: &mut dyn FnMut(Progress)) -> anyhow::Result<Outcome> {
    let watch = Stopwatch::start();
    loop {
        let (mut params, stop) = (job.params.clone(), job.stop.clone());
        let (is_live, out, engines) = (job.is_live, job.out.clone(), job.engines.clone());
        let handles = job.output.as_ref().map(|output| output.handles.clone());
        let mut ended = run_once(job, on_progress)?;
        if !stop.takes_restart() {
            let publisher = handles.map(|handles| handles.publisher);
            let mut outcome = ended.into_outcome(publisher, stop.is_asked());
            outcome.secs.wall = watch.secs();
            return Ok(outcome);
        }
        tracing::info!("the map begins again");
        params.map.resume = ended.map.request_handler.take_wanted();
        if let Some(handles) = &handles {
            let restart = MapCorrection::restart(!params.map.resume.is_empty());
            handles.reports.correction.add(restart);
        }
        let calls = ended.map.request_handler.take_calls();
        job = Job {
            source: ended.source.into_source(),
            params,
            is_live,
            stop,
            output: handles.zip(ended.streams).map(|(handles, streams)| Output {
                handles,
                streams,
                calls,
            }),
            out,
            engines,
        };
    }
}

fn run_once(job: Job, on_progress: &mut dyn FnMut(Progress)) -> anyhow::Result<End> {
    let (model, scale) = model(&job.params, &*job.source)?;
    run_with(model, scale, job, on_progress)
}

fn run_with(
    model: Box<dyn GeometryModel>,
    scale: Scale,
    mut job: Job,
    on_progress: &mut dyn FnMut(Progress),
) -> anyhow::Result<End> {
    let open::Opened {
        mut map,
        mut track,
        first_id,
    } = open::open(&mut job, scale, model.has_depth_of_poses())?;
    let fits = job.params.track.photometric != Photometric::Off;
    if job.is_live && fits && track.is_on() {
        let (client, fitter) = refinement::pair();
        (track.client, map.fitter) = (Some(client), Some(fitter));
    }
    let (handles, streams) = job.output.map(|out| (out.handles, out.streams)).unzip();
    let publisher = handles.as_ref().map(|handles| &handles.publisher);
    let output = publisher.zip(streams).map(|(publisher, streams)| {
        let grid = (&job.params.grid, job.out.as_deref());
        stages_of(publisher, streams, grid)
    });
    let stages = Stages {
        map,
        select: SelectStage::new(&job.params, first_id, handles.as_ref())
            .of_photos(job.source.n_photos()),
        geometry: GeometryStage::new(model, &job.params),
        track: track.received(output.is_some()),
        source: SourceStage::new(job.source, job.stop, handles),
        output,
    };
    if job.params.sequential {
        Ok(stages.in_sequence(on_progress))
    } else {
        stages.on_threads(job.is_live, on_progress)
    }
}

struct Stages {
    source: SourceStage,
    select: SelectStage,
    geometry: GeometryStage,
    map: MapStage,
    track: TrackStage,
    output: Option<OutputStages>,
}

/// All stages after their end.
struct End {
    source: SourceStage,
    n_dropped: u64,
    select: SelectStage,
    geometry: GeometryTally,
    map: MapStage,
    tracking: TrackingSummary,
    snapshot: Arc<Snapshot>,
    streams: Option<Streams>,
    error: Option<String>,
}

impl Stages {
    /// One thread, stage after stage: for tests and bisecting.
    fn in_sequence(mut self, on_progress: &mut dyn FnMut(Progress)) -> End {
        let (mut live, mut snapshots, mut grid) = apart(self.output);
        let mut publish = |outgoing: Option<Outgoing>, progress: Progress| {
            if let Some(mut outgoing) = outgoing {
                let input = outgoing.grid.take();
                if let Some(stage) = &mut snapshots {
                    stage.publish(&(outgoing, progress.has_ended), 0);
                }
                if let Some((stage, input)) = grid.as_mut().zip(input) {
                    stage.take(&input, &|| false);
                }
            }
            on_progress(progress);
        };
        let mut report = |track: &mut TrackStage| {
            let events = track.take_events();
            if let Some(stage) = &mut live {
                stage.publish(&events);
            }
        };
        let (select, geometry, map) = (&mut self.select, &mut self.geometry, &mut self.map);
        let track = &mut self.track;
        let mut map_batch = |batch: Batch, track: &mut TrackStage| -> Result<(), GeometryError> {
            let answer = geometry.infer(&batch)?;
            map.add(Some(&batch), &answer, None, &mut publish);
            if track.is_on() {
                track.update(&map.keyframe_views());
            }
            Ok(())
        };
        let mut result = Ok(());
        while result.is_ok() {
            let Some(frame) = self.source.next() else {
                break;
            };
            track.track(&frame, &Stopwatch::start());
            report(track);
            if let Some(batch) = select.push(frame) {
                result = map_batch(batch, track);
            }
        }
        if result.is_ok()
            && let Some(batch) = select.finish()
        {
            result = map_batch(batch, track);
        }
        let result = result.and_then(|()| {
            let rest = geometry.finish()?;
            map.add(None, &rest, None, &mut publish);
            Ok(())
        });
        let snapshot = map.finish(&mut publish);
        track.update(&map.keyframe_views());
        report(track);
        End {
            tracking: self.track.finish(0),
            source: self.source,
            n_dropped: 0,
            select: self.select,
            geometry: summary(&self.geometry.tally()),
            map: self.map,
            snapshot,
            streams: joined_streams(live, snapshots, grid),
            error: result.err().map(|e| format!("geometry: {e}")),
        }
    }

    /// A thread per stage.
    fn on_threads(
        self,
        is_live: bool,
        on_progress: &mut dyn FnMut(Progress),
    ) -> anyhow::Result<End> {
        let when_full = when_full(is_live);
        let (frames_tx, frames) = queue("frames", FRAME_QUEUE, when_full);
        let (batches_tx, batches) = queue("batches", 1, WhenFull::Wait);
        let (answers_tx, answers) = queue("answers", 1, WhenFull::Wait);
        let (batches_end, tally) = (batches.closer(), self.geometry.tally());
        let (snapshots_tx, snapshots) = queue("snapshots", 1, WhenFull::DropOldest);
        let (progress_tx, progress) = queue("progress", 1, WhenFull::DropOldest);

        let (input_tx, received) = queue("tracker input", INPUT_QUEUE, when_full);
        let (updates_tx, updates) = queue("keyframe updates", 1, when_full);
        // Live, the tracker must not wait for selection; in a replay, selection says what it has to wait for.
        let input_tx = self.track.is_on().then_some(input_tx);
        let updates_tx = self.track.is_on().then_some(updates_tx);
        let (from_source, from_select) = if is_live {
            (input_tx, None)
        } else {
            (None, input_tx)
        };

        let (events_tx, events) = queue("events", EVENT_QUEUE, when_full);
        let (live, snapshot_stage, grid) = apart(self.output);
        let (grid_tx, grid) = grid_on_thread(grid)?;
        let live = live
            .map(|stage| spawn("live", move || run_live(stage, &events)))
            .transpose()?;
        let track = spawn("track", move || {
            run_track(self.track, &received, &updates, &events_tx)
        })?;
        let source = spawn("source", move || {
            run_source(self.source, &frames_tx, from_source.as_ref())
        })?;
        let backpressure = is_live.then(|| Arc::new(self.geometry.backpressure()));
        let (paced, poses) = (backpressure.clone(), backpressure.clone());
        let select = spawn("select", move || {
            let (received, backpressure) = (from_select.as_ref(), paced.as_deref());
            run_select(self.select, &frames, &batches_tx, received, backpressure)
        })?;
        let geometry = spawn("geometry", move || {
            let limit = backpressure.as_deref();
            run_geometry(self.geometry, &batches, &answers_tx, limit)
        })?;
        let map = spawn("map", move || {
            let mut publish = |outgoing: Option<Outgoing>, progress: Progress| {
                // Nobody has to listen: a gone publisher or progress bar is no reason to stop mapping.
                let is_last = progress.has_ended;
                if let Some(mut outgoing) = outgoing {
                    if let Some(input) = outgoing.grid.take() {
                        drop(grid_tx.send(input));
                    }
                    drop(snapshots_tx.send((outgoing, is_last)));
                }
                progress_tx.send(progress).ok();
            };
            let updates = (poses.as_deref(), updates_tx.as_ref());
            run_map(self.map, updates, &answers, &mut publish)
        })?;
        let publish = spawn("publish", move || run_publisher(snapshot_stage, &snapshots))?;

        report_progress(&progress, on_progress);
        let (map, snapshot, ending) = joined("map", map)?;
        let error = match ending {
            Ending::All => joined("geometry", geometry)?,
            // Its thread ends with its batch, or with the process.
            Ending::GivenUp => {
                batches_end.close();
                None
            }
        };
        let (source, n_dropped) = joined("source", source)?;
        let select = joined("select", select)?;
        let publish = joined("publish", publish)?;
        let grid = joined("grid", grid)?;
        let tracking = joined("track", track)?;
        let live = live.map(|live| joined("live", live)).transpose()?;
        Ok(End {
            tracking,
            source,
            n_dropped,
            select,
            geometry: summary(&tally),
            map,
            snapshot,
            streams: joined_streams(live, publish, grid),
            error: error.map(|e| format!("geometry: {e}")),
        })
    }
}

/// Until the map has ended. Where nothing new is known for long, what was known is said again: silence looks like a fault.
fn report_progress(progress: &Receiver<Progress>, on_progress: &mut dyn FnMut(Progress)) {
    let mut last = Progress::default();
    loop {
        match progress.recv_timeout(PROGRESS_TICK) {
            Received::Item(now) => last = now,
            Received::Nothing => {}
            Received::Ended => return,
        }
        on_progress(last);
    }
}

/// Live input is worth nothing once it is old; of a replay nothing is lost.
fn when_full(is_live: bool) -> WhenFull {
    if is_live {
        WhenFull::DropOldest
    } else {
        WhenFull::Wait
    }
}

/// Behind all others: the newest keyframes replace those that wait.
fn grid_on_thread(
    grid: Option<GridStage>,
) -> anyhow::Result<(Sender<GridInput>, JoinHandle<Option<GridStage>>)> {
    let (sender, inputs) = queue("grid", 1, WhenFull::DropOldest);
    let has_grid = grid.is_some();
    let thread = spawn("grid", move || {
        let pool = has_grid.then(|| own_pool("grid", Niceness::Depth));
        run_grid(grid, &inputs, pool.flatten())
    })?;
    Ok((sender, thread))
}

fn apart(
    output: Option<OutputStages>,
) -> (Option<LiveStage>, Option<SnapshotStage>, Option<GridStage>) {
    match output {
        Some(stages) => (Some(stages.live), Some(stages.snapshots), Some(stages.grid)),
        None => (None, None, None),
    }
}

fn joined_streams(
    live: Option<LiveStage>,
    snapshots: Option<SnapshotStage>,
    grid: Option<GridStage>,
) -> Option<Streams> {
    Some(streams_of(OutputStages {
        live: live?,
        snapshots: snapshots?,
        grid: grid?,
    }))
}

fn summary(tally: &Mutex<GeometryTally>) -> GeometryTally {
    tally.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// How the answers of geometry ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ending {
    All,
    /// A stop was asked for, and geometry took too long to end.
    GivenUp,
}

impl End {
    fn into_outcome(self, publisher: Option<Arc<Publisher>>, was_stopped: bool) -> Outcome {
        let fault = self.map.recovery.error;
        Outcome {
            snapshot: self.snapshot,
            input: InputSummary {
                counts: self.source.counts(),
                n_dropped: self.n_dropped,
                n_selected: self.select.n_selected,
                frame_stamps: self.select.frame_stamps,
                truth: self.select.truth,
            },
            secs: StageSecs {
                wall: 0.0,
                decode: self.source.decode_secs,
                geometry: self.geometry.secs,
                optimise: self.map.figures.optimise_secs,
                track: self.tracking.secs,
            },
            tracking: self.tracking,
            latency: self.map.figures.latency,
            quality_at: self.map.figures.milestones.behind,
            request_handler: self.map.request_handler.at_end(),
            map: self.map.map,
            geometry_note: self.geometry.note,
            n_engine_faults: self.map.recovery.n_faults,
            error: self.error.or(fault),
            was_stopped,
            publisher,
        }
    }
}

fn run_map(
    mut stage: MapStage,
    (poses, updates): (Option<&Backpressure>, Option<&Sender<KeyframeUpdate>>),
    answers: &Receiver<Answer>,
    publish: &mut Publish<'_>,
) -> (MapStage, Arc<Snapshot>, Ending) {
    let mut since_update = Stopwatch::start();
    if let Some(live) = &mut stage.live {
        live.pool = own_pool("steps", Niceness::Steps);
    }
    let ending = loop {
        let answer = if let Some(poses) = poses {
            match answers.try_recv() {
                Ok(Some(answer)) => Ok(answer),
                Ok(None) if stage.gives_way(poses) => {
                    let waited = Stopwatch::start();
                    stage.snapshot_if_due(publish);
                    std::thread::sleep(POSE_TICK);
                    stage.note_waited(waited.secs());
                    continue;
                }
                Ok(None) if stage.step_while_waiting(publish) => {
                    if since_update.secs() > UPDATE_SECS {
                        send_updates(&mut stage, updates);
                        since_update = Stopwatch::start();
                    }
                    continue;
                }
                Ok(None) => next_answer(&mut stage, answers),
                Err(Ended) => Err(Ending::All),
            }
        } else {
            next_answer(&mut stage, answers)
        };
        let (batch, geometry) = match answer {
            Ok(answer) => answer,
            Err(ending) => break ending,
        };
        let at_once = updates.filter(|_| poses.is_some());
        stage.add(batch.as_deref(), &geometry, at_once, publish);
        if let Some(poses) = poses {
            poses.answer_taken();
        }
        if at_once.is_none() {
            send_updates(&mut stage, updates);
        }
    };
    let snapshot = stage.finish(publish);
    send_updates(&mut stage, updates);
    (stage, snapshot, ending)
}

/// Waits, and serves calls from outside meanwhile.
fn next_answer(stage: &mut MapStage, answers: &Receiver<Answer>) -> Result<Answer, Ending> {
    loop {
        match answers.recv_timeout(CALL_TICK) {
            Received::Item(answer) => return Ok(answer),
            Received::Nothing if stage.timed_out() => {
                tracing::warn!(
                    "stopped while geometry was at work: its last keyframes are not in the map"
                );
                return Err(Ending::GivenUp);
            }
            Received::Nothing => stage.serve(),
            Received::Ended => return Err(Ending::All),
        }
    }
}

fn send_updates(stage: &mut MapStage, updates: Option<&Sender<KeyframeUpdate>>) {
    if let Some(updates) = updates {
        // A tracker that is gone is no reason to stop mapping.
        drop(updates.send(stage.keyframe_views()));
    }
}

#[cfg(test)]
mod tests;
