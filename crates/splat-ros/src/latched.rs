//! What late joiners get: the newest message of each topic, and the published map in pieces.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::error::PublishError;
use crate::transport::{Delivery, Sample, Topic};
use splat_msgs::map_messages::{KeyframeArray, Messages, SplatChunk, SplatManifest};
use splat_types::snapshot::Snapshot;
use splat_types::splats::layout;

pub static KEYFRAMES: Topic =
    Topic::of::<KeyframeArray>("keyframes", Delivery::Latched { depth: 64 });
/// Late joiners of ROS 2 ask the service `get_splats`: no middleware should keep a map twice.
pub static SPLATS: Topic = Topic::of::<SplatChunk>("splats", Delivery::Reliable { depth: 1000 });
pub static MANIFEST: Topic =
    Topic::of::<SplatManifest>("splats/manifest", Delivery::Latched { depth: 1 });
pub static TOPICS: [&Topic; 3] = [&KEYFRAMES, &MANIFEST, &SPLATS];

/// The published map, with the digest of its splats: that takes a pass over all of them.
#[derive(Debug, Clone)]
pub struct PublishedMap {
    pub snapshot: Arc<Snapshot>,
    map_sha256: [u8; 32],
}

#[derive(Debug, Default)]
struct LatchedSample {
    /// By topic, unless they are pieces of the map.
    newest: BTreeMap<&'static str, Sample>,
    map: Option<PublishedMap>,
}

/// Shared by all transports and services.
#[derive(Debug)]
pub struct LatchedStore {
    kept: Mutex<LatchedSample>,
    splat_frame: String,
    chunk_bytes: usize,
}

impl LatchedStore {
    pub fn new(splat_frame: &str, chunk_bytes: usize) -> Self {
        Self {
            kept: Mutex::default(),
            splat_frame: splat_frame.to_owned(),
            chunk_bytes,
        }
    }

    fn kept(&self) -> MutexGuard<'_, LatchedSample> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn keep(&self, post: &Sample) {
        self.kept().newest.insert(post.topic.name, post.clone());
    }

    pub(crate) fn keep_map(&self, snapshot: &Arc<Snapshot>) -> PublishedMap {
        let map = PublishedMap {
            snapshot: Arc::clone(snapshot),
            map_sha256: layout::digest(&snapshot.splats),
        };
        self.kept().map = Some(map.clone());
        map
    }

    pub fn map(&self) -> Option<PublishedMap> {
        self.kept().map.clone()
    }

    pub fn splat_frame(&self) -> &str {
        &self.splat_frame
    }

    /// A map cut into messages.
    pub fn messages<'a>(&'a self, map: &'a PublishedMap) -> Messages<'a> {
        let (frame, chunk_bytes) = (&self.splat_frame, self.chunk_bytes);
        Messages::of_known(&map.snapshot, map.map_sha256, frame, chunk_bytes)
    }

    /// Hands what a late joiner of a topic should have to `send`, until that fails.
    pub fn send_latched(
        &self,
        topic: &Topic,
        send: &mut dyn FnMut(&Sample) -> Result<(), PublishError>,
    ) -> Result<(), PublishError> {
        let is_of_map = [&KEYFRAMES, &SPLATS, &MANIFEST]
            .iter()
            .any(|of_map| of_map.name == topic.name);
        if !is_of_map {
            let newest = self.kept().newest.get(topic.name).cloned();
            return newest.as_ref().map_or(Ok(()), send);
        }
        let Some(map) = self.map() else {
            return Ok(());
        };
        let (messages, stamp) = (self.messages(&map), map.snapshot.stamp);
        if topic.name == MANIFEST.name {
            send(&Sample::of(&MANIFEST, stamp, &messages.manifest())?)?;
        } else if topic.name == KEYFRAMES.name {
            for array in messages.keyframes() {
                send(&Sample::of(&KEYFRAMES, stamp, &array)?)?;
            }
        } else {
            for chunk in messages.chunks() {
                send(&Sample::of(&SPLATS, stamp, &chunk)?)?;
            }
        }
        Ok(())
    }
}
