//! This process as a ROS 2 node, as the rest of the program holds it: orders to the thread that owns it (`spin`), its names,
//! its parameters, its time. Knows nothing of images and maps.

use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread::JoinHandle;
use std::time::Duration;

use r2r::QosProfile;
use r2r::qos::{DurabilityPolicy, ReliabilityPolicy};
use serde_json::Value;

use crate::ros2::error::{LinkError, MAX_ORDER, start_error};
use crate::ros2::executor::{Order, SPIN, Spun, spin};
use crate::ros2::names::{Names, ros_arguments};
use crate::ros2::parameter_store::Ros2Setup;
use splat_io::survey::header_stamp;
use splat_types::time::{Stamp, Stopwatch};

/// The mapper's name where no argument gives another.
pub const NODE_NAME: &str = "splat_mapper";
/// Orders on their way to the thread.
const MAX_ORDERS: usize = 64;
/// The thread ends within this time, or is left behind.
const MAX_CLOSING: Duration = Duration::from_secs(2);

/// A publisher of a topic, as the graph shows it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    pub node: String,
    pub type_name: String,
    pub is_reliable: bool,
    pub is_latched: bool,
}

/// The node of this process. There is one, since arguments behind `--ros-args` are for the process.
pub struct Link {
    orders: SyncSender<Order>,
    is_ending: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<()>>>,
    pub names: Names,
    /// Parameters of this node, those of ROS 2 applied.
    pub setup: Ros2Setup,
    /// Newest time of `/clock` in ns; `i64::MIN` before the first.
    sim_nanos: Option<Arc<AtomicI64>>,
    /// What keeps the node from receiving what it should, a line each.
    warnings: Mutex<Vec<String>>,
    when_time_jumps: Mutex<Option<Box<dyn Fn() + Send>>>,
}

impl std::fmt::Debug for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Link({:?})", self.names)
    }
}

static CURRENT: Mutex<Weak<Link>> = Mutex::new(Weak::new());

impl Link {
    /// Starts the node, as `name` where no argument gives another. `configure` applies the parameters from ROS 2 (`-p`,
    /// `--params-file`) and returns what the node reads of all parameters, or why they do not fit.
    pub fn open(
        name: &'static str,
        configure: impl FnOnce(Vec<(String, Value)>) -> Result<Ros2Setup, String>,
    ) -> Result<Arc<Self>, LinkError> {
        let (orders, ordered) = sync_channel(MAX_ORDERS);
        let (started_tx, started) = sync_channel(1);
        let is_ending = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&is_ending);
        let thread = std::thread::Builder::new()
            .name("ros2".to_owned())
            .spawn(move || spin(name, &ordered, &started_tx, &asked))
            .map_err(|e| start_error(&e))?;
        let started = started.recv_timeout(MAX_ORDER);
        let started = started.unwrap_or_else(|e| Err(start_error(&e)));
        let applied = started.and_then(|(namespace, node, overrides)| {
            let setup = configure(effective(overrides)).map_err(LinkError::Parameter)?;
            Ok((namespace, node, setup))
        });
        let (namespace, node, setup) = match applied {
            Ok(names) => names,
            Err(error) => {
                // The middleware must not be in use while the process ends.
                end(thread, &is_ending);
                return Err(error);
            }
        };
        let has_sim_time = setup.use_sim_time;
        let link = Arc::new(Self {
            orders,
            is_ending,
            thread: Mutex::new(Some(thread)),
            names: Names::new(&namespace, &node, &ros_arguments()),
            setup,
            sim_nanos: has_sim_time.then(|| Arc::new(AtomicI64::new(i64::MIN))),
            warnings: Mutex::new(Vec::new()),
            when_time_jumps: Mutex::new(None),
        });
        link.follow_clock()?;
        *lock(&CURRENT) = Arc::downgrade(&link);
        tracing::info!(
            "ROS 2 node {} in namespace {}",
            link.names.node,
            link.names.namespace
        );
        Ok(link)
    }

    /// The node that was opened and is still up.
    pub fn current() -> Option<Arc<Self>> {
        lock(&CURRENT).upgrade()
    }

    /// Runs `order` on the thread that owns the node and waits for what it says. `what` is for the error.
    pub fn ask<T: Send + 'static>(
        &self,
        what: &str,
        order: impl FnOnce(&mut Spun) -> r2r::Result<T> + Send + 'static,
    ) -> Result<T, LinkError> {
        let stuck = || LinkError::Stuck {
            what: what.to_owned(),
        };
        let (answer_tx, answer) = sync_channel(1);
        let order: Order = Box::new(move |spun| {
            // Who asked may have given up.
            answer_tx.try_send(order(spun)).ok();
        });
        self.orders.try_send(order).map_err(|_full| stuck())?;
        let answer = answer.recv_timeout(MAX_ORDER).map_err(|_late| stuck())?;
        answer.map_err(|e| LinkError::Refused {
            what: what.to_owned(),
            reason: e.to_string(),
        })
    }

    /// CDR payloads of a topic, header included, until `sink` says false. `sink` runs on the node's thread: it must not wait.
    pub fn subscribe(
        &self,
        topic: &str,
        type_name: &'static str,
        qos: QosProfile,
        sink: impl FnMut(Vec<u8>) -> bool + Send + 'static,
    ) -> Result<(), LinkError> {
        let name = topic.to_owned();
        self.ask(&format!("a subscription to {topic:?}"), move |spun| {
            let stream = spun.node.subscribe_raw(&name, type_name, qos)?;
            spun.drain(stream, sink);
            Ok(())
        })
    }

    /// All topics with the types that are seen on them.
    pub fn topics(&self) -> Result<Vec<(String, Vec<String>)>, LinkError> {
        let mut topics: Vec<_> = self
            .ask("the list of topics", |spun| {
                spun.node.get_topic_names_and_types()
            })?
            .into_iter()
            .collect();
        topics.sort();
        Ok(topics)
    }

    /// Who publishes a topic, remapping rules applied.
    pub fn publishers(&self, topic: &str) -> Result<Vec<Peer>, LinkError> {
        let name = self.names.resolve(topic);
        self.ask(&format!("the publishers of {topic:?}"), move |spun| {
            let infos = spun.node.get_publishers_info_by_topic(&name, false)?;
            let peers = infos.into_iter().map(|info| Peer {
                node: format!(
                    "{}/{}",
                    info.node_namespace.trim_end_matches('/'),
                    info.node_name
                ),
                is_reliable: info.qos_profile.reliability == ReliabilityPolicy::Reliable,
                is_latched: info.qos_profile.durability == DurabilityPolicy::TransientLocal,
                type_name: info.topic_type,
            });
            Ok(peers.collect())
        })
    }

    /// What time it is: that of `/clock` with `use_sim_time`, where one was received.
    pub fn sim_time(&self) -> Option<Stamp> {
        let nanos = self.sim_nanos.as_ref()?.load(Ordering::Relaxed);
        (nanos != i64::MIN).then(|| Stamp::from_nanos(nanos))
    }

    pub fn warnings(&self) -> Vec<String> {
        lock(&self.warnings).clone()
    }

    pub(crate) fn warn(&self, warnings: Vec<String>) {
        *lock(&self.warnings) = warnings;
    }

    /// `action` is to make a new map; it is called on the thread of the source.
    pub fn when_time_jumps(&self, action: impl Fn() + Send + 'static) {
        *lock(&self.when_time_jumps) = Some(Box::new(action));
    }

    /// False when nobody makes a new map.
    pub(crate) fn time_jumped(&self) -> bool {
        let action = lock(&self.when_time_jumps);
        if let Some(action) = action.as_ref() {
            action();
        }
        action.is_some()
    }

    fn follow_clock(&self) -> Result<(), LinkError> {
        let Some(nanos) = self.sim_nanos.clone() else {
            return Ok(());
        };
        let qos = QosProfile::default().keep_last(1).best_effort();
        self.subscribe("/clock", "rosgraph_msgs/msg/Clock", qos, move |payload| {
            // A Clock is a Time and nothing else; headers begin with one.
            if let Some(stamp) = header_stamp(&payload, 0) {
                nanos.store(stamp.nanos, Ordering::Relaxed);
            }
            true
        })
    }

    /// Ends the thread, and with it all subscriptions, publishers and services. Later orders are refused.
    pub fn close(&self) {
        let thread = lock(&self.thread).take();
        if let Some(thread) = thread {
            end(thread, &self.is_ending);
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.close();
    }
}

fn end(thread: JoinHandle<()>, is_ending: &AtomicBool) {
    is_ending.store(true, Ordering::Relaxed);
    let watch = Stopwatch::start();
    while !thread.is_finished() && watch.elapsed() < MAX_CLOSING {
        std::thread::sleep(SPIN);
    }
    if !thread.is_finished() {
        tracing::warn!(
            "the ROS 2 node did not end within {MAX_CLOSING:?}; its thread is left behind"
        );
    } else if thread.join().is_err() {
        tracing::warn!("the thread of the ROS 2 node panicked");
    }
}

/// Overrides without those that have no effect.
fn effective(mut overrides: Vec<(String, Value)>) -> Vec<(String, Value)> {
    overrides.retain(|(key, _)| {
        // rclcpp knows these of its own accord; here QoS is chosen by parameters of the node.
        let has_effect = !key.starts_with("qos_overrides.");
        if !has_effect {
            tracing::warn!("parameter {key} has no effect here");
        }
        has_effect
    });
    overrides
}

/// What these mutexes hold is exchanged whole: a panic leaves nothing half made.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
