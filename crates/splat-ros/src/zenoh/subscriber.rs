//! What a mapper elsewhere publishes over zenoh, for programs that look on.

use std::time::Duration;

use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::error::PublishError;
use crate::params::PublishParams;
use crate::zenoh::session::open_session;

const QUERY_TIMEOUT: Duration = Duration::from_secs(10);
/// Where the publisher's id begins in the attachment that rmw_zenoh sends with each message: behind a number, a time and a length.
const GID_AT: usize = 17;

/// A message of the mapper.
#[derive(Debug, Clone)]
pub struct Received {
    pub dds_type: String,
    pub payload: Vec<u8>,
    /// Of the publisher: another one is another run.
    pub gid: Vec<u8>,
}

/// Everything below a mapper's name.
#[derive(Debug)]
pub struct MapSubscriber {
    session: Session,
    live: Subscriber<FifoChannelHandler<Sample>>,
    key: String,
}

impl MapSubscriber {
    /// Connects to `publish.zenoh_connect`, else looks for peers by multicast.
    pub fn open(params: &PublishParams) -> Result<Self, PublishError> {
        let (session, _) = open_session(params)?;
        let key = format!("{}/{}/**", params.domain_id, params.namespace);
        let live = session.declare_subscriber(&key).wait();
        let live = live.map_err(|e| PublishError::Open {
            endpoints: key.clone(),
            reason: e.to_string(),
        })?;
        Ok(Self { session, live, key })
    }

    /// What late joiners get: the newest map, and the newest message of other topics.
    pub fn newest(&self) -> Vec<Received> {
        // All chunks have one key: without this setting zenoh would keep only the last one.
        let query = self
            .session
            .get(&self.key)
            .consolidation(ConsolidationMode::None);
        let query = query
            .congestion_control(CongestionControl::Block)
            .timeout(QUERY_TIMEOUT);
        let Ok(replies) = query.wait() else {
            return Vec::new();
        };
        let samples = replies
            .into_iter()
            .filter_map(|reply| reply.into_result().ok());
        samples.filter_map(|sample| received(&sample)).collect()
    }

    /// The next message, if it comes within `patience`.
    pub fn next(&self, patience: Duration) -> Option<Received> {
        let sample = self.live.recv_timeout(patience).ok().flatten()?;
        received(&sample)
    }
}

/// Keys: domain / namespace / topic / type / hash.
fn received(sample: &Sample) -> Option<Received> {
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
    })
}
