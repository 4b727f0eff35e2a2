//! Bounded queues between threads, each with a name and a stated policy for when it is full.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::Duration;

/// What `send` does when the queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The sender waits: nothing is lost, pressure travels back.
    Wait,
    /// The oldest item makes room and is counted: live input.
    DropOldest,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    sender_is_alive: bool,
    receiver_is_alive: bool,
    dropped: u64,
    sent: u64,
}

#[derive(Debug)]
struct Shared<T> {
    name: &'static str,
    capacity: usize,
    when_full: WhenFull,
    state: Mutex<State<T>>,
    changed: Condvar,
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        // A panic while the lock was held cannot leave the deque half changed.
        self.state
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

#[derive(Debug)]
pub struct Sender<T> {
    shared: Arc<Shared<T>>,
}

#[derive(Debug)]
pub struct Receiver<T> {
    shared: Arc<Shared<T>>,
}

/// One sender, one receiver, at most `capacity` items between them.
pub fn queue<T>(
    name: &'static str,
    capacity: usize,
    when_full: WhenFull,
) -> (Sender<T>, Receiver<T>) {
    assert!(capacity > 0, "queue {name} needs room for one item");
    let state = State {
        items: VecDeque::with_capacity(capacity),
        sender_is_alive: true,
        receiver_is_alive: true,
        dropped: 0,
        sent: 0,
    };
    let shared = Arc::new(Shared {
        name,
        capacity,
        when_full,
        state: Mutex::new(state),
        changed: Condvar::new(),
    });
    (
        Sender {
            shared: Arc::clone(&shared),
        },
        Receiver { shared },
    )
}

impl<T> Sender<T> {
    /// Gives the item back when the receiver is gone.
    pub fn send(&self, item: T) -> Result<(), T> {
        let mut state = self.shared.lock();
        loop {
            if !state.receiver_is_alive {
                return Err(item);
            }
            if state.items.len() < self.shared.capacity {
                break;
            }
            match self.shared.when_full {
                WhenFull::DropOldest => {
                    state.items.pop_front();
                    state.dropped += 1;
                }
                WhenFull::Wait => {
                    state = self
                        .shared
                        .changed
                        .wait(state)
                        .unwrap_or_else(std::sync::PoisonError::into_inner);
                }
            }
        }
        state.items.push_back(item);
        state.sent += 1;
        drop(state);
        self.shared.changed.notify_all();
        Ok(())
    }

    /// Items that made room for newer ones.
    pub fn dropped(&self) -> u64 {
        self.shared.lock().dropped
    }
}

/// Ends a queue from a third side, while its receiver is busy elsewhere.
#[derive(Debug)]
pub struct Closer<T> {
    shared: Arc<Shared<T>>,
}

impl<T> Closer<T> {
    /// As if the receiver were gone: a sender that waits gets its item back. What lies in the queue is thrown away.
    pub fn close(&self) {
        let mut state = self.shared.lock();
        state.receiver_is_alive = false;
        state.items.clear();
        drop(state);
        self.shared.changed.notify_all();
    }
}

impl<T> Receiver<T> {
    pub fn closer(&self) -> Closer<T> {
        Closer {
            shared: Arc::clone(&self.shared),
        }
    }

    /// Waits for an item; `None` once the sender is gone and the queue is empty.
    pub fn recv(&self) -> Option<T> {
        let mut state = self.shared.lock();
        loop {
            if let Some(item) = state.items.pop_front() {
                drop(state);
                self.shared.changed.notify_all();
                return Some(item);
            }
            if !state.sender_is_alive {
                return None;
            }
            state = self
                .shared
                .changed
                .wait(state)
                .unwrap_or_else(std::sync::PoisonError::into_inner);
        }
    }

    /// An item if one is there: `Ok(None)` when empty, `Err(Ended)` when no more will come.
    pub fn try_recv(&self) -> Result<Option<T>, Ended> {
        let mut state = self.shared.lock();
        if let Some(item) = state.items.pop_front() {
            drop(state);
            self.shared.changed.notify_all();
            return Ok(Some(item));
        }
        if state.sender_is_alive {
            Ok(None)
        } else {
            Err(Ended)
        }
    }

    /// Waits for an item, but no longer than `timeout`.
    pub fn recv_timeout(&self, timeout: Duration) -> Received<T> {
        let state = self.shared.lock();
        let is_quiet = |state: &mut State<T>| state.items.is_empty() && state.sender_is_alive;
        let (mut state, _) = self
            .shared
            .changed
            .wait_timeout_while(state, timeout, is_quiet)
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(item) = state.items.pop_front() {
            drop(state);
            self.shared.changed.notify_all();
            return Received::Item(item);
        }
        if state.sender_is_alive {
            Received::Nothing
        } else {
            Received::Ended
        }
    }

    /// Items that wait.
    pub fn len(&self) -> usize {
        self.shared.lock().items.len()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn dropped(&self) -> u64 {
        self.shared.lock().dropped
    }

    pub fn name(&self) -> &'static str {
        self.shared.name
    }
}

/// What came within the time that somebody waited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received<T> {
    Item(T),
    Nothing,
    /// No more will come.
    Ended,
}

/// The sender is gone and every item was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ended;

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        self.shared.lock().sender_is_alive = false;
        self.shared.changed.notify_all();
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        self.shared.lock().receiver_is_alive = false;
        self.shared.changed.notify_all();
    }
}
