//! Frames and what the map says of its keyframes -> poses: the tracker as a stage, and the thread that it runs on.

use std::collections::VecDeque;

use crate::clock::Stopwatch;
use crate::config::track::TrackParams;
use crate::frame::Frame;
use crate::node::Grace;
use crate::node::fitting::Asker;
use crate::node::outward::LiveEvent;
use crate::pose::Rigid;
use crate::pose::Similarity;
use crate::publish::overview::SeenKeyframe;
use crate::publish::world::LiveFrame;
use crate::queue::{Receiver, Sender};
use crate::track::{FramePlace, KeyframeView, State, TrackedFrame, Tracker, Tracks};

/// Times that the figures of a run are made from: those of the last two hours at 15 Hz.
const MAX_TIMES: usize = 100_000;
/// Live, where the queue is never empty: frames after which news of the map are taken in all the same.
const MAX_FRAMES_WITHOUT_NEWS: usize = 10;

/// Seconds that frames which still wait get after a stop.
const SECS_AFTER_STOP: f64 = 0.3;

/// Seconds between landmarks for map files that somebody may ask for.
const TELL_SECS: f64 = 20.0;

/// What the tracker hears, in order.
pub(super) enum Heard {
    /// A frame, and the time since it came.
    Frame(Box<Frame>, Stopwatch),
    /// Replay: the keyframes of one more batch must have their place before the next frame is tracked, so that what
    /// a frame is tracked by does not hang on how fast the threads are.
    Batch,
}

/// All keyframes of the map at one moment.
pub(super) type News = Vec<KeyframeView>;

/// Frames -> poses.
#[derive(Debug)]
pub(super) struct TrackStage {
    /// `None`: tracking is off.
    tracker: Option<Tracker>,
    is_live: bool,
    said: State,
    secs: f64,
    frame_secs: VecDeque<f64>,
    latency_secs: VecDeque<f64>,
    /// Who keeps landmarks for a map file that is written while the run goes on, how often, and since when.
    saved_to: Option<(Sender<Vec<u8>>, f64, Stopwatch)>,
    /// How the map has moved under the camera since the last frame.
    moved: Option<Similarity>,
    /// The last keyframe whose depth went out.
    shown: Option<u32>,
    /// What is to be said outside; kept empty where nobody listens.
    events: Vec<LiveEvent>,
    is_heard: bool,
    /// Who finds where pictures fit the splats.
    pub(super) asker: Option<Asker>,
    pub(super) grace: Grace,
    /// Frames that had come before a stop and were left.
    n_left: u64,
}

/// What tracking leaves behind.
#[derive(Debug, Default)]
pub struct Tracking {
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
    pub(super) fn new(params: &TrackParams, is_live: bool) -> Self {
        Self::of(params.enabled.then(|| Tracker::new(params)), is_live)
    }

    /// `None`: tracking is off.
    pub(super) fn of(tracker: Option<Tracker>, is_live: bool) -> Self {
        Self {
            tracker,
            is_live,
            said: State::Initialising,
            secs: 0.0,
            frame_secs: VecDeque::new(),
            latency_secs: VecDeque::new(),
            saved_to: None,
            moved: None,
            shown: None,
            events: Vec::new(),
            is_heard: false,
            asker: None,
            grace: Grace::default(),
            n_left: 0,
        }
    }

    /// Begins in a map that was saved, without an idea of where.
    pub(super) fn begin_in(&mut self, saved: &[u8], params: &TrackParams) -> anyhow::Result<()> {
        if self.tracker.is_some() && !saved.is_empty() {
            let tracker = Tracker::in_saved(saved, params).map_err(anyhow::Error::msg)?;
            self.tracker = Some(tracker);
        }
        Ok(())
    }

    /// From now on tells landmarks for map files that are written every `secs`; 0: whenever somebody asks.
    pub(super) fn tell_landmarks(&mut self, secs: f64, to: Sender<Vec<u8>>) {
        let secs = if secs > 0.0 { secs } else { TELL_SECS };
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
    pub(super) fn heard(self, is_heard: bool) -> Self {
        Self { is_heard, ..self }
    }

    /// What has come up since the last time.
    pub(super) fn take_events(&mut self) -> Vec<LiveEvent> {
        std::mem::take(&mut self.events)
    }

    pub(super) fn is_on(&self) -> bool {
        self.tracker.is_some()
    }

    pub(super) fn track(&mut self, frame: &Frame, since: &Stopwatch) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        if self.grace.is_over(SECS_AFTER_STOP) {
            self.n_left += 1;
            return;
        }
        let watch = Stopwatch::start();
        let fitted = self.asker.as_ref().and_then(Asker::answer);
        if let Some((placement, key_from_cam)) = fitted {
            tracker.fitted(&placement, key_from_cam);
        }
        let tracked = tracker.track(frame);
        if let Some((asker, placement)) = self.asker.as_ref().zip(tracker.placement()) {
            asker.ask(placement, frame);
        }
        self.secs += watch.secs();
        note(&mut self.frame_secs, watch.secs());
        if self.is_live && tracked.is_measured() {
            note(&mut self.latency_secs, since.secs());
        }
        self.say(&tracked);
        let moved = self.moved.take();
        if self.is_heard {
            self.events.push(LiveEvent::Frame(Box::new(LiveFrame {
                tracked,
                odom_from_cam: frame.odometry,
                base_from_cam: None,
                moved,
                latency_secs: since.secs(),
            })));
        }
    }

    /// Asks for a better pose of the last frame, relative to the keyframe that it was tracked by.
    pub(super) fn fit(&mut self, better: &mut dyn FnMut(&FramePlace) -> Option<Rigid>) {
        if let Some(tracker) = &mut self.tracker
            && let Some(placement) = tracker.placement()
            && let Some(key_from_cam) = better(&placement)
        {
            tracker.fitted(&placement, key_from_cam);
        }
    }

    /// In a replay, frames that the map has reached get their second look at once.
    pub(super) fn update(&mut self, news: &[KeyframeView]) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        let watch = Stopwatch::start();
        let before = tracker.last_pose();
        tracker.update(news);
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
            tracker.look_again(usize::MAX);
        }
        self.save_if_due();
        self.secs += watch.secs();
        if self.is_heard {
            self.show(news);
        }
    }

    /// The depth of the newest keyframe, once.
    fn show(&mut self, news: &[KeyframeView]) {
        let newest = news.iter().rev().find(|view| view.depth.width_px > 0);
        let Some(view) = newest.filter(|view| self.shown < Some(view.keyframe.id)) else {
            return;
        };
        self.shown = Some(view.keyframe.id);
        self.events.push(LiveEvent::Keyframe(Box::new(SeenKeyframe {
            stamp: view.keyframe.frame.stamp,
            image: std::sync::Arc::clone(&view.keyframe.frame.image),
            intrinsics: view.intrinsics,
            depth: std::sync::Arc::clone(&view.depth),
        })));
    }

    /// Returns whether there was a frame to look at.
    fn look_again(&mut self) -> bool {
        let watch = Stopwatch::start();
        let tracker = self.tracker.as_mut();
        let n_looks = tracker.map_or(0, |tracker| tracker.look_again(1));
        self.secs += watch.secs();
        n_looks > 0
    }

    pub(super) fn finish(mut self, n_dropped: u64) -> Tracking {
        let watch = Stopwatch::start();
        let saved = self.tracker.as_ref().map(Tracker::saved);
        let landmarks = saved.unwrap_or_else(|| Ok(Vec::new()));
        let mut grace = self.grace;
        let goes_on = || !grace.is_over(SECS_AFTER_STOP);
        let tracks = self.tracker.take().map(|tracker| tracker.finish(goes_on));
        Tracking {
            landmarks: landmarks.unwrap_or_else(|reason| {
                tracing::warn!("later runs will not find their place in this map: {reason}");
                Vec::new()
            }),
            tracks: tracks.unwrap_or_default(),
            n_dropped: n_dropped + self.n_left,
            secs: self.secs + watch.secs(),
            frame_secs: self.frame_secs.into(),
            latency_secs: self.latency_secs.into(),
        }
    }

    fn say(&mut self, tracked: &TrackedFrame) {
        if tracked.state == self.said {
            return;
        }
        let stamp = tracked.stamp;
        match (tracked.state, &tracked.reason) {
            (State::Lost, Some(reason)) => tracing::warn!("tracking is lost at {stamp}: {reason}"),
            (State::Relocalised, _) => tracing::info!("found again at {stamp}"),
            (State::Tracking, _) if self.said != State::Relocalised => {
                tracing::info!("tracking at {stamp}");
            }
            _ => {}
        }
        self.said = tracked.state;
    }
}

fn note(times: &mut VecDeque<f64>, secs: f64) {
    if times.len() == MAX_TIMES {
        times.pop_front();
    }
    times.push_back(secs);
}

/// Sends a frame to the tracker, if there is one; the picture is shared.
pub(super) fn tell(heard: Option<&Sender<Heard>>, frame: &Frame) {
    if let Some(heard) = heard {
        // A tracker that is gone is no reason to stop mapping.
        drop(heard.send(Heard::Frame(Box::new(frame.clone()), Stopwatch::start())));
    }
}

fn tell_outside(stage: &mut TrackStage, events: &Sender<LiveEvent>) {
    for event in stage.take_events() {
        // Nobody has to listen.
        drop(events.send(event));
    }
}

/// Returns when nothing more is heard and the map has said its last word.
pub(super) fn run_track(
    mut stage: TrackStage,
    heard: &Receiver<Heard>,
    news: &Receiver<News>,
    events: &Sender<LiveEvent>,
) -> Tracking {
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
        run_live(&mut stage, heard, news, events);
    } else {
        while let Some(next) = heard.recv() {
            match next {
                Heard::Frame(frame, since) => stage.track(&frame, &since),
                Heard::Batch => {
                    if let Some(views) = news.recv() {
                        stage.update(&views);
                    }
                }
            }
            tell_outside(&mut stage, events);
        }
    }
    while let Some(views) = news.recv() {
        stage.update(&views);
        tell_outside(&mut stage, events);
    }
    stage.finish(heard.dropped())
}

/// Frames first; between them news of the map, then a second look at frames that it has reached.
fn run_live(
    stage: &mut TrackStage,
    heard: &Receiver<Heard>,
    news: &Receiver<News>,
    events: &Sender<LiveEvent>,
) {
    let mut n_since_news = 0;
    loop {
        tell_outside(stage, events);
        let next = match heard.try_recv() {
            Ok(Some(next)) => Some(next),
            Ok(None) => {
                n_since_news = MAX_FRAMES_WITHOUT_NEWS;
                None
            }
            Err(_) => return,
        };
        if n_since_news >= MAX_FRAMES_WITHOUT_NEWS
            && let Ok(Some(views)) = news.try_recv()
        {
            n_since_news = 0;
            stage.update(&views);
        }
        let next = match next {
            None if stage.look_again() => continue,
            None => heard.recv(),
            some => some,
        };
        match next {
            Some(Heard::Frame(frame, since)) => stage.track(&frame, &since),
            Some(Heard::Batch) => {}
            None => return,
        }
        n_since_news += 1;
    }
}
