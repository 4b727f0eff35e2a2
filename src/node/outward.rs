//! What the stages have to say -> the outbox: poses and status on a thread of their own, snapshots on another.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::Receiver as Calls;
use std::time::Duration;

use crate::clock::Stopwatch;
use crate::config::track::TrackParams;
use crate::export::ply;
use crate::map::snapshot::Snapshot;
use crate::map::{SplatMap, checkpoint};
use crate::node::Stop;
use crate::publish::PublishError;
use crate::publish::outbox::Outbox;
use crate::publish::overview::SeenKeyframe;
use crate::publish::service::{Answer, Call, Request};
use crate::publish::world::LiveFrame;
use crate::queue::{Received, Receiver};
use crate::track::Tracker;

/// Transforms go out at least so often: consumers like to look back no further (Nav2: 10 Hz, better 20).
const REPEAT: Duration = Duration::from_millis(30);
const STATUS_SECS: f64 = 1.0;
/// Seconds between words of the same trouble.
const COMPLAIN_SECS: f64 = 10.0;

/// What the tracker has to say.
#[derive(Debug)]
pub(super) enum LiveEvent {
    Frame(Box<LiveFrame>),
    Keyframe(Box<SeenKeyframe>),
}

/// A snapshot, and whether it is the last one.
pub(super) type Outgoing = (Arc<Snapshot>, bool);

/// Says what goes wrong, but not with every message.
#[derive(Debug, Default)]
pub(super) struct Complaints {
    since: Option<Stopwatch>,
}

impl Complaints {
    fn of(&mut self, sent: Result<(), PublishError>) {
        let Err(e) = sent else { return };
        // A client that is gone or slow must not end the run.
        if self.since.is_none_or(|watch| watch.secs() > COMPLAIN_SECS) {
            tracing::warn!("a message did not go out: {e}");
            self.since = Some(Stopwatch::start());
        }
    }
}

fn say(outbox: &Outbox, event: &LiveEvent) -> Result<(), PublishError> {
    match event {
        LiveEvent::Frame(frame) => outbox.live(frame),
        LiveEvent::Keyframe(seen) => outbox.keyframe(seen),
    }
}

/// Runs until the tracker has ended.
pub(super) fn run_live(outbox: &Outbox, events: &Receiver<LiveEvent>) {
    let mut complaints = Complaints::default();
    let mut since_status = Stopwatch::start();
    complaints.of(outbox.status());
    loop {
        match events.recv_timeout(REPEAT) {
            Received::Item(event) => complaints.of(say(outbox, &event)),
            Received::Nothing => complaints.of(outbox.repeat_transforms()),
            Received::Ended => break,
        }
        if since_status.secs() >= STATUS_SECS {
            since_status = Stopwatch::start();
            complaints.of(outbox.status());
        }
    }
    complaints.of(outbox.status());
}

/// Runs until the map has ended.
pub(super) fn run_publisher(outbox: Option<&Outbox>, snapshots: &Receiver<Outgoing>) {
    let mut complaints = Complaints::default();
    while let Some(outgoing) = snapshots.recv() {
        if let Some(outbox) = outbox {
            publish_or_say(outbox, &outgoing, &mut complaints);
        }
    }
}

/// In sequence: all that has come up.
pub(super) fn say_all(outbox: &Outbox, events: &[LiveEvent], complaints: &mut Complaints) {
    events
        .iter()
        .for_each(|event| complaints.of(say(outbox, event)));
}

pub(super) fn publish_or_say(outbox: &Outbox, outgoing: &Outgoing, complaints: &mut Complaints) {
    complaints.of(publish(outbox, outgoing));
}

fn publish(outbox: &Outbox, (snapshot, is_last): &Outgoing) -> Result<(), PublishError> {
    if *is_last {
        outbox.publish_last(snapshot)
    } else {
        outbox.publish(snapshot)
    }
}

/// What calls from outside are answered with, besides the map.
#[derive(Debug)]
pub(super) struct Clerk {
    /// To begin again from a saved map; `None` once the input has ended.
    stop: Option<Stop>,
    wanted: String,
    calls: Option<Calls<Call>>,
    track: TrackParams,
    /// What the tracker tells of its landmarks now and then, and the newest of it.
    told: Option<Receiver<Vec<u8>>>,
    landmarks: Vec<u8>,
}

impl Clerk {
    pub(super) fn new(calls: Option<Calls<Call>>, track: &TrackParams, stop: Stop) -> Self {
        Self {
            calls,
            stop: Some(stop),
            wanted: String::new(),
            track: track.clone(),
            told: None,
            landmarks: Vec::new(),
        }
    }

    pub(super) fn hear_landmarks(&mut self, told: Receiver<Vec<u8>>) {
        self.told = Some(told);
    }

    /// The newest that the tracker has told; empty before.
    pub(super) fn landmarks(&mut self) -> &[u8] {
        while let Some(Ok(Some(newest))) = self.told.as_ref().map(Receiver::try_recv) {
            self.landmarks = newest;
        }
        &self.landmarks
    }

    /// Those of the map before, where there are any.
    pub(super) fn keep_calls(&mut self, calls: Option<Calls<Call>>) {
        self.calls = calls.or(self.calls.take());
    }

    /// For the time after this map.
    pub(super) fn take_calls(&mut self) -> Option<Calls<Call>> {
        self.calls.take()
    }

    /// Answers what has been asked since.
    pub(super) fn serve(&mut self, map: &mut SplatMap) {
        while let Some(call) = self.calls.as_ref().and_then(|calls| calls.try_recv().ok()) {
            let answer = self.answer(map, &call.request);
            if let Answer::Refused(reason) = &answer {
                tracing::warn!("a service was refused: {reason}");
            }
            call.reply(answer);
        }
    }

    fn answer(&mut self, map: &mut SplatMap, request: &Request) -> Answer {
        let done = |what: &str, written: Result<(), String>| match written {
            Ok(()) => Answer::Done(what.to_owned()),
            Err(reason) => Answer::Refused(reason),
        };
        match request {
            Request::Save(path) => done("the map was saved", self.save(map, path)),
            Request::Export(path) => {
                let snapshot = map.snapshot();
                let written = ply::write(&snapshot.splats, path);
                done(
                    "the splats were written",
                    written.map_err(|e| e.to_string()),
                )
            }
            Request::Load(path) => match self.load(path) {
                Ok(()) => Answer::Done("mapping goes on from the saved map".to_owned()),
                Err(reason) => Answer::Refused(reason),
            },
            Request::Render {
                splats_from_cam,
                intrinsics,
            } => match map.render(splats_from_cam, intrinsics) {
                Some(picture) => Answer::Picture(picture),
                None => Answer::Refused("there is no map yet".to_owned()),
            },
        }
    }

    /// The map that mapping is to go on from after a restart; empty for a fresh one.
    pub(super) fn take_wanted(&mut self) -> String {
        std::mem::take(&mut self.wanted)
    }

    /// No restart from here on: the input has ended.
    pub(super) fn at_end(mut self) -> Self {
        self.stop = None;
        self
    }

    /// What cannot be read is refused, and the present map goes on.
    fn load(&mut self, path: &Path) -> Result<(), String> {
        let Some(stop) = &self.stop else {
            return Err("the input has ended; start a run on the saved map with --map".to_owned());
        };
        let saved = checkpoint::read(path).map_err(|e| e.to_string())?;
        Tracker::in_saved(&saved.landmarks, &self.track)
            .map_err(|reason| format!("no camera could be found in that map: {reason}"))?;
        self.wanted = path.to_string_lossy().into_owned();
        stop.ask_restart();
        Ok(())
    }

    /// With landmarks, so that a later run finds its place.
    fn save(&mut self, map: &mut SplatMap, path: &Path) -> Result<(), String> {
        let mut landmarks = Vec::new();
        if map.has_all_pictures() {
            let mut tracker = Tracker::new(&self.track);
            tracker.update(&map.keyframe_views());
            landmarks = tracker.saved()?;
        }
        // Keyframes of a saved map, and those on disk, only the tracker remembers.
        if landmarks.is_empty() {
            landmarks = self.landmarks().to_vec();
        }
        map.save(landmarks, path).map_err(|e| e.to_string())
    }
}
