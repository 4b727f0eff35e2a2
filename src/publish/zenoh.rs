//! Snapshots -> zenoh, under the keys of rmw_zenoh, so that ROS 2 nodes on that middleware see plain topics.
//!
//! Four topics under `<domain>/<namespace>/`: `pose`, `keyframes`, `splats`, `splats/manifest`. Late joiners `get`
//! the same keys and receive the newest snapshot. Blocking calls; the caller brings the thread.

use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::Serialize;
use sha2::{Digest, Sha256};
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait};

use crate::config::PublishParams;
use crate::map::snapshot::Snapshot;
use crate::publish::PublishError;
use crate::publish::type_hash::{dds_type_name, type_hash};
use crate::publish::wire::{self, KeyframeArray, Messages, SplatChunk, SplatManifest};
use crate::publish::zenoh_session::open_session;
use crate::ros::{Message, PoseStamped};

/// `close` waits no longer. zenoh itself lingers ten seconds over bytes that a stalled peer never takes.
const MAX_CLOSING: Duration = Duration::from_secs(2);
/// Questions of late joiners that may wait; more are dropped, and their askers see an empty answer.
const MAX_QUESTIONS: usize = 32;

/// The topics in the order of `Topics`.
const POSE: usize = 0;
const KEYFRAMES: usize = 1;
const SPLATS: usize = 2;
const MANIFEST: usize = 3;

/// A message ready to go, as often as it is asked for; both parts share their bytes with every copy.
#[derive(Clone)]
struct Outgoing {
    payload: ZBytes,
    attachment: ZBytes,
}

/// The newest snapshot, by topic.
type Outgoings = [Vec<Outgoing>; 4];
type Latest = Arc<Mutex<Arc<Outgoings>>>;

struct Topic {
    key: String,
    /// Names this publisher in attachments.
    gid: [u8; 16],
    /// Number of the last message.
    sequence: i64,
    congestion_control: CongestionControl,
    queryable: Queryable<()>,
    /// Lets `ros2 topic list` see the topic.
    token: LivelinessToken,
}

impl Topic {
    fn outgoing<T: Message + Serialize>(
        &mut self,
        message: &T,
        stamp_nanos: i64,
    ) -> Result<Outgoing, PublishError> {
        self.sequence += 1;
        let attachment = attachment(self.sequence, stamp_nanos, self.gid);
        Ok(Outgoing {
            payload: ZBytes::from(wire::payload(message)?),
            attachment: ZBytes::from(attachment),
        })
    }
}

/// Sends snapshots until it is closed.
pub struct ZenohPublisher {
    session: Session,
    topics: [Topic; 4],
    node_token: LivelinessToken,
    latest: Latest,
    answers: JoinHandle<()>,
    endpoints: Vec<String>,
    chunk_bytes: usize,
}

impl std::fmt::Debug for ZenohPublisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ZenohPublisher")
            .field("endpoints", &self.endpoints)
            .finish_non_exhaustive()
    }
}

impl ZenohPublisher {
    /// Opens a session and declares the topics; returns when late joiners can ask.
    pub fn open(params: &PublishParams) -> Result<Self, PublishError> {
        let names = Names::new(params)?;
        let (session, endpoints) = open_session(params)?;
        let latest = Latest::default();
        let (questions_tx, questions) = sync_channel(MAX_QUESTIONS);
        let topics = [
            names.declare::<PoseStamped>(&session, POSE, CongestionControl::Drop, &questions_tx)?,
            // A snapshot without its keyframes is incomplete: they travel like chunks.
            names.declare::<KeyframeArray>(
                &session,
                KEYFRAMES,
                CongestionControl::Block,
                &questions_tx,
            )?,
            names.declare::<SplatChunk>(
                &session,
                SPLATS,
                CongestionControl::Block,
                &questions_tx,
            )?,
            names.declare::<SplatManifest>(
                &session,
                MANIFEST,
                CongestionControl::Block,
                &questions_tx,
            )?,
        ];
        let node_token = declare_token(&session, names.node_token(&session))?;
        let keys = topics.each_ref().map(|topic| topic.key.clone());
        let shared = Arc::clone(&latest);
        let answers = std::thread::Builder::new()
            .name("zenoh-answers".to_owned())
            .spawn(move || answer(&questions, &keys, &shared))
            .map_err(|e| PublishError::Open {
                endpoints: endpoints.join(" "),
                reason: e.to_string(),
            })?;
        Ok(Self {
            session,
            topics,
            node_token,
            latest,
            answers,
            endpoints,
            chunk_bytes: params.chunk_bytes,
        })
    }

    /// Where peers may connect, for example `tcp/127.0.0.1:40123`; port 0 of the parameter is resolved.
    pub fn endpoints(&self) -> Vec<String> {
        self.endpoints.clone()
    }

    /// Sends a whole snapshot; returns when zenoh has taken all of it. Waits for slow peers, for dead ones at most
    /// two seconds.
    pub fn publish(&mut self, snapshot: &Arc<Snapshot>) -> Result<(), PublishError> {
        let outgoings = Arc::new(self.encode(snapshot)?);
        // Before the first message goes out: who subscribed too late for it finds it here.
        *self.latest.lock().unwrap_or_else(PoisonError::into_inner) = Arc::clone(&outgoings);
        for topic_ix in [POSE, MANIFEST, KEYFRAMES, SPLATS] {
            let topic = &self.topics[topic_ix];
            for outgoing in &outgoings[topic_ix] {
                self.session
                    .put(&topic.key, outgoing.payload.clone())
                    .congestion_control(topic.congestion_control)
                    .attachment(outgoing.attachment.clone())
                    .wait()
                    .map_err(|e| PublishError::Send {
                        key: topic.key.clone(),
                        reason: e.to_string(),
                    })?;
            }
        }
        Ok(())
    }

    fn encode(&mut self, snapshot: &Snapshot) -> Result<Outgoings, PublishError> {
        let messages = Messages::new(snapshot, self.chunk_bytes);
        let stamp_nanos = snapshot.stamp.nanos;
        let [pose, keyframes, splats, manifest] = &mut self.topics;
        Ok([
            messages
                .pose()
                .map(|message| pose.outgoing(&message, stamp_nanos))
                .into_iter()
                .collect::<Result<_, _>>()?,
            messages
                .keyframes()
                .map(|message| keyframes.outgoing(&message, stamp_nanos))
                .collect::<Result<_, _>>()?,
            messages
                .chunks()
                .map(|message| splats.outgoing(&message, stamp_nanos))
                .collect::<Result<_, _>>()?,
            vec![manifest.outgoing(&messages.manifest(), stamp_nanos)?],
        ])
    }

    /// Says goodbye to peers. Waits at most two seconds; what still hangs then is left to its threads.
    pub fn close(self) -> Result<(), PublishError> {
        let (done_tx, done) = sync_channel(1);
        let Self {
            session,
            topics,
            node_token,
            answers,
            ..
        } = self;
        let closing = std::thread::Builder::new()
            .name("zenoh-close".to_owned())
            .spawn(move || {
                for topic in topics {
                    undeclare(topic.token);
                    // Drops the sender of questions; with the last one `answers` ends.
                    if let Err(e) = topic.queryable.undeclare().wait() {
                        tracing::debug!("zenoh queryable {:?} did not undeclare: {e}", topic.key);
                    }
                }
                undeclare(node_token);
                if let Err(e) = session.close().wait() {
                    tracing::debug!("zenoh session did not close: {e}");
                }
                if answers.join().is_err() {
                    tracing::warn!("the thread that answers late joiners panicked");
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

/// How keys are spelled for one run.
struct Names {
    domain_id: u32,
    /// `a/b`, or empty.
    namespace: String,
}

impl Names {
    const TOPICS: [&str; 4] = ["pose", "keyframes", "splats", "splats/manifest"];

    fn new(params: &PublishParams) -> Result<Self, PublishError> {
        let namespace = params.namespace.trim_matches('/').to_owned();
        let is_name = |part: &str| {
            part.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        if !namespace.split('/').all(is_name) {
            return Err(PublishError::Param {
                name: "namespace",
                found: params.namespace.clone(),
                expected: "letters, digits and underscores, parts joined by /".to_owned(),
            });
        }
        Ok(Self {
            domain_id: params.domain_id,
            namespace,
        })
    }

    fn key<T: Message>(&self, topic: &str) -> String {
        format!(
            "{}/{}/{topic}/{}/{}",
            self.domain_id,
            self.namespace,
            dds_type_name::<T>(),
            type_hash::<T>()
        )
    }

    /// The node is the last part of the namespace, the rest is the node's namespace; `%` stands for `/`.
    fn node(&self) -> String {
        match self.namespace.rsplit_once('/') {
            Some((parent, node)) => format!("%/%{}/{node}", parent.replace('/', "%")),
            None => format!("%/%/{}", self.namespace),
        }
    }

    fn node_token(&self, session: &Session) -> String {
        format!(
            "@ros2_lv/{}/{}/0/0/NN/{}",
            self.domain_id,
            session.zid(),
            self.node()
        )
    }

    /// `::,10:,:,:,,` stands for reliable, volatile, the last ten.
    fn topic_token<T: Message>(&self, session: &Session, topic_ix: usize) -> String {
        format!(
            "@ros2_lv/{}/{}/0/{}/MP/{}/%{}/{}/{}/::,10:,:,:,,",
            self.domain_id,
            session.zid(),
            topic_ix + 1,
            self.node(),
            format!("{}/{}", self.namespace, Self::TOPICS[topic_ix]).replace('/', "%"),
            dds_type_name::<T>(),
            type_hash::<T>(),
        )
    }

    fn declare<T: Message>(
        &self,
        session: &Session,
        topic_ix: usize,
        congestion_control: CongestionControl,
        questions: &SyncSender<(usize, Query)>,
    ) -> Result<Topic, PublishError> {
        let key = self.key::<T>(Self::TOPICS[topic_ix]);
        let token_key = self.topic_token::<T>(session, topic_ix);
        let gid = Sha256::digest(token_key.as_bytes());
        let questions = questions.clone();
        let queryable = session
            .declare_queryable(&key)
            .callback(move |query| match questions.try_send((topic_ix, query)) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => {}
                Err(TrySendError::Full(_)) => {
                    tracing::debug!("a late joiner was turned away: {MAX_QUESTIONS} wait");
                }
            })
            .wait()
            .map_err(|e| PublishError::Declare {
                key: key.clone(),
                reason: e.to_string(),
            })?;
        let token = declare_token(session, token_key)?;
        let gid = *gid.first_chunk().expect("SHA-256 is longer than a gid");
        Ok(Topic {
            key,
            gid,
            sequence: 0,
            congestion_control,
            queryable,
            token,
        })
    }
}

fn declare_token(session: &Session, key: String) -> Result<LivelinessToken, PublishError> {
    let token = session.liveliness().declare_token(key.clone()).wait();
    token.map_err(|e| PublishError::Declare {
        key,
        reason: e.to_string(),
    })
}

fn undeclare(token: LivelinessToken) {
    if let Err(e) = token.undeclare().wait() {
        tracing::debug!("zenoh liveliness token did not undeclare: {e}");
    }
}

/// Runs until the last queryable is gone. One question at a time, so a late joiner costs others nothing but time.
fn answer(questions: &Receiver<(usize, Query)>, keys: &[String; 4], latest: &Latest) {
    while let Ok((topic_ix, query)) = questions.recv() {
        let outgoings = Arc::clone(&latest.lock().unwrap_or_else(PoisonError::into_inner));
        for outgoing in &outgoings[topic_ix] {
            let reply = query.reply(&keys[topic_ix], outgoing.payload.clone());
            if let Err(e) = reply.attachment(outgoing.attachment.clone()).wait() {
                tracing::debug!("a late joiner left before its answer: {e}");
                break;
            }
        }
    }
}

/// What rmw_zenoh expects beside the payload: sequence number, source time, length and bytes of the gid. The source
/// time is the data's stamp, so that a replay sends the same bytes each time.
fn attachment(sequence: i64, stamp_nanos: i64, gid: [u8; 16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(33);
    bytes.extend_from_slice(&sequence.to_le_bytes());
    bytes.extend_from_slice(&stamp_nanos.to_le_bytes());
    bytes.push(gid.len() as u8);
    bytes.extend_from_slice(&gid);
    bytes
}
