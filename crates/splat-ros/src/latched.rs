//! What late joiners get: the newest message of each topic, and the published map in pieces.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::error::PublishError;
use crate::shared_volume::SharedVolume;
use crate::transport::{Delivery, Sample, Topic};
use splat_io::latest::Latest;
use splat_msgs::map_messages::{KeyframeArray, Messages, SplatChunk, SplatManifest};
use splat_types::snapshot::Snapshot;
use splat_types::splats::layout;

pub static KEYFRAMES: Topic =
    Topic::of::<KeyframeArray>("keyframes", Delivery::Latched { depth: 64 });
/// Late joiners of ROS 2 ask the service `get_splats`: no middleware should keep a map twice.
pub static SPLATS: Topic = Topic::of::<SplatChunk>("splats", Delivery::Reliable { depth: 1000 });
pub static MANIFEST: Topic =
    Topic::of::<SplatManifest>("splats/manifest", Delivery::Latched { depth: 1 });
/// The same of submaps that have no known relation to the map. Few and seldom sent, so that middleware may keep them.
pub static SUBMAP_KEYFRAMES: Topic =
    Topic::of::<KeyframeArray>("submaps/keyframes", Delivery::Latched { depth: 64 });
pub static SUBMAP_SPLATS: Topic =
    Topic::of::<SplatChunk>("submaps/splats", Delivery::Latched { depth: 256 });
pub static SUBMAP_MANIFEST: Topic =
    Topic::of::<SplatManifest>("submaps/manifest", Delivery::Latched { depth: 64 });
pub static TOPICS: [&Topic; 6] = [
    &KEYFRAMES,
    &MANIFEST,
    &SPLATS,
    &SUBMAP_KEYFRAMES,
    &SUBMAP_MANIFEST,
    &SUBMAP_SPLATS,
];

/// What the pieces of a map go out on.
struct MapTopics {
    manifest: &'static Topic,
    keyframes: &'static Topic,
    splats: &'static Topic,
}

static OF_MAP: MapTopics = MapTopics {
    manifest: &MANIFEST,
    keyframes: &KEYFRAMES,
    splats: &SPLATS,
};
static OF_SUBMAPS: MapTopics = MapTopics {
    manifest: &SUBMAP_MANIFEST,
    keyframes: &SUBMAP_KEYFRAMES,
    splats: &SUBMAP_SPLATS,
};

/// Bytes of a map's id that the frame of a submap is named after.
const N_NAMED_BYTES: usize = 4;

/// The published map, with the digest of its splats: that takes a pass over all of them.
#[derive(Debug, Clone)]
pub struct PublishedMap {
    pub snapshot: Arc<Snapshot>,
    map_sha256: [u8; 32],
}

/// A submap beside the map, in a frame of its own.
#[derive(Debug, Clone)]
pub struct PublishedSubmap {
    map: PublishedMap,
    frame: String,
}

impl PublishedSubmap {
    pub fn snapshot(&self) -> &Snapshot {
        &self.map.snapshot
    }
}

#[derive(Debug, Default)]
struct LatchedSample {
    /// By topic, unless they are pieces of the map.
    newest: BTreeMap<&'static str, Sample>,
    map: Option<PublishedMap>,
    submaps: Vec<PublishedSubmap>,
}

/// Shared by all transports and services.
#[derive(Debug)]
pub struct LatchedStore {
    kept: Mutex<LatchedSample>,
    /// What planners may ask for distances.
    volume: Latest<Option<Arc<SharedVolume>>>,
    splat_frame: String,
    chunk_bytes: usize,
}

impl LatchedStore {
    pub fn new(splat_frame: &str, chunk_bytes: usize) -> Self {
        Self {
            kept: Mutex::default(),
            volume: Latest::default(),
            splat_frame: splat_frame.to_owned(),
            chunk_bytes,
        }
    }

    pub(crate) fn keep_volume(&self, volume: SharedVolume) {
        self.volume.set(Some(Arc::new(volume)));
    }

    pub(crate) fn volume(&self) -> Option<Arc<SharedVolume>> {
        (*self.volume.get()).clone()
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

    pub(crate) fn keep_submaps(&self, submaps: Vec<PublishedSubmap>) {
        self.kept().submaps = submaps;
    }

    /// Its frame is named after its map's id: no transform leads there.
    pub(crate) fn submap(&self, snapshot: &Arc<Snapshot>) -> PublishedSubmap {
        let id = &snapshot.map_id[..N_NAMED_BYTES];
        let id: String = id.iter().map(|byte| format!("{byte:02x}")).collect();
        PublishedSubmap {
            map: PublishedMap {
                snapshot: Arc::clone(snapshot),
                map_sha256: layout::digest(&snapshot.splats),
            },
            frame: format!("{}_{id}", self.splat_frame),
        }
    }

    /// A submap cut into messages.
    pub(crate) fn submap_messages<'a>(&self, submap: &'a PublishedSubmap) -> Messages<'a> {
        let PublishedSubmap { map, frame } = submap;
        Messages::of_known(&map.snapshot, map.map_sha256, frame, self.chunk_bytes)
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
        let is_asked = |other: &Topic| other.name == topic.name;
        if OF_SUBMAPS.all().into_iter().any(is_asked) {
            let submaps = self.kept().submaps.clone();
            return submaps.iter().try_for_each(|submap| {
                let messages = self.submap_messages(submap);
                OF_SUBMAPS.send(&messages, &is_asked, send)
            });
        }
        if OF_MAP.all().into_iter().any(is_asked) {
            return self.map().map_or(Ok(()), |map| {
                OF_MAP.send(&self.messages(&map), &is_asked, send)
            });
        }
        let newest = self.kept().newest.get(topic.name).cloned();
        newest.as_ref().map_or(Ok(()), send)
    }
}

impl MapTopics {
    fn all(&self) -> [&'static Topic; 3] {
        [self.manifest, self.keyframes, self.splats]
    }

    /// Messages of those topics that are asked for.
    fn send(
        &self,
        messages: &Messages<'_>,
        is_asked: &dyn Fn(&Topic) -> bool,
        send: &mut dyn FnMut(&Sample) -> Result<(), PublishError>,
    ) -> Result<(), PublishError> {
        let stamp = messages.snapshot.stamp;
        if is_asked(self.manifest) {
            send(&Sample::of(self.manifest, stamp, &messages.manifest())?)?;
        }
        if is_asked(self.keyframes) {
            for array in messages.keyframes() {
                send(&Sample::of(self.keyframes, stamp, &array)?)?;
            }
        }
        if is_asked(self.splats) {
            for chunk in messages.chunks() {
                send(&Sample::of(self.splats, stamp, &chunk)?)?;
            }
        }
        Ok(())
    }
}

/// All messages of a submap.
pub(crate) fn send_submap(
    messages: &Messages<'_>,
    send: &mut dyn FnMut(&Sample) -> Result<(), PublishError>,
) -> Result<(), PublishError> {
    OF_SUBMAPS.send(messages, &|_| true, send)
}
