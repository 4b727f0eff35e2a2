//! Live: when keyframes go to geometry, so that each has its pose soon.
//!
//! Poses of few keyframes take a fraction of what their depth takes, and need not wait for it. Where keyframes
//! come faster than depth does, selection waits, and frames are dropped and counted.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Keyframes that the first poses are made from: fewer can agree on a wrong place.
const FIRST: usize = 5;
/// Keyframes with a pose whose depth may be outstanding when more are taken: at the start they keep the chain of
/// keyframes from breaking. The newest gets its depth first, so that nobody waits for these.
const MAX_WITHOUT_DEPTH: usize = 8;

/// Recognised by geometry, asked by selection.
#[derive(Debug)]
pub(crate) struct Backpressure {
    /// What the model says of itself; else only full batches are of use.
    takes_small: bool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// There are keyframes that new ones can be registered by.
    has_registered: bool,
    pending_depths: usize,
    /// A batch is on its way or at work.
    is_sent: bool,
    has_ended: bool,
}

impl State {
    fn is_open(&self) -> bool {
        !self.is_sent && self.pending_depths <= MAX_WITHOUT_DEPTH
    }
}

impl Backpressure {
    pub(crate) fn new(takes_small: bool) -> Self {
        Self {
            takes_small,
            state: Mutex::default(),
            changed: Condvar::new(),
        }
    }

    /// Whether a batch of `n_new` new keyframes should go out before it is full.
    pub(crate) fn is_due(&self, n_new: usize) -> bool {
        // Once there is a map, selection waits with a single one: the next is better chosen when geometry takes it.
        let least = if self.lock().has_registered { 1 } else { FIRST };
        self.takes_small && n_new >= least
    }

    /// Selection: waits until geometry takes a batch, which it is about to send. `false`: it takes none any more.
    pub(crate) fn wait_to_send(&self) -> bool {
        let is_shut = |state: &mut State| !state.is_open() && !state.has_ended;
        let state = self.changed.wait_while(self.lock(), is_shut);
        let mut state = state.unwrap_or_else(PoisonError::into_inner);
        state.is_sent = true;
        !state.has_ended
    }

    /// Geometry: how it stands.
    pub(crate) fn note(&self, has_registered: bool, pending_depths: usize) {
        let mut state = self.lock();
        (state.has_registered, state.pending_depths) = (has_registered, pending_depths);
        drop(state);
        self.changed.notify_all();
    }

    /// Geometry: the batch that it took is done.
    pub(crate) fn done(&self) {
        self.lock().is_sent = false;
        self.changed.notify_all();
    }

    /// Geometry takes no more.
    pub(crate) fn end(&self) {
        self.lock().has_ended = true;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn a_start_takes_some_keyframes_and_then_each_goes_out_at_once() {
        let backpressure = Backpressure::new(true);
        assert!(!backpressure.is_due(FIRST - 1) && backpressure.is_due(FIRST));
        backpressure.note(false, 0);
        assert!(!backpressure.is_due(1), "nothing was registered");
        backpressure.note(true, 0);
        assert!(backpressure.is_due(1) && !backpressure.is_due(0));
        backpressure.note(true, MAX_WITHOUT_DEPTH + 1);
        assert!(backpressure.is_due(1), "selection waits with so many");
    }

    #[test]
    fn selection_waits_while_depth_is_behind_and_ends_with_geometry() {
        let backpressure = Arc::new(Backpressure::new(true));
        backpressure.note(true, MAX_WITHOUT_DEPTH + 1);
        let (reported_tx, reported) = std::sync::mpsc::sync_channel(2);
        let waiting = Arc::clone(&backpressure);
        let thread = crate::node::job::spawn("waiting", move || {
            for _ in 0..2 {
                reported_tx.send(waiting.wait_to_send()).unwrap();
            }
        })
        .unwrap();
        let soon = std::time::Duration::from_millis(50);
        assert!(reported.recv_timeout(soon).is_err());
        backpressure.note(true, 0);
        assert_eq!(reported.recv(), Ok(true));
        assert!(reported.recv_timeout(soon).is_err(), "the first is at work");
        backpressure.end();
        assert_eq!(reported.recv(), Ok(false));
        thread.join().unwrap();
    }

    #[test]
    fn a_network_gets_full_batches() {
        let backpressure = Backpressure::new(false);
        backpressure.note(true, 0);
        assert!((1..100).all(|n_new| !backpressure.is_due(n_new)));
    }
}
