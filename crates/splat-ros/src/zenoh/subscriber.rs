//! What a mapper elsewhere publishes over zenoh, and planners beside it, for programs that look on.

use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::error::PublishError;
use crate::params::PublishParams;
use crate::zenoh::names::Names;
use crate::zenoh::session::open_session;
use splat_msgs::ros::TfMessage;
use splat_msgs::ros::standard::Path;

const QUERY_TIMEOUT: Duration = Duration::from_secs(10);
/// Messages that may wait for who looks on; then zenoh waits.
const MAX_WAITING: usize = 256;
/// Where the publisher's id begins in the attachment that rmw_zenoh sends with each message: behind a number, a time and a length.
const GID_AT: usize = 17;

/// A message of the mapper.
#[derive(Debug, Clone)]
pub struct Received {
    pub dds_type: String,
    pub payload: Vec<u8>,
    /// Of the publisher: another one is another run.
    pub gid: Vec<u8>,
    /// It came on `publish.plan_topic`.
    pub is_plan: bool,
}

/// Everything below a mapper's name, transforms, and paths of planners.
#[derive(Debug)]
pub struct MapSubscriber {
    session: Session,
    received: Receiver<Received>,
    /// Messages come as long as they are there.
    _live: Vec<Subscriber<()>>,
    keys: Vec<String>,
}

impl MapSubscriber {
    /// Connects to `publish.zenoh_connect`, else looks for peers by multicast.
    pub fn open(params: &PublishParams) -> Result<Self, PublishError> {
        let names = Names::new(params)?;
        let (session, _) = open_session(params)?;
        let mut keys = vec![
            format!("{}/{}/**", params.domain_id, params.namespace),
            names.incoming_key::<TfMessage>("/tf"),
            names.incoming_key::<TfMessage>("/tf_static"),
        ];
        let plan_key = names.incoming_key::<Path>(&params.plan_topic);
        if !params.plan_topic.is_empty() {
            keys.push(plan_key.clone());
        }
        let (sender, received) = sync_channel(MAX_WAITING);
        let mut live = Vec::new();
        for key in &keys {
            let sender = sender.clone();
            let is_plan = *key == plan_key;
            let subscriber = session.declare_subscriber(key).callback(move |sample| {
                if let Some(message) = read(&sample, is_plan) {
                    // Whoever looks on no longer misses it.
                    sender.send(message).ok();
                }
            });
            live.push(subscriber.wait().map_err(|e| PublishError::Open {
                endpoints: key.clone(),
                reason: e.to_string(),
            })?);
        }
        Ok(Self {
            session,
            received,
            _live: live,
            keys,
        })
    }

    /// What late joiners get: the newest map, and the newest message of other topics.
    pub fn newest(&self) -> Vec<Received> {
        self.keys.iter().flat_map(|key| self.ask(key)).collect()
    }

    fn ask(&self, key: &str) -> Vec<Received> {
        // All chunks have one key: without this setting zenoh would keep only the last one.
        let query = self.session.get(key).consolidation(ConsolidationMode::None);
        let query = query
            .congestion_control(CongestionControl::Block)
            .timeout(QUERY_TIMEOUT);
        let Ok(replies) = query.wait() else {
            return Vec::new();
        };
        let samples = replies
            .into_iter()
            .filter_map(|reply| reply.into_result().ok());
        samples.filter_map(|sample| read(&sample, false)).collect()
    }

    /// The next message, if it comes within `patience`.
    pub fn next(&self, patience: Duration) -> Option<Received> {
        self.received.recv_timeout(patience).ok()
    }
}

/// Keys: domain / namespace / topic / type / hash.
fn read(sample: &Sample, is_plan: bool) -> Option<Received> {
    let dds_type = sample.key_expr().as_str().rsplit('/').nth(1)?.to_owned();
    let attachment = sample
        .attachment()
        .map(|bytes| bytes.to_bytes().into_owned());
    let gid = attachment
        .unwrap_or_default()
        .get(GID_AT..)
        .unwrap_or_default()
        .to_vec();
    Some(Received {
        dds_type,
        payload: sample.payload().to_bytes().into_owned(),
        gid,
        is_plan,
    })
}
