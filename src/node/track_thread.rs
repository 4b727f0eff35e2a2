//! Frames and what the map says of its keyframes -> poses: the tracker as a stage, and the thread that it runs on.

use std::collections::VecDeque;

use crate::node::publish_threads::LiveEvent;
use crate::node::refinement::RefinementClient;
use crate::node::stop::ShutdownTimeout;
use splat_io::queue::{Receiver, Sender};
use splat_ros::navigation::KeyframeDepth;
use splat_ros::odometry::PoseEvent;
use splat_slam::track::history::Tracks;
use splat_slam::track::landmarks::KeyframeView;
use splat_slam::track::params::TrackParams;
use splat_slam::track::refinement::FrameRef;
use splat_slam::track::tracker::Tracker;
use splat_types::frame::Frame;
use splat_types::time::Stopwatch;
use splat_types::tracking::{LostReason, TrackState, TrackedFrame};
use splat_types::transform::{Rigid, Similarity};

/// Times that the figures of a run are made from: those of the last two hours at 15 Hz.
const MAX_TIMES: usize = 100_000;
/// Live, where the queue is never empty: frames after which updates of the map are taken in all the same.
const MAX_FRAMES_WITHOUT_UPDATE: usize = 10;

/// Seconds that frames which still wait get after a stop.
const SECS_AFTER_STOP: f64 = 0.3;

/// Seconds between landmarks for map files that somebody may ask for.
const REPORT_SECS: f64 = 20.0;

/// What the tracker receives, in order.
pub(crate) enum TrackerInput {
    /// A frame, and the time since it came.
    Frame(Box<Frame>, Stopwatch),
    /// Replay: the keyframes of one more batch must have their place before the next frame is tracked, so that what
    /// a frame is tracked by does not hang on how fast the threads are.
    Batch,
}

/// All keyframes of the map at one moment.
pub(crate) type KeyframeUpdate = Vec<KeyframeView>;

/// Frames -> poses.
#[derive(Debug)]
pub(crate) struct TrackStage {
    /// `None`: tracking is off.
    tracker: Option<Tracker>,
    is_live: bool,
    said: TrackState,
    times: TrackTimes,
    /// Who keeps landmarks for a map file that is written while the run goes on, how often, and since when.
    saved_to: Option<(Sender<Vec<u8>>, f64, Stopwatch)>,
    /// How the map has moved under the camera since the last frame.
    moved: Option<Similarity>,
    /// The last keyframe whose depth went out.
    shown: Option<u32>,
    /// What is to be said outside; kept empty where nobody listens.
    events: Vec<LiveEvent>,
    is_received: bool,
    /// Who finds where images fit the splats.
    pub(crate) client: Option<RefinementClient>,
    pub(crate) grace: ShutdownTimeout,
    /// Frames that had come before a stop and were left.
    n_left: u64,
}

/// What tracking took.
#[derive(Debug, Default)]
struct TrackTimes {
    secs: f64,
    frame_secs: VecDeque<f64>,
    latency_secs: VecDeque<f64>,
}

/// What tracking leaves behind.
#[derive(Debug, Default)]
pub struct TrackingSummary {
    pub tracks: Tracks,
    /// What a later run needs to find its place in the map; empty without tracking.
    pub landmarks: Vec<u8>,
    /// Live: frames that made room for newer ones before they were tracked, or that a stop left no time for.
    pub n_dropped: u64,
    /// Seconds of work, in all and per frame.
    pub secs: f64,
    pub frame_secs: Vec<f64>,
    /// Live: seconds from the arrival of a frame to its pose.
    pub latency_secs: Vec<f64>,
}

impl TrackStage {
    pub(crate) fn new(params: &TrackParams, is_live: bool) -> Self {
        Self::of(params.enabled.then(|| Tracker::new(params)), is_live)
    }

    /// `None`: tracking is off.
    pub(crate) fn of(tracker: Option<Tracker>, is_live: bool) -> Self {
        Self {
            tracker,
            is_live,
            said: TrackState::Initialising,
            times: TrackTimes::default(),
            saved_to: None,
            moved: None,
            shown: None,
            events: Vec::new(),
            is_received: false,
            client: None,
            grace: ShutdownTimeout::default(),
            n_left: 0,
        }
    }

    /// Begins in a map that was saved, without an idea of where.
    pub(crate) fn begin_in(&mut self, saved: &[u8], params: &TrackParams) -> anyhow::Result<()> {
        if self.tracker.is_some() && !saved.is_empty() {
            let tracker = Tracker::in_saved(saved, params).map_err(anyhow::Error::msg)?;
            self.tracker = Some(tracker);
        }
        Ok(())
    }

    /// From now on reports landmarks for map files that are written every `secs`; 0: whenever somebody asks.
    pub(crate) fn save_landmarks_to(&mut self, secs: f64, to: Sender<Vec<u8>>) {
        let secs = if secs > 0.0 { secs } else { REPORT_SECS };
        self.saved_to = Some((to, secs, Stopwatch::start()));
    }

    fn save_if_due(&mut self) {
        let Some((to, secs, since)) = &mut self.saved_to else {
            return;
        };
        // A little ahead of the map file that they are for.
        if since.secs() < 0.5 * *secs {
            return;
        }
        *since = Stopwatch::start();
        if let Some(Ok(landmarks)) = self.tracker.as_ref().map(Tracker::saved) {
            drop(to.send(landmarks));
        }
    }

    /// What it finds is to be said outside.
    pub(crate) fn received(self, is_received: bool) -> Self {
        Self {
            is_received,
            ..self
        }
    }

    /// What has come up since the last time.
    pub(crate) fn take_events(&mut self) -> Vec<LiveEvent> {
        std::mem::take(&mut self.events)
    }

    pub(crate) fn is_on(&self) -> bool {
        self.tracker.is_some()
    }

    pub(crate) fn track(&mut self, frame: &Frame, since: &Stopwatch) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        if self.grace.is_over(SECS_AFTER_STOP) {
            self.n_left += 1;
            return;
        }
        let watch = Stopwatch::start();
        let fitted = self.client.as_ref().and_then(RefinementClient::answer);
        if let Some((placement, key_from_cam)) = fitted {
            tracker.fitted(&placement, key_from_cam);
        }
        let tracked = tracker.track(frame);
        if let Some((client, placement)) = self.client.as_ref().zip(tracker.placement()) {
            client.ask(placement, frame);
        }
        self.times.secs += watch.secs();
        note(&mut self.times.frame_secs, watch.secs());
        if self.is_live && tracked.is_measured() {
            note(&mut self.times.latency_secs, since.secs());
        }
        self.say(&tracked);
        let moved = self.moved.take();
        // Without a map, poses have no place and no unit that a robot could use.
        let is_before_map = self.tracker.as_ref().is_some_and(Tracker::is_before_map);
        if self.is_received {
            self.events.push(LiveEvent::Frame(Box::new(PoseEvent {
                tracked: if is_before_map {
                    without_pose(&tracked)
                } else {
                    tracked
                },
                odom_from_cam: frame.odometry,
                is_odometry_out: self.tracker.as_ref().is_some_and(Tracker::is_odometry_out),
                up_in_cam: self.tracker.as_ref().and_then(Tracker::up_in_cam),
                imu_fault: self.tracker.as_ref().and_then(Tracker::imu_fault),
                base_from_cam: None,
                moved,
                latency_secs: since.secs(),
            })));
        }
    }

    /// Asks for a better pose of the last frame, relative to the keyframe that it was tracked by.
    pub(crate) fn fit(&mut self, better: &mut dyn FnMut(&FrameRef) -> Option<Rigid>) {
        if let Some(tracker) = &mut self.tracker
            && let Some(placement) = tracker.placement()
            && let Some(key_from_cam) = better(&placement)
        {
            tracker.fitted(&placement, key_from_cam);
        }
    }

    /// In a replay, frames that the map has reached get their second look at once.
    pub(crate) fn update(&mut self, updates: &[KeyframeView]) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        let watch = Stopwatch::start();
        let before = tracker.last_pose();
        tracker.update(updates);
        if let Some((before, after)) = before.zip(tracker.last_pose()) {
            let step = after * before.inverse();
            let so_far = self.moved.map_or(step, |moved| {
                step * Rigid::new(moved.rotation, moved.translation)
            });
            self.moved = Some(Similarity {
                scale: 1.0,
                rotation: so_far.rotation,
                translation: so_far.translation,
            });
        }
        if !self.is_live {
            tracker.retry(usize::MAX);
        }
        self.save_if_due();
        self.times.secs += watch.secs();
        if self.is_received {
            self.show(updates);
        }
    }

    /// The depth of the newest keyframe, once.
    fn show(&mut self, updates: &[KeyframeView]) {
        let newest = updates.iter().rev().find(|view| view.depth.width_px > 0);
        let Some(view) = newest.filter(|view| self.shown < Some(view.keyframe.id)) else {
            return;
        };
        self.shown = Some(view.keyframe.id);
        self.events
            .push(LiveEvent::Keyframe(Box::new(KeyframeDepth {
                stamp: view.keyframe.frame.stamp,
                image: std::sync::Arc::clone(&view.keyframe.frame.image),
                intrinsics: view.intrinsics,
                depth: std::sync::Arc::clone(&view.depth),
            })));
    }

    /// Returns whether there was a frame to look at.
    fn retry(&mut self) -> bool {
        let watch = Stopwatch::start();
        let tracker = self.tracker.as_mut();
        let n_looks = tracker.map_or(0, |tracker| tracker.retry(1));
        self.times.secs += watch.secs();
        n_looks > 0
    }

    pub(crate) fn finish(mut self, n_dropped: u64) -> TrackingSummary {
        let watch = Stopwatch::start();
        let saved = self.tracker.as_ref().map(Tracker::saved);
        let landmarks = saved.unwrap_or_else(|| Ok(Vec::new()));
        let mut grace = self.grace;
        let goes_on = || !grace.is_over(SECS_AFTER_STOP);
        let tracks = self.tracker.take().map(|tracker| tracker.finish(goes_on));
        TrackingSummary {
            landmarks: landmarks.unwrap_or_else(|reason| {
                tracing::warn!("later runs will not find their place in this map: {reason}");
                Vec::new()
            }),
            tracks: tracks.unwrap_or_default(),
            n_dropped: n_dropped + self.n_left,
            secs: self.times.secs + watch.secs(),
            frame_secs: self.times.frame_secs.into(),
            latency_secs: self.times.latency_secs.into(),
        }
    }

    fn say(&mut self, tracked: &TrackedFrame) {
        if tracked.state == self.said {
            return;
        }
        let stamp = tracked.stamp;
        match (tracked.state, &tracked.reason) {
            (TrackState::Lost, Some(reason)) => {
                tracing::warn!("tracking is lost at {stamp}: {reason}");
            }
            (TrackState::Relocalised, _) => tracing::info!("relocalised at {stamp}"),
            (TrackState::Tracking, _) if self.said != TrackState::Relocalised => {
                tracing::info!("tracking at {stamp}");
            }
            _ => {}
        }
        self.said = tracked.state;
    }
}

/// As long as there is no map.
fn without_pose(tracked: &TrackedFrame) -> TrackedFrame {
    TrackedFrame {
        state: TrackState::Initialising,
        reason: Some(LostReason::NoKeyframes),
        pose: None,
        ..*tracked
    }
}

fn note(times: &mut VecDeque<f64>, secs: f64) {
    if times.len() == MAX_TIMES {
        times.pop_front();
    }
    times.push_back(secs);
}

/// Sends a frame to the tracker, if there is one; the image is shared.
pub(crate) fn report(received: Option<&Sender<TrackerInput>>, frame: &Frame) {
    if let Some(received) = received {
        // A tracker that is gone is no reason to stop mapping.
        drop(received.send(TrackerInput::Frame(
            Box::new(frame.clone()),
            Stopwatch::start(),
        )));
    }
}

fn publish_outside(stage: &mut TrackStage, events: &Sender<LiveEvent>) {
    for event in stage.take_events() {
        // Nobody has to listen.
        drop(events.send(event));
    }
}

/// Returns when nothing more is received and the map has said its last word.
pub(crate) fn run_track(
    mut stage: TrackStage,
    received: &Receiver<TrackerInput>,
    updates: &Receiver<KeyframeUpdate>,
    events: &Sender<LiveEvent>,
) -> TrackingSummary {
    // Corners are found by parallel loops, which would wait behind the long ones of mapping in the pool that all share.
    // With a pool of its own they run on this thread.
    let alone = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .use_current_thread()
        .build();
    if let Err(e) = &alone {
        tracing::warn!("tracking shares its threads with mapping and may be late: {e}");
    }
    if stage.is_live {
        run_live(&mut stage, received, updates, events);
    } else {
        while let Some(next) = received.recv() {
            match next {
                TrackerInput::Frame(frame, since) => stage.track(&frame, &since),
                TrackerInput::Batch => {
                    if let Some(views) = updates.recv() {
                        stage.update(&views);
                    }
                }
            }
            publish_outside(&mut stage, events);
        }
    }
    while let Some(views) = updates.recv() {
        stage.update(&views);
        publish_outside(&mut stage, events);
    }
    stage.finish(received.dropped())
}

/// Frames first; between them updates of the map, then a second look at frames that it has reached.
fn run_live(
    stage: &mut TrackStage,
    received: &Receiver<TrackerInput>,
    updates: &Receiver<KeyframeUpdate>,
    events: &Sender<LiveEvent>,
) {
    let mut n_since_update = 0;
    loop {
        publish_outside(stage, events);
        let next = match received.try_recv() {
            Ok(Some(next)) => Some(next),
            Ok(None) => {
                n_since_update = MAX_FRAMES_WITHOUT_UPDATE;
                None
            }
            Err(_) => return,
        };
        if n_since_update >= MAX_FRAMES_WITHOUT_UPDATE
            && let Ok(Some(views)) = updates.try_recv()
        {
            n_since_update = 0;
            stage.update(&views);
        }
        let next = match next {
            None if stage.retry() => continue,
            None => received.recv(),
            some => some,
        };
        match next {
            Some(TrackerInput::Frame(frame, since)) => stage.track(&frame, &since),
            Some(TrackerInput::Batch) => {}
            None => return,
        }
        n_since_update += 1;
    }
}
