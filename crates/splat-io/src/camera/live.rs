//! A camera that may stop and come back -> its images with stamps.
//!
//! A camera that is unplugged, fails or falls silent is closed, said once, and opened again until it answers.
//! Meanwhile nothing comes out, and whoever maps goes on with what there is.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::camera::driver::{Camera, Layout};
use crate::camera::stamps::{N_READINGS, StampMap};
use crate::camera_error::CameraError;
use crate::queue::Received;
use splat_types::time::{Stamp, Stopwatch};

/// How long one wait for an image lasts; then Ctrl-C and silence are looked at.
const TICK: Duration = Duration::from_millis(100);
/// Between attempts to open a camera again: it must go on within 2 s of its return.
const RETRY: Duration = Duration::from_millis(250);
/// Without an image for so long, or for so many images' time, a camera counts as silent.
const SILENT_SECS: f64 = 2.0;
const SILENT_IMAGES: f64 = 4.0;
/// Some cameras take long for their first image: each silence in a row allows twice the time, up to this.
const MAX_PATIENCE: f64 = 8.0;

/// Opens the camera, at the start and after each fault.
pub type Opener = Box<dyn FnMut() -> Result<Box<dyn Camera>, CameraError> + Send>;

/// How a camera is.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CameraStatus {
    pub is_streaming: bool,
    /// Why it does not.
    pub fault: Option<String>,
    pub n_interruptions: u64,
}

/// Health that another thread may look at.
#[derive(Debug, Clone, Default)]
pub struct CameraStatusWatch {
    health: Arc<Mutex<CameraStatus>>,
}

impl CameraStatusWatch {
    pub fn get(&self) -> CameraStatus {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, CameraStatus> {
        self.health.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What happened since it was last asked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Numbers that the driver skipped.
    pub missed: u64,
    pub damaged: u64,
    pub interruptions: u64,
}

/// How long a camera has given nothing, and what was done about it.
struct Silence {
    /// Since the last good image, or since it was opened.
    since_capture: Stopwatch,
    since_attempt: Stopwatch,
    only_damaged: bool,
    /// Factor of the time that an open camera may be silent.
    patience: f64,
    outage: Option<Stopwatch>,
}

impl Silence {
    fn none() -> Self {
        Self {
            since_capture: Stopwatch::start(),
            since_attempt: Stopwatch::start(),
            only_damaged: false,
            patience: 1.0,
            outage: None,
        }
    }
}

pub struct Live {
    name: String,
    open: Opener,
    camera: Option<Box<dyn Camera>>,
    layout: Layout,
    stamps: StampMap,
    last_sequence: Option<u32>,
    silence: Silence,
    tally: Tally,
    health: CameraStatusWatch,
    asked: Arc<AtomicBool>,
    deadline: Option<(Stopwatch, f64)>,
}

impl std::fmt::Debug for Live {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Live({}, {:?})", self.name, self.health.get())
    }
}

impl Live {
    pub fn open(name: String, mut open: Opener) -> Result<Self, CameraError> {
        let camera = open()?;
        let layout = camera.layout();
        let stamps = StampMap::of((0..N_READINGS).map(|_| camera.read_clocks()));
        let health = CameraStatusWatch::default();
        health.lock().is_streaming = true;
        Ok(Self {
            name,
            open,
            camera: Some(camera),
            layout,
            stamps,
            last_sequence: None,
            silence: Silence::none(),
            tally: Tally::default(),
            health,
            asked: Arc::default(),
            deadline: None,
        })
    }

    /// Of the newest images.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    pub fn health(&self) -> CameraStatusWatch {
        self.health.clone()
    }

    pub fn end_when(&mut self, asked: &Arc<AtomicBool>) {
        self.asked = Arc::clone(asked);
    }

    /// Ends so many seconds from now, whether images come or not.
    pub fn end_after(&mut self, secs: f64) {
        self.deadline = Some((Stopwatch::start(), secs));
    }

    fn is_over(&self) -> bool {
        let is_late = |(watch, secs): &(Stopwatch, f64)| watch.secs() >= *secs;
        self.asked.load(Ordering::Relaxed) || self.deadline.as_ref().is_some_and(is_late)
    }

    pub fn take_tally(&mut self) -> Tally {
        std::mem::take(&mut self.tally)
    }

    /// Waits for a good image and hands it to `take`; `None` at the end.
    pub fn next<R>(&mut self, take: impl FnOnce(&Layout, Stamp, &[u8]) -> R) -> Option<R> {
        match self.next_within(Duration::MAX, take) {
            Received::Item(taken) => Some(taken),
            Received::Nothing | Received::Ended => None,
        }
    }

    /// The same, but waits no longer than that, give or take a tenth of a second.
    pub fn next_within<R>(
        &mut self,
        patience: Duration,
        take: impl FnOnce(&Layout, Stamp, &[u8]) -> R,
    ) -> Received<R> {
        let watch = Stopwatch::start();
        loop {
            if self.is_over() {
                return Received::Ended;
            }
            if watch.elapsed() >= patience {
                return Received::Nothing;
            }
            let Some(camera) = &mut self.camera else {
                self.try_again();
                continue;
            };
            match camera.next(TICK) {
                Ok(Some(captured)) => {
                    let missed = gap(self.last_sequence, captured.sequence);
                    self.tally.missed += missed;
                    self.last_sequence = captured.sequence;
                    if captured.is_damaged {
                        self.tally.damaged += 1;
                        self.silence.only_damaged = true;
                    } else {
                        let stamp = self.stamps.stamp(captured.taken_nanos, &captured.now);
                        let taken = take(&self.layout, stamp, captured.bytes);
                        self.went_well();
                        return Received::Item(taken);
                    }
                }
                Ok(None) => {}
                Err(error) => {
                    self.lose(error.to_string());
                    continue;
                }
            }
            self.check_silence();
        }
    }

    fn went_well(&mut self) {
        self.silence.since_capture = Stopwatch::start();
        self.silence.only_damaged = false;
        self.silence.patience = 1.0;
        if let Some(outage) = self.silence.outage.take() {
            tracing::warn!(
                "the camera is back after {:.1} s: {}",
                outage.secs(),
                self.name
            );
            let mut health = self.health.lock();
            health.is_streaming = true;
            health.fault = None;
        }
    }

    fn check_silence(&mut self) {
        let interval = self.layout.rate_hz.map_or(0.0, |hz| 1.0 / hz.max(1e-3));
        let allowed = SILENT_SECS.max(SILENT_IMAGES * interval) * self.silence.patience;
        let silent = self.silence.since_capture.secs();
        if silent > allowed {
            let what = if self.silence.only_damaged {
                "only damaged images"
            } else {
                "no image"
            };
            self.silence.patience = (2.0 * self.silence.patience).min(MAX_PATIENCE);
            let name = &self.name;
            self.lose(format!("{what} for {silent:.1} s, it may hang: {name}"));
        }
    }

    /// Closes the camera and says why, once per outage and reason.
    fn lose(&mut self, why: String) {
        self.camera = None;
        self.last_sequence = None;
        // At once, then at intervals.
        self.silence.since_attempt = Stopwatch::start();
        if self.silence.outage.is_none() {
            self.silence.outage = Some(Stopwatch::start());
            self.tally.interruptions += 1;
            self.health.lock().n_interruptions += 1;
        }
        self.report(why);
    }

    fn report(&self, why: String) {
        let mut health = self.health.lock();
        health.is_streaming = false;
        if health.fault.as_ref() != Some(&why) {
            tracing::error!("{why}; it is opened again as soon as it answers");
            health.fault = Some(why);
        }
    }

    fn try_again(&mut self) {
        let wait = RETRY.saturating_sub(self.silence.since_attempt.elapsed());
        if !wait.is_zero() {
            std::thread::sleep(wait.min(TICK));
            return;
        }
        match (self.open)() {
            Ok(camera) => {
                self.layout = camera.layout();
                self.camera = Some(camera);
                self.silence.since_capture = Stopwatch::start();
                self.silence.only_damaged = false;
            }
            Err(error) => self.report(error.to_string()),
        }
        self.silence.since_attempt = Stopwatch::start();
    }
}

/// Images between two numbers, which wrap. A number that repeats or runs back indicates no loss.
fn gap(last: Option<u32>, sequence: Option<u32>) -> u64 {
    let (Some(last), Some(sequence)) = (last, sequence) else {
        return 0;
    };
    let step = sequence.wrapping_sub(last);
    if step == 0 || step > u32::MAX / 2 {
        return 0;
    }
    u64::from(step - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skipped_numbers_are_counted_across_the_wrap_and_repeats_are_not() {
        assert_eq!(gap(None, Some(7)), 0);
        assert_eq!(gap(Some(7), Some(8)), 0);
        assert_eq!(gap(Some(7), Some(7)), 0);
        assert_eq!(gap(Some(7), Some(22)), 14);
        assert_eq!(gap(Some(u32::MAX), Some(0)), 0);
        assert_eq!(gap(Some(u32::MAX - 1), Some(2)), 3);
        assert_eq!(gap(Some(900), Some(3)), 0);
    }
}
