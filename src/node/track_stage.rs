//! Frames and what the map says of its keyframes -> poses: the tracker as a stage, and the thread that it runs on.

use std::collections::VecDeque;

use crate::clock::Stopwatch;
use crate::config::track::TrackParams;
use crate::frame::Frame;
use crate::queue::{Receiver, Sender, WhenFull};
use crate::track::{KeyframeView, State, TrackedFrame, Tracker, Tracks};

/// Times that the figures of a run are made from: those of the last two hours at 15 Hz.
const MAX_TIMES: usize = 100_000;
/// Live, where the queue is never empty: frames after which news of the map are taken in all the same.
const MAX_FRAMES_WITHOUT_NEWS: usize = 10;

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
}

/// What tracking leaves behind.
#[derive(Debug, Default)]
pub struct Tracking {
    pub tracks: Tracks,
    /// What a later run needs to find its place in the map; empty without tracking.
    pub landmarks: Vec<u8>,
    /// Live: frames that made room for newer ones before they were tracked.
    pub n_dropped: u64,
    /// Seconds of work, in all and per frame.
    pub secs: f64,
    pub frame_secs: Vec<f64>,
    /// Live: seconds from the arrival of a frame to its pose.
    pub latency_secs: Vec<f64>,
}

impl TrackStage {
    pub(super) fn new(params: &TrackParams, is_live: bool) -> Self {
        Self {
            tracker: params.enabled.then(|| Tracker::new(params)),
            is_live,
            said: State::Initialising,
            secs: 0.0,
            frame_secs: VecDeque::new(),
            latency_secs: VecDeque::new(),
            saved_to: None,
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

    /// From now on tells landmarks every `secs`.
    pub(super) fn tell_landmarks(&mut self, secs: f64, to: Sender<Vec<u8>>) {
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

    pub(super) fn is_on(&self) -> bool {
        self.tracker.is_some()
    }

    pub(super) fn track(&mut self, frame: &Frame, since: &Stopwatch) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        let watch = Stopwatch::start();
        let tracked = tracker.track(frame);
        self.secs += watch.secs();
        note(&mut self.frame_secs, watch.secs());
        if self.is_live && tracked.is_measured() {
            note(&mut self.latency_secs, since.secs());
        }
        self.say(&tracked);
    }

    /// In a replay, frames that the map has reached get their second look at once.
    pub(super) fn update(&mut self, news: &[KeyframeView]) {
        let Some(tracker) = &mut self.tracker else {
            return;
        };
        let watch = Stopwatch::start();
        tracker.update(news);
        if !self.is_live {
            tracker.look_again(usize::MAX);
        }
        self.save_if_due();
        self.secs += watch.secs();
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
        let tracks = self.tracker.take().map(Tracker::finish);
        Tracking {
            landmarks: landmarks.unwrap_or_else(|reason| {
                tracing::warn!("later runs will not find their place in this map: {reason}");
                Vec::new()
            }),
            tracks: tracks.unwrap_or_default(),
            n_dropped,
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

/// Queue policies of (what is heard, news of the map).
pub(super) fn policies(is_live: bool) -> (WhenFull, WhenFull) {
    if is_live {
        (WhenFull::DropOldest, WhenFull::DropOldest)
    } else {
        (WhenFull::Wait, WhenFull::Wait)
    }
}

/// Sends a frame to the tracker, if there is one; the picture is shared.
pub(super) fn tell(heard: Option<&Sender<Heard>>, frame: &Frame) {
    if let Some(heard) = heard {
        // A tracker that is gone is no reason to stop mapping.
        drop(heard.send(Heard::Frame(Box::new(frame.clone()), Stopwatch::start())));
    }
}

/// Returns when nothing more is heard and the map has said its last word.
pub(super) fn run_track(
    mut stage: TrackStage,
    heard: &Receiver<Heard>,
    news: &Receiver<News>,
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
        run_live(&mut stage, heard, news);
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
        }
    }
    while let Some(views) = news.recv() {
        stage.update(&views);
    }
    stage.finish(heard.dropped())
}

/// Frames first; between them news of the map, then a second look at frames that it has reached.
fn run_live(stage: &mut TrackStage, heard: &Receiver<Heard>, news: &Receiver<News>) {
    let mut n_since_news = 0;
    loop {
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
