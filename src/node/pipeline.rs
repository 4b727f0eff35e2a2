//! Runs the stages: on threads joined by queues, or in sequence. The map is the same either way.

use std::sync::mpsc::Receiver as Calls;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::clock::Stopwatch;
use crate::config::track::Photometric;
use crate::frame::Batch;
use crate::geometry::{GeometryError, GeometryModel};
use crate::map::snapshot::{Scale, Snapshot};
use crate::node::fitting;
use crate::node::geometry_stage::{GeometryStage, GeometryTally, run_geometry};
use crate::node::opening;
use crate::node::outward::{self, Complaints, run_live, run_publisher};
use crate::node::source_stage::SourceStage;
use crate::node::stages::{MapStage, SelectStage};
use crate::node::threads::{Answer, joined, run_select, run_source};
use crate::node::track_stage::{News, TrackStage, Tracking, run_track};
use crate::node::{Job, Outcome, Progress, StageSecs, model, spawn};
use crate::publish::outbox::Outbox;
use crate::publish::service::Call;
use crate::queue::{Ended, Received, Receiver, Sender, WhenFull, queue};

/// Frames between source and selection.
const FRAME_QUEUE: usize = 4;
/// Frames before the tracker: live, an older one is worth nothing once two newer ones are there.
const HEARD_QUEUE: usize = 2;
/// Poses on their way out.
const EVENT_QUEUE: usize = 8;
/// How long a call from outside may wait while the map has nothing to do.
const CALL_TICK: Duration = Duration::from_millis(100);
/// Live, while no keyframe comes: seconds between looks of the tracker at what steps have made of the poses.
const NEWS_SECS: f64 = 1.0;

/// Runs a job to its end; a reset on the way throws the map away and goes on with the same source. `on_progress` is
/// called on this thread.
pub fn run(mut job: Job, on_progress: &mut dyn FnMut(Progress)) -> anyhow::Result<Outcome> {
    let watch = Stopwatch::start();
    let mut calls = None;
    loop {
        let (mut params, stop, outbox) = (job.params.clone(), job.stop.clone(), job.outbox.clone());
        let (is_live, out) = (job.is_live, job.out.clone());
        let mut ended = run_once(job, calls.take(), on_progress)?;
        if !stop.takes_restart() {
            let mut outcome = ended.into_outcome(outbox, stop.is_asked());
            outcome.secs.wall = watch.secs();
            return Ok(outcome);
        }
        tracing::info!("the map begins again");
        calls = ended.map.clerk.take_calls();
        params.map.load = ended.map.clerk.take_wanted();
        job = Job {
            source: ended.source.into_source(),
            params,
            is_live,
            stop,
            outbox,
            out,
        };
    }
}

fn run_once(
    job: Job,
    calls: Option<Calls<Call>>,
    on_progress: &mut dyn FnMut(Progress),
) -> anyhow::Result<End> {
    let (model, scale) = model(&job.params, job.source.truth_extent())?;
    run_with(model, scale, job, calls, on_progress)
}

fn run_with(
    model: Box<dyn GeometryModel>,
    scale: Scale,
    job: Job,
    calls: Option<Calls<Call>>,
    on_progress: &mut dyn FnMut(Progress),
) -> anyhow::Result<End> {
    let opening::Opened {
        mut map,
        mut track,
        first_id,
    } = opening::open(&job, scale, calls)?;
    let fits = job.params.track.photometric != Photometric::Off;
    if job.is_live && fits && track.is_on() {
        let (asker, fitter) = fitting::pair();
        (track.asker, map.fitter) = (Some(asker), Some(fitter));
    }
    let outbox = job.outbox;
    let stages = Stages {
        map,
        select: SelectStage::new(&job.params, first_id),
        geometry: GeometryStage::new(model, &job.params),
        track: track.heard(outbox.is_some()),
        source: SourceStage::new(job.source, job.stop, outbox.clone()),
        outbox,
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
    outbox: Option<Arc<Outbox>>,
}

/// All stages after their end.
struct End {
    source: SourceStage,
    n_dropped: u64,
    select: SelectStage,
    geometry: GeometryTally,
    map: MapStage,
    tracking: Tracking,
    snapshot: Arc<Snapshot>,
    error: Option<String>,
}

impl Stages {
    /// One thread, stage after stage: for tests and bisecting.
    fn in_sequence(mut self, on_progress: &mut dyn FnMut(Progress)) -> End {
        let outbox = self.outbox;
        let (mut of_map, mut of_live) = (Complaints::default(), Complaints::default());
        let mut publish = |snapshot: Arc<Snapshot>, progress: Progress| {
            if let Some(outbox) = &outbox {
                outward::publish_or_say(outbox, &(snapshot, progress.has_ended), &mut of_map);
            }
            on_progress(progress);
        };
        let mut tell = |track: &mut TrackStage| {
            let events = track.take_events();
            if let Some(outbox) = &outbox {
                outward::say_all(outbox, &events, &mut of_live);
            }
        };
        let (select, geometry, map) = (&mut self.select, &mut self.geometry, &mut self.map);
        let track = &mut self.track;
        let mut map_batch = |batch: Batch, track: &mut TrackStage| -> Result<(), GeometryError> {
            let answer = geometry.infer(&batch)?;
            map.add(Some(&batch), answer, &mut publish);
            if track.is_on() {
                track.update(&map.map.keyframe_views());
            }
            Ok(())
        };
        let mut result = Ok(());
        while result.is_ok() {
            let Some(frame) = self.source.next() else {
                break;
            };
            track.track(&frame, &Stopwatch::start());
            tell(track);
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
            map.add(None, rest, &mut publish);
            Ok(())
        });
        let snapshot = map.finish(&mut publish);
        track.update(&map.map.keyframe_views());
        tell(track);
        End {
            tracking: self.track.finish(0),
            source: self.source,
            n_dropped: 0,
            select: self.select,
            geometry: told(&self.geometry.tally()),
            map: self.map,
            snapshot,
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

        let (heard_tx, heard) = queue("heard", HEARD_QUEUE, when_full);
        let (news_tx, news) = queue("news", 1, when_full);
        // Live, the tracker must not wait for selection; in a replay, selection says what it has to wait for.
        let heard_tx = self.track.is_on().then_some(heard_tx);
        let news_tx = self.track.is_on().then_some(news_tx);
        let (from_source, from_select) = if is_live {
            (heard_tx, None)
        } else {
            (None, heard_tx)
        };

        let (events_tx, events) = queue("events", EVENT_QUEUE, when_full);
        let outbox = self.outbox.clone();
        let live = outbox.map(|outbox| spawn("live", move || run_live(&outbox, &events)));
        let live = live.transpose()?;
        let track = spawn("track", move || {
            run_track(self.track, &heard, &news, &events_tx)
        })?;
        let source = spawn("source", move || {
            run_source(self.source, &frames_tx, from_source.as_ref())
        })?;
        let pace = is_live.then(|| Arc::new(self.geometry.pace()));
        let paced = pace.clone();
        let select = spawn("select", move || {
            let (heard, pace) = (from_select.as_ref(), paced.as_deref());
            run_select(self.select, &frames, &batches_tx, heard, pace)
        })?;
        let geometry = spawn("geometry", move || {
            run_geometry(self.geometry, &batches, &answers_tx, pace.as_deref())
        })?;
        let map = spawn("map", move || {
            let mut publish = |snapshot, progress: Progress| {
                // Nobody has to listen: a gone publisher or progress bar is no reason to stop mapping.
                let is_last = progress.has_ended;
                drop(snapshots_tx.send((snapshot, is_last)));
                progress_tx.send(progress).ok();
            };
            run_map(
                self.map,
                (is_live, news_tx.as_ref()),
                &answers,
                &mut publish,
            )
        })?;
        let outbox = self.outbox;
        let publisher = spawn("publish", move || {
            run_publisher(outbox.as_deref(), &snapshots);
        })?;

        while let Some(progress) = progress.recv() {
            on_progress(progress);
        }
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
        joined("publish", publisher)?;
        let tracking = joined("track", track)?;
        live.map(|live| joined("live", live)).transpose()?;
        Ok(End {
            tracking,
            source,
            n_dropped,
            select,
            geometry: told(&tally),
            map,
            snapshot,
            error: error.map(|e| format!("geometry: {e}")),
        })
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

fn told(tally: &Mutex<GeometryTally>) -> GeometryTally {
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
    fn into_outcome(self, outbox: Option<Arc<Outbox>>, was_stopped: bool) -> Outcome {
        let fault = self.map.map.fault().map(|fault| format!("engine: {fault}"));
        Outcome {
            snapshot: self.snapshot,
            counts: self.source.counts(),
            n_dropped: self.n_dropped,
            n_selected: self.select.n_selected,
            frame_stamps: self.select.frame_stamps,
            truth: self.select.truth,
            secs: StageSecs {
                wall: 0.0,
                decode: self.source.decode_secs,
                geometry: self.geometry.secs,
                optimise: self.map.optimise_secs,
                track: self.tracking.secs,
            },
            tracking: self.tracking,
            keyframe_to_pose_secs: self.map.keyframe_to_pose_secs,
            keyframe_to_snapshot_secs: self.map.keyframe_to_snapshot_secs,
            clerk: self.map.clerk.at_end(),
            map: self.map.map,
            geometry_note: self.geometry.note,
            error: self.error.or(fault),
            was_stopped,
            outbox,
        }
    }
}

fn run_map(
    mut stage: MapStage,
    (is_live, news): (bool, Option<&Sender<News>>),
    answers: &Receiver<Answer>,
    publish: &mut dyn FnMut(Arc<Snapshot>, Progress),
) -> (MapStage, Arc<Snapshot>, Ending) {
    let mut since_news = Stopwatch::start();
    let ending = loop {
        let answer = if is_live {
            match answers.try_recv() {
                Ok(Some(answer)) => Ok(answer),
                Ok(None) if stage.step_while_waiting(publish) => {
                    if since_news.secs() > NEWS_SECS {
                        send_news(&mut stage, news);
                        since_news = Stopwatch::start();
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
        stage.add(batch.as_deref(), geometry, publish);
        send_news(&mut stage, news);
    };
    let snapshot = stage.finish(publish);
    send_news(&mut stage, news);
    (stage, snapshot, ending)
}

/// Waits, and serves calls from outside meanwhile.
fn next_answer(stage: &mut MapStage, answers: &Receiver<Answer>) -> Result<Answer, Ending> {
    loop {
        match answers.recv_timeout(CALL_TICK) {
            Received::Item(answer) => return Ok(answer),
            Received::Nothing if stage.gives_up() => {
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

fn send_news(stage: &mut MapStage, news: Option<&Sender<News>>) {
    if let Some(news) = news {
        // A tracker that is gone is no reason to stop mapping.
        drop(news.send(stage.map.keyframe_views()));
    }
}

#[cfg(test)]
mod tests;
