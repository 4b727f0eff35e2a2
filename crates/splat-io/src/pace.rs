//! Stamps of frames -> waits, so that a recording plays at the speed at which it was taken, or a multiple of it.

use std::time::Duration;

use splat_types::time::{Stamp, Stopwatch};

/// Longest wait between two frames, so that a jump of the recording's clock does not stop it.
const MAX_WAIT_SECS: f64 = 2.0;

#[derive(Debug, Clone)]
pub struct Pace {
    /// Multiple of the recording's speed; 0: nothing waits.
    rate: f64,
    began: Option<(Stopwatch, Stamp)>,
}

impl Pace {
    pub fn new(rate: f64) -> Self {
        Self { rate, began: None }
    }

    /// Returns when the time of this frame has come.
    pub fn wait_for(&mut self, stamp: Stamp) {
        if self.rate <= 0.0 {
            return;
        }
        let Some((watch, first)) = self.began else {
            self.began = Some((Stopwatch::start(), stamp));
            return;
        };
        let wait = stamp.secs_since(first) / self.rate - watch.secs();
        if wait > MAX_WAIT_SECS {
            std::thread::sleep(Duration::from_secs_f64(MAX_WAIT_SECS));
            self.began = Some((Stopwatch::start(), stamp));
        } else if wait > 0.0 {
            std::thread::sleep(Duration::from_secs_f64(wait));
        }
    }
}
