//! The thread that owns the node: it makes what others ask for and hands on what comes in.
//!
//! r2r keeps ten messages of a subscription and then drops the newest; all of them are emptied after each message, so that
//! what is lost is lost in queues of ours, which count.

use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
use std::time::Duration;

use futures::{FutureExt, Stream, StreamExt};
use serde_json::Value;

use crate::ros2::error::{LinkError, start_error};
use splat_types::time::Stopwatch;

/// Longest sleep of the thread; orders wait no longer.
pub(crate) const SPIN: Duration = Duration::from_millis(5);
/// Shortest turn of the thread.
const MIN_SPIN: Duration = Duration::from_micros(100);
const NEVER: Duration = Duration::from_secs(1 << 30);

pub(crate) type Order = Box<dyn FnOnce(&mut Spun) + Send>;

/// What the thread owns.
pub struct Spun {
    pub node: r2r::Node,
    /// Each empties one stream; false once nobody wants more of it.
    inlets: Vec<Box<dyn FnMut() -> bool>>,
    /// Never rings: without anything to wait for, rcl complains and r2r spins (its issue 93).
    _timer: r2r::Timer,
}

impl std::fmt::Debug for Spun {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Spun({} streams)", self.inlets.len())
    }
}

impl Spun {
    /// Hands each item of a stream to `sink`, on this thread, until `sink` says false.
    pub fn drain<T: 'static>(
        &mut self,
        mut stream: impl Stream<Item = T> + Unpin + 'static,
        mut sink: impl FnMut(T) -> bool + 'static,
    ) {
        self.inlets.push(Box::new(move || {
            while let Some(Some(item)) = stream.next().now_or_never() {
                if !sink(item) {
                    return false;
                }
            }
            true
        }));
    }
}

/// Namespace, name, and parameters by key.
pub(crate) type Started = (String, String, Vec<(String, Value)>);

pub(crate) fn spin(
    name: &str,
    orders: &Receiver<Order>,
    started: &SyncSender<Result<Started, LinkError>>,
    is_ending: &AtomicBool,
) {
    let mut spun = match start(name) {
        Ok((spun, names)) => {
            started.try_send(Ok(names)).ok();
            spun
        }
        Err(error) => {
            started.try_send(Err(error)).ok();
            return;
        }
    };
    while !is_ending.load(Ordering::Relaxed) {
        loop {
            match orders.try_recv() {
                Ok(order) => order(&mut spun),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return,
            }
        }
        let watch = Stopwatch::start();
        spun.node.spin_once(SPIN);
        spun.inlets.retain_mut(|inlet| inlet());
        // After an error spin_once returns at once.
        if watch.elapsed() < MIN_SPIN {
            std::thread::sleep(MIN_SPIN);
        }
    }
}

fn start(name: &str) -> Result<(Spun, Started), LinkError> {
    // r2r panics where rcl refuses an argument.
    let context = std::panic::catch_unwind(r2r::Context::create);
    let context = context.map_err(|panic| LinkError::Start {
        reason: panic.downcast_ref::<String>().cloned().unwrap_or_default(),
    })?;
    let context = context.map_err(|e| start_error(&e))?;
    let mut node = r2r::Node::create(context, name, "").map_err(|e| start_error(&e))?;
    let timer = node.create_wall_timer(NEVER).map_err(|e| start_error(&e))?;
    let namespace = node.namespace().map_err(|e| start_error(&e))?;
    let name = node.name().map_err(|e| start_error(&e))?;
    let overrides = {
        let given = node.params.lock().unwrap_or_else(PoisonError::into_inner);
        let pairs = given
            .iter()
            .map(|(key, parameter)| (key.clone(), json_of(&parameter.value)));
        pairs.collect()
    };
    let spun = Spun {
        node,
        inlets: Vec::new(),
        _timer: timer,
    };
    Ok((spun, (namespace, name, overrides)))
}

fn json_of(value: &r2r::ParameterValue) -> Value {
    use r2r::ParameterValue as P;
    match value {
        P::NotSet => Value::Null,
        P::Bool(v) => (*v).into(),
        P::Integer(v) => (*v).into(),
        P::Double(v) => (*v).into(),
        P::String(v) => v.clone().into(),
        // No parameter of ours is a list; the settings say so.
        other => format!("{other:?}").into(),
    }
}
