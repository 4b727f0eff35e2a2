//! Posts -> zenoh, under the keys of rmw_zenoh, so that ROS 2 nodes on that middleware see plain topics and services.
//!
//! Late joiners `get` a topic's key and receive its newest message, or the published map. Blocking calls.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use sha2::{Digest, Sha256};
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait};

use crate::error::PublishError;
use crate::latched::LatchedStore;
use crate::params::PublishParams;
use crate::plan::{Plan, PlanSink};
use crate::service_server::ServiceServer;
use crate::transport::{Delivery, Sample, Topic, Transport};
use crate::zenoh::names::Names;
use crate::zenoh::session::open_session;
use splat_msgs::ros::standard::Path;
use splat_msgs::services::{SERVICES, Service};

/// `close` waits no longer. zenoh itself lingers ten seconds over bytes that a stalled peer never takes.
const MAX_CLOSING: Duration = Duration::from_secs(2);
/// Questions that may wait; more are dropped, and their askers see an empty answer.
const MAX_QUESTIONS: usize = 32;
/// Bytes of an attachment's gid.
const GID_BYTES: usize = 16;

/// How one topic leaves.
struct Way {
    key: String,
    /// Names this publisher in attachments.
    gid: [u8; GID_BYTES],
    /// Number of the last message.
    sequence: AtomicI64,
    congestion_control: CongestionControl,
}

impl Way {
    fn attachment(&self, stamp_nanos: i64) -> Vec<u8> {
        let sequence = self.sequence.fetch_add(1, Ordering::Relaxed) + 1;
        attachment(sequence, stamp_nanos, self.gid)
    }
}

/// What has to be taken back at the end.
struct Declared {
    tokens: Vec<LivelinessToken>,
    queryables: Vec<Queryable<()>>,
    threads: Vec<JoinHandle<()>>,
}

type Ways = Arc<BTreeMap<&'static str, Way>>;

/// Sends and answers until it is closed.
pub struct ZenohTransport {
    session: Session,
    ways: Ways,
    declared: Mutex<Option<Declared>>,
    endpoints: Vec<String>,
    names: Names,
}

impl std::fmt::Debug for ZenohTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ZenohFace")
            .field("endpoints", &self.endpoints)
            .finish_non_exhaustive()
    }
}

impl ZenohTransport {
    /// Opens a session and declares topics and services; returns when late joiners can ask.
    pub fn open(
        params: &PublishParams,
        topics: &[&'static Topic],
        latched: Arc<LatchedStore>,
        service_server: Arc<ServiceServer>,
    ) -> Result<Self, PublishError> {
        let names = Names::new(params)?;
        let (session, endpoints) = open_session(params)?;
        let (late_tx, late) = sync_channel(MAX_QUESTIONS);
        let (asked_tx, asked) = sync_channel(MAX_QUESTIONS);
        let mut declared = Declared {
            tokens: vec![declare_token(&session, names.node_token(&session))?],
            queryables: Vec::new(),
            threads: Vec::new(),
        };
        let mut ways = BTreeMap::new();
        for (ix, topic) in topics.iter().enumerate() {
            let key = names.topic_key(topic);
            let token_key = names.topic_token(&session, topic, ix + 1);
            let gid = Sha256::digest(token_key.as_bytes());
            let gid = *gid.first_chunk().expect("SHA-256 is longer than a gid");
            declared
                .queryables
                .push(queryable(&session, &key, *topic, &late_tx)?);
            declared.tokens.push(declare_token(&session, token_key)?);
            let way = Way {
                key,
                gid,
                sequence: AtomicI64::new(0),
                congestion_control: match topic.delivery {
                    Delivery::Newest => CongestionControl::Drop,
                    // Transforms and diagnostics come again soon, and poses wait behind them.
                    Delivery::Reliable { .. } if topic.name.starts_with('/') => {
                        CongestionControl::Drop
                    }
                    // A map without one of its pieces is incomplete.
                    Delivery::Latched { .. } | Delivery::Reliable { .. } => {
                        CongestionControl::Block
                    }
                },
            };
            ways.insert(topic.name, way);
        }
        for (ix, service) in SERVICES.iter().enumerate() {
            let key = names.service_key(service);
            declared
                .queryables
                .push(queryable(&session, &key, service, &asked_tx)?);
            let token_key = names.service_token(&session, service, topics.len() + ix + 1);
            declared.tokens.push(declare_token(&session, token_key)?);
        }
        let ways: Ways = Arc::new(ways);
        let fault = |e: std::io::Error| PublishError::Open {
            endpoints: endpoints.join(" "),
            reason: e.to_string(),
        };
        let sent = Arc::clone(&ways);
        let late_thread = named("zenoh-late", move || send_late(&late, &sent, &latched));
        declared.threads.push(late_thread.map_err(fault)?);
        let service_thread = named("zenoh-services", move || serve(&asked, &service_server));
        declared.threads.push(service_thread.map_err(fault)?);
        tracing::info!("zenoh listens on {}", endpoints.join(" "));
        Ok(Self {
            session,
            ways,
            declared: Mutex::new(Some(declared)),
            endpoints,
            names,
        })
    }
}

impl Transport for ZenohTransport {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        let Some(way) = self.ways.get(post.topic.name) else {
            return Ok(());
        };
        self.session
            .put(&way.key, ZBytes::from(post.payload.to_vec()))
            .congestion_control(way.congestion_control)
            .attachment(way.attachment(post.stamp.nanos))
            .wait()
            .map_err(|e| PublishError::Send {
                key: way.key.clone(),
                reason: e.to_string(),
            })
    }

    fn receive_plans(&self, topic: &str, sink: PlanSink) -> Result<(), PublishError> {
        let key = self.names.incoming_key::<Path>(topic);
        let subscriber = self
            .session
            .declare_subscriber(&key)
            .callback(move |sample| {
                let payload = sample.payload().to_bytes();
                match Plan::read(&payload) {
                    Some(plan) => sink(plan),
                    None => tracing::debug!(
                        "{} bytes on {} are no path",
                        payload.len(),
                        sample.key_expr()
                    ),
                }
            });
        // It ends with the session.
        subscriber
            .background()
            .wait()
            .map_err(|e| PublishError::Open {
                endpoints: key.clone(),
                reason: e.to_string(),
            })
    }

    fn endpoints(&self) -> Vec<String> {
        self.endpoints.clone()
    }

    /// Says goodbye to peers. Waits at most two seconds; what still hangs then is left to its threads.
    fn close(&self) -> Result<(), PublishError> {
        let declared = self
            .declared
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        let Some(declared) = declared else {
            return Ok(());
        };
        let (done_tx, done) = sync_channel(1);
        let session = self.session.clone();
        let closing = named("zenoh-close", move || {
            // Each drops a sender of questions; with the last one their threads end.
            for queryable in declared.queryables {
                if let Err(e) = queryable.undeclare().wait() {
                    tracing::debug!("a zenoh queryable did not undeclare: {e}");
                }
            }
            for token in declared.tokens {
                if let Err(e) = token.undeclare().wait() {
                    tracing::debug!("a zenoh liveliness token did not undeclare: {e}");
                }
            }
            if let Err(e) = session.close().wait() {
                tracing::debug!("zenoh session did not close: {e}");
            }
            for thread in declared.threads {
                if thread.join().is_err() {
                    tracing::warn!("a thread that answers over zenoh panicked");
                }
            }
            // Nobody waits any more when this fails.
            done_tx.send(()).unwrap_or(());
        });
        let is_done = closing.is_ok() && done.recv_timeout(MAX_CLOSING).is_ok();
        if is_done {
            Ok(())
        } else {
            Err(PublishError::Close {
                waited_secs: MAX_CLOSING.as_secs_f64(),
            })
        }
    }
}

fn named(name: &str, body: impl FnOnce() + Send + 'static) -> std::io::Result<JoinHandle<()>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(body)
}

/// Questions go to a thread that may take its time.
fn queryable<T: Sync + 'static>(
    session: &Session,
    key: &str,
    about: &'static T,
    questions: &SyncSender<(&'static T, Query)>,
) -> Result<Queryable<()>, PublishError> {
    let questions = questions.clone();
    session
        .declare_queryable(key)
        .callback(move |query| match questions.try_send((about, query)) {
            Ok(()) | Err(TrySendError::Disconnected(_)) => {}
            Err(TrySendError::Full(_)) => {
                tracing::debug!("a question was turned away: {MAX_QUESTIONS} wait");
            }
        })
        .wait()
        .map_err(|e| PublishError::Declare {
            key: key.to_owned(),
            reason: e.to_string(),
        })
}

fn declare_token(session: &Session, key: String) -> Result<LivelinessToken, PublishError> {
    let token = session.liveliness().declare_token(key.clone()).wait();
    token.map_err(|e| PublishError::Declare {
        key,
        reason: e.to_string(),
    })
}

/// Runs until the last queryable is gone. One question at a time, so a late joiner costs others nothing but time.
fn send_late(questions: &Receiver<(&'static Topic, Query)>, ways: &Ways, latched: &LatchedStore) {
    while let Ok((topic, query)) = questions.recv() {
        let Some(way) = ways.get(topic.name) else {
            continue;
        };
        let sent = latched.send_latched(topic, &mut |post| {
            query
                .reply(&way.key, ZBytes::from(post.payload.to_vec()))
                .attachment(way.attachment(post.stamp.nanos))
                .wait()
                .map_err(|e| PublishError::Send {
                    key: way.key.clone(),
                    reason: e.to_string(),
                })
        });
        if let Err(e) = sent {
            tracing::debug!("a late joiner left before its answer: {e}");
        }
    }
}

/// Runs until the last queryable is gone.
fn serve(questions: &Receiver<(&'static Service, Query)>, service_server: &ServiceServer) {
    while let Ok((service, query)) = questions.recv() {
        // Who looks around with a wildcard must not reset the map.
        let is_for_us = !query.key_expr().is_wild();
        let Some(question) = query.payload().filter(|_| is_for_us).map(ZBytes::to_bytes) else {
            continue;
        };
        let answer = service_server.answer(service.kind, &question);
        // The client knows its question by number and gid.
        let (sequence, gid) = query
            .attachment()
            .and_then(|bytes| asker_of(&bytes.to_bytes()))
            .unwrap_or_default();
        let reply = query.reply(query.key_expr().clone(), answer);
        if let Err(e) = reply.attachment(attachment(sequence, 0, gid)).wait() {
            tracing::debug!("a client of {} left before its answer: {e}", service.name);
        }
    }
}

fn asker_of(attachment: &[u8]) -> Option<(i64, [u8; GID_BYTES])> {
    let sequence = i64::from_le_bytes(*attachment.first_chunk()?);
    Some((sequence, *attachment.get(17..)?.first_chunk()?))
}

/// What rmw_zenoh expects beside the payload: sequence number, source time, length and bytes of the gid. The source
/// time is the data's stamp, so that a replay sends the same bytes each time.
fn attachment(sequence: i64, stamp_nanos: i64, gid: [u8; GID_BYTES]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(17 + GID_BYTES);
    bytes.extend_from_slice(&sequence.to_le_bytes());
    bytes.extend_from_slice(&stamp_nanos.to_le_bytes());
    bytes.push(GID_BYTES as u8);
    bytes.extend_from_slice(&gid);
    bytes
}
