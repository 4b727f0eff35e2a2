//! Input -> frames, as a stage: pause, reset and the end are decided here.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::node::stop::Stop;
use splat_io::frame_source::{Polled, Source, SourceCounts};
use splat_ros::publisher::Publisher;
use splat_types::frame::Frame;
use splat_types::time::Stopwatch;

/// A source that waits for the world is asked so often whether to go on.
const PATIENCE: Duration = Duration::from_millis(100);
/// Its controls are those of services.
pub(crate) struct SourceStage {
    source: Box<dyn Source>,
    stop: Stop,
    publisher: Option<Arc<Publisher>>,
    is_mounted: bool,
    pub(crate) decode_secs: f64,
}

impl SourceStage {
    pub(crate) fn new(
        source: Box<dyn Source>,
        stop: Stop,
        publisher: Option<Arc<Publisher>>,
    ) -> Self {
        Self {
            source,
            stop,
            publisher,
            is_mounted: false,
            decode_secs: 0.0,
        }
    }

    /// While paused, frames come and go.
    pub(crate) fn next(&mut self) -> Option<Frame> {
        while !self.stop.is_asked() {
            let watch = Stopwatch::start();
            let polled = self.source.poll(PATIENCE);
            if !matches!(polled, Polled::Waiting) {
                self.decode_secs += watch.secs();
            }
            let Some(publisher) = self.publisher.as_ref() else {
                match polled {
                    Polled::Frame(frame) => return Some(*frame),
                    Polled::Ended => return None,
                    Polled::Waiting => continue,
                }
            };
            let warnings = self.source.warnings();
            publisher.note(|status| status.source_notes = warnings);
            if let Polled::Frame(frame) = &polled {
                if !self.is_mounted {
                    let mount = self.source.mount();
                    publisher.set_camera(mount, self.source.camera_frame());
                    self.is_mounted = mount.is_some();
                }
                publisher.note_image(self.source.counts(), frame.intrinsics.is_some());
            }
            let controls = publisher.controls();
            if controls.wants_reset.swap(false, Ordering::Relaxed) {
                self.stop.ask_restart();
                return None;
            }
            let is_paused = controls.is_paused.load(Ordering::Relaxed);
            publisher.note(|status| status.is_paused = is_paused);
            match polled {
                Polled::Frame(frame) if !is_paused => return Some(*frame),
                Polled::Frame(_) | Polled::Waiting => {}
                Polled::Ended => {
                    publisher.note(|status| status.has_ended = true);
                    return None;
                }
            }
        }
        None
    }

    pub(crate) fn into_source(self) -> Box<dyn Source> {
        self.source
    }

    pub(crate) fn counts(&self) -> SourceCounts {
        self.source.counts()
    }
}
