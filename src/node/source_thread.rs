//! Input -> frames, as a stage: pause, reset and the end are decided here.

use std::sync::atomic::Ordering;
use std::time::Duration;

use crate::node::stop::Stop;
use splat_io::frame_source::{Polled, Source, SourceCounts};
use splat_ros::output::OutputHandles;
use splat_types::frame::Frame;
use splat_types::time::Stopwatch;

/// A source that waits for the world is asked so often whether to go on.
const PATIENCE: Duration = Duration::from_millis(100);
/// Its controls are those of services.
pub(crate) struct SourceStage {
    source: Box<dyn Source>,
    stop: Stop,
    output: Option<OutputHandles>,
    is_mounted: bool,
    pub(crate) decode_secs: f64,
}

impl SourceStage {
    pub(crate) fn new(source: Box<dyn Source>, stop: Stop, output: Option<OutputHandles>) -> Self {
        Self {
            source,
            stop,
            output,
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
            let Some(OutputHandles {
                reports, controls, ..
            }) = &self.output
            else {
                match polled {
                    Polled::Frame(frame) => return Some(*frame),
                    Polled::Ended => return None,
                    Polled::Waiting => continue,
                }
            };
            let warnings = self.source.warnings();
            reports.source.update(|status| status.warnings = warnings);
            if let Polled::Frame(frame) = &polled {
                if !self.is_mounted {
                    let mount = self.source.mount();
                    let name = self.source.camera_frame();
                    reports.camera.update(|camera| camera.update(mount, name));
                    self.is_mounted = mount.is_some();
                }
                let counts = self.source.counts();
                reports.source.update(|status| {
                    status.since_image = Stopwatch::start();
                    status.counts = counts;
                    status.is_calibrated = frame.intrinsics.is_some();
                });
            }
            if controls.wants_reset.swap(false, Ordering::Relaxed) {
                self.stop.ask_restart();
                return None;
            }
            let is_paused = controls.is_paused.load(Ordering::Relaxed);
            reports.source.update(|status| status.is_paused = is_paused);
            match polled {
                Polled::Frame(frame) if !is_paused => return Some(*frame),
                Polled::Frame(_) | Polled::Waiting => {}
                Polled::Ended => {
                    reports.source.update(|status| status.has_ended = true);
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
