//! The request to end a run, and the time that stages get after it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use splat_types::time::Stopwatch;

/// Asks the source to end; everything behind it then ends in order, without the final steps of a replay. Live, the map may get
/// better for `map.finish_secs` after that, which a second request cuts short.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    is_asked: Arc<AtomicBool>,
    is_restarting: Arc<AtomicBool>,
    is_finishing: Arc<AtomicBool>,
    is_cut_short: Arc<AtomicBool>,
}

impl Stop {
    pub fn ask(&self) {
        self.is_asked.store(true, Ordering::Relaxed);
    }

    /// Asks once more: the map is saved as it is. `false`: there is nothing that this would cut short.
    pub fn ask_again(&self) -> bool {
        self.is_finishing.load(Ordering::Relaxed)
            && !self.is_cut_short.swap(true, Ordering::Relaxed)
    }

    /// Whether the map is getting better after its last frame.
    pub(crate) fn set_finishing(&self, is_finishing: bool) {
        self.is_finishing.store(is_finishing, Ordering::Relaxed);
    }

    /// Whether the steps after the last frame are to end. Nobody has a use for them where a fresh map begins.
    pub(crate) fn is_cut_short(&self) -> bool {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        is_set(&self.is_cut_short) || is_set(&self.is_restarting)
    }

    /// For sources, which know no nodes.
    pub fn flag(&self) -> &Arc<AtomicBool> {
        &self.is_asked
    }

    /// Ends this map for a fresh one from the same source.
    pub(crate) fn ask_restart(&self) {
        self.is_restarting.store(true, Ordering::Relaxed);
    }

    /// Whether a fresh map is to begin; forgets it.
    pub(crate) fn takes_restart(&self) -> bool {
        self.is_restarting.swap(false, Ordering::Relaxed) && !self.is_asked()
    }

    pub fn is_asked(&self) -> bool {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        is_set(&self.is_asked) || is_set(&self.is_restarting)
    }
}

/// Seconds since a stop was asked for, as far as who waits for it has looked.
#[derive(Debug, Default)]
pub(crate) struct ShutdownTimeout {
    stop: Stop,
    since: Option<Stopwatch>,
}

impl ShutdownTimeout {
    pub(crate) fn new(stop: Stop) -> Self {
        Self { stop, since: None }
    }

    /// Whether a stop was asked for more than so many seconds ago. The first look after a stop counts as its moment.
    pub(crate) fn is_over(&mut self, secs: f64) -> bool {
        if self.since.is_none() && self.stop.is_asked() {
            self.since = Some(Stopwatch::start());
        }
        self.since.is_some_and(|watch| watch.secs() > secs)
    }
}
