//! Live: when keyframes go to geometry, so that each has its pose soon.
//!
//! Selection waits for nobody. Geometry takes a batch when it has done with the one before; what has gathered meanwhile
//! goes out then. Poses of few keyframes take a fraction of what their depth takes, and do not wait for it.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Keyframes that the first poses are made from: fewer can agree on a wrong place.
const FIRST: usize = 3;

/// Written by geometry, asked by selection.
#[derive(Debug)]
pub(crate) struct Backpressure {
    /// What the model says of itself; else only full batches are of use.
    takes_small: bool,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// There are keyframes that new ones can be registered by.
    has_registered: bool,
    /// A batch is on its way or at work.
    is_sent: bool,
    /// Answers of geometry that the map has not taken in yet.
    n_answers: usize,
    has_ended: bool,
    n_dropped_batches: u64,
}

impl Backpressure {
    pub(crate) fn new(takes_small: bool) -> Self {
        Self {
            takes_small,
            state: Mutex::default(),
        }
    }

    /// Whether a batch of `n_new` new keyframes should go out before it is full.
    pub(crate) fn is_due(&self, n_new: usize) -> bool {
        // Once there is a map, selection waits with a single one: the next is better chosen when geometry takes it.
        let least = if self.lock().has_registered { 1 } else { FIRST };
        self.takes_small && n_new >= least
    }

    /// Whether geometry takes a batch now. After its end too, so that selection learns of it when it sends.
    pub(crate) fn is_open(&self) -> bool {
        let state = self.lock();
        !state.is_sent || state.has_ended
    }

    /// Poses of keyframes are on their way, to geometry or from there to the map: splats and depth wait for them.
    pub(crate) fn is_at_work(&self) -> bool {
        let state = self.lock();
        (state.is_sent || state.n_answers > 0) && !state.has_ended
    }

    /// Selection is about to send a batch. `false`: geometry takes none any more.
    pub(crate) fn send(&self) -> bool {
        let mut state = self.lock();
        state.is_sent = true;
        !state.has_ended
    }

    /// Selection: a batch was given up, since too many wait.
    pub(crate) fn count_dropped_batch(&self) {
        let mut state = self.lock();
        state.n_dropped_batches += 1;
        if state.n_dropped_batches.is_power_of_two() {
            let n = state.n_dropped_batches;
            tracing::warn!(
                "geometry is too slow for this camera: {n} batches of keyframes dropped"
            );
        }
    }

    /// Geometry: whether it has registered keyframes.
    pub(crate) fn note(&self, has_registered: bool) {
        self.lock().has_registered = has_registered;
    }

    /// Geometry: the batch that it took is done.
    pub(crate) fn done(&self) {
        self.lock().is_sent = false;
    }

    /// Geometry: an answer goes to the map.
    pub(crate) fn answer(&self) {
        self.lock().n_answers += 1;
    }

    /// The map has taken in an answer.
    pub(crate) fn answer_taken(&self) {
        let mut state = self.lock();
        state.n_answers = state.n_answers.saturating_sub(1);
    }

    /// Geometry takes no more.
    pub(crate) fn end(&self) {
        self.lock().has_ended = true;
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_start_takes_some_keyframes_and_then_each_goes_out_at_once() {
        let backpressure = Backpressure::new(true);
        assert!(!backpressure.is_due(FIRST - 1) && backpressure.is_due(FIRST));
        backpressure.note(false);
        assert!(!backpressure.is_due(1), "nothing was registered");
        backpressure.note(true);
        assert!(backpressure.is_due(1) && !backpressure.is_due(0));
    }

    #[test]
    fn one_batch_is_at_work_and_the_end_is_seen() {
        let backpressure = Backpressure::new(true);
        assert!(backpressure.is_open() && backpressure.send());
        assert!(!backpressure.is_open(), "the first is at work");
        backpressure.done();
        backpressure.answer();
        assert!(backpressure.is_open() && backpressure.is_at_work());
        backpressure.answer_taken();
        assert!(!backpressure.is_at_work());
        backpressure.end();
        assert!(backpressure.is_open() && !backpressure.send());
    }

    #[test]
    fn a_network_gets_full_batches() {
        let backpressure = Backpressure::new(false);
        backpressure.note(true);
        assert!((1..100).all(|n_new| !backpressure.is_due(n_new)));
    }
}
