//! Input -> frames, as a stage: pause, reset and the end are decided here.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::clock::Stopwatch;
use crate::frame::Frame;
use crate::node::Stop;
use crate::publish::outbox::Outbox;
use crate::source::{Polled, Source, SourceCounts};

/// A source that waits for the world is asked so often whether to go on.
const PATIENCE: Duration = Duration::from_millis(100);
/// Its switches are those of services.
pub(super) struct SourceStage {
    source: Box<dyn Source>,
    stop: Stop,
    outbox: Option<Arc<Outbox>>,
    is_mounted: bool,
    pub(super) decode_secs: f64,
}

impl SourceStage {
    pub(super) fn new(source: Box<dyn Source>, stop: Stop, outbox: Option<Arc<Outbox>>) -> Self {
        Self {
            source,
            stop,
            outbox,
            is_mounted: false,
            decode_secs: 0.0,
        }
    }

    /// While paused, frames come and go.
    pub(super) fn next(&mut self) -> Option<Frame> {
        while !self.stop.is_asked() {
            let watch = Stopwatch::start();
            let polled = self.source.poll(PATIENCE);
            if !matches!(polled, Polled::Waiting) {
                self.decode_secs += watch.secs();
            }
            let Some(outbox) = self.outbox.as_ref() else {
                match polled {
                    Polled::Frame(frame) => return Some(*frame),
                    Polled::Ended => return None,
                    Polled::Waiting => continue,
                }
            };
            let warnings = self.source.warnings();
            outbox.note(|standing| standing.source_notes = warnings);
            if let Polled::Frame(frame) = &polled {
                if !self.is_mounted {
                    let mount = self.source.mount();
                    outbox.meet_camera(mount, self.source.camera_frame());
                    self.is_mounted = mount.is_some();
                }
                outbox.note_picture(self.source.counts(), frame.intrinsics.is_some());
            }
            let switches = outbox.switches();
            if switches.wants_reset.swap(false, Ordering::Relaxed) {
                self.stop.ask_restart();
                return None;
            }
            let is_paused = switches.is_paused.load(Ordering::Relaxed);
            outbox.note(|standing| standing.is_paused = is_paused);
            match polled {
                Polled::Frame(frame) if !is_paused => return Some(*frame),
                Polled::Frame(_) | Polled::Waiting => {}
                Polled::Ended => {
                    outbox.note(|standing| standing.has_ended = true);
                    return None;
                }
            }
        }
        None
    }

    pub(super) fn into_source(self) -> Box<dyn Source> {
        self.source
    }

    pub(super) fn counts(&self) -> SourceCounts {
        self.source.counts()
    }
}
