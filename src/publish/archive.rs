//! What late joiners get: the newest message of each topic, and the published map in pieces.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::map::layout;
use crate::map::snapshot::Snapshot;
use crate::publish::PublishError;
use crate::publish::face::{Delivery, Post, Topic};
use crate::publish::wire::{KeyframeArray, Messages, SplatChunk, SplatManifest};

pub static KEYFRAMES: Topic =
    Topic::of::<KeyframeArray>("keyframes", Delivery::Latched { depth: 64 });
/// Late joiners of ROS 2 ask the service `get_splats`: no middleware should keep a map twice.
pub static SPLATS: Topic = Topic::of::<SplatChunk>("splats", Delivery::Reliable { depth: 1000 });
pub static MANIFEST: Topic =
    Topic::of::<SplatManifest>("splats/manifest", Delivery::Latched { depth: 1 });

/// The published map, with the digest of its splats: that takes a pass over all of them.
#[derive(Debug, Clone)]
pub struct PublishedMap {
    pub snapshot: Arc<Snapshot>,
    map_sha256: [u8; 32],
}

#[derive(Debug, Default)]
struct Kept {
    /// By topic, unless they are pieces of the map.
    newest: BTreeMap<&'static str, Post>,
    map: Option<PublishedMap>,
}

/// Shared by all faces and services.
#[derive(Debug)]
pub struct Archive {
    kept: Mutex<Kept>,
    splat_frame: String,
    chunk_bytes: usize,
}

impl Archive {
    pub fn new(splat_frame: &str, chunk_bytes: usize) -> Self {
        Self {
            kept: Mutex::default(),
            splat_frame: splat_frame.to_owned(),
            chunk_bytes,
        }
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn keep(&self, post: &Post) {
        self.kept().newest.insert(post.topic.name, post.clone());
    }

    pub(super) fn keep_map(&self, snapshot: &Arc<Snapshot>) -> PublishedMap {
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
    pub fn tell(
        &self,
        topic: &Topic,
        send: &mut dyn FnMut(&Post) -> Result<(), PublishError>,
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
            send(&Post::of(&MANIFEST, stamp, &messages.manifest())?)?;
        } else if topic.name == KEYFRAMES.name {
            for array in messages.keyframes() {
                send(&Post::of(&KEYFRAMES, stamp, &array)?)?;
            }
        } else {
            for chunk in messages.chunks() {
                send(&Post::of(&SPLATS, stamp, &chunk)?)?;
            }
        }
        Ok(())
    }
}
