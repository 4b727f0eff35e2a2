//! Snapshots -> the map as clients see it: chunks by keyframe, keyframes, and what has changed since when.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::chunk::{Chunk, Source};
use splat_ros::odometry::forward_camera;
use splat_types::snapshot::{KeyframePose, Scale, Snapshot};
use splat_types::transform::{Rigid, Similarity};

/// A keyframe with fewer splats shares the chunk of the one before it.
const MIN_SPLATS: usize = 2048;
/// Keyframes that are gone and are remembered for clients that come back.
const MAX_GONE: usize = 4096;

/// A snapshot as it was published.
#[derive(Debug, Clone)]
pub struct Published {
    pub snapshot: Arc<Snapshot>,
    /// Takes the splat frame to the robot's map frame.
    pub map_from_world: Similarity,
}

impl Published {
    /// The map frame begins at the first keyframe, as a robot's whose camera looks ahead.
    pub fn at_first_keyframe(snapshot: Arc<Snapshot>) -> Self {
        let scale = snapshot.scale.metres_per_unit.unwrap_or(1.0);
        let first = snapshot.poses.first();
        let first = first.map_or(Rigid::IDENTITY, |pose| pose.world_from_cam);
        let rotation = forward_camera().rotation * first.rotation.inverse();
        Self {
            map_from_world: Similarity {
                scale,
                rotation,
                translation: -(rotation * first.translation) * scale,
            },
            snapshot,
        }
    }
}

/// What clients see; never changes.
#[derive(Debug, Clone)]
pub struct ViewMap {
    /// Counts updates, over all maps of the process.
    pub version: u32,
    /// Who holds an older version holds another map, or another epoch of it.
    pub began_at: u32,
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub sh_degree: u8,
    pub scale: Scale,
    pub map_from_world: Similarity,
    pub chunks: BTreeMap<u32, Arc<Chunk>>,
    pub keyframes: BTreeMap<u32, SeenKeyframe>,
    /// Version, and keyframe that is gone since.
    pub gone: Vec<(u32, u32)>,
}

#[derive(Debug, Clone, Copy)]
pub struct SeenKeyframe {
    pub pose: KeyframePose,
    pub changed_at: u32,
}

/// Makes the next view map of the newest; owned by one thread.
#[derive(Debug)]
pub struct Builder {
    /// Harmonics beyond are left out.
    max_sh_degree: u8,
    newest: Arc<ViewMap>,
    before: Option<Arc<Snapshot>>,
    /// Keyframe that splats were seeded from -> key of their chunk.
    chunk_of: BTreeMap<u32, u32>,
}

impl ViewMap {
    /// Before the first snapshot.
    pub fn empty() -> Self {
        Self {
            version: 0,
            began_at: 0,
            map_id: [0; 16],
            epoch: 0,
            revision: 0,
            sh_degree: 0,
            scale: Scale::UP_TO_SCALE,
            map_from_world: Similarity::IDENTITY,
            chunks: BTreeMap::new(),
            keyframes: BTreeMap::new(),
            gone: Vec::new(),
        }
    }

    pub fn n_splats(&self) -> usize {
        self.chunks.values().map(|chunk| chunk.len()).sum()
    }
}

impl Builder {
    pub fn new(max_sh_degree: u8) -> Self {
        Self {
            max_sh_degree,
            newest: Arc::new(ViewMap::empty()),
            before: None,
            chunk_of: BTreeMap::new(),
        }
    }

    pub fn update(&mut self, published: &Published) -> Arc<ViewMap> {
        let snapshot = &published.snapshot;
        let old = &Arc::clone(&self.newest);
        let version = old.version + 1;
        let is_same_map = old.version > 0 && old.map_id == snapshot.map_id;
        let sh_degree = snapshot.splats.sh_degree.min(self.max_sh_degree);
        let goes_on = is_same_map && old.epoch == snapshot.epoch && old.sh_degree == sh_degree;
        if !is_same_map {
            self.chunk_of.clear();
        }
        if !goes_on {
            self.before = None;
        }
        let groups = self.groups(snapshot);
        let before = self.before.as_deref();
        let chunk = |(key, ixs): (&u32, &Vec<usize>)| {
            let source = Source {
                snapshot,
                before,
                ixs,
                sh_degree,
                version,
            };
            let held = old.chunks.get(key).filter(|_| goes_on);
            let chunk = match held {
                Some(held) => match held.next(&source) {
                    Some(next) => Arc::new(next),
                    None => Arc::clone(held),
                },
                None => Arc::new(Chunk::anew(*key, &source)),
            };
            (*key, chunk)
        };
        let mut next = ViewMap {
            version,
            began_at: if goes_on { old.began_at } else { version },
            map_id: snapshot.map_id,
            epoch: snapshot.epoch,
            revision: snapshot.revision,
            sh_degree,
            scale: snapshot.scale,
            map_from_world: published.map_from_world,
            chunks: groups.iter().map(chunk).collect(),
            keyframes: BTreeMap::new(),
            gone: Vec::new(),
        };
        next.take_keyframes(&snapshot.poses, is_same_map.then_some(old));
        self.before = Some(Arc::clone(snapshot));
        self.newest = Arc::new(next);
        Arc::clone(&self.newest)
    }

    /// Splats by the key of their chunk, which they keep.
    fn groups(&mut self, snapshot: &Snapshot) -> BTreeMap<u32, Vec<usize>> {
        let mut by_anchor = BTreeMap::<u32, Vec<usize>>::new();
        for (ix, anchor) in snapshot.splats.anchors.iter().enumerate() {
            by_anchor.entry(*anchor).or_default().push(ix);
        }
        let mut groups = BTreeMap::<u32, Vec<usize>>::new();
        for (anchor, ixs) in by_anchor {
            let key = self.chunk_of.get(&anchor).copied().unwrap_or_else(|| {
                let before = self.chunk_of.range(..anchor).next_back();
                let shared = before
                    .map(|(_, key)| *key)
                    .filter(|key| groups.get(key).is_some_and(|held| held.len() < MIN_SPLATS));
                shared.unwrap_or(anchor)
            });
            self.chunk_of.insert(anchor, key);
            groups.entry(key).or_default().extend(ixs);
        }
        // Of several anchors: by id again, which is the order of the arrays.
        groups.values_mut().for_each(|ixs| ixs.sort_unstable());
        groups
    }
}

impl ViewMap {
    fn take_keyframes(&mut self, poses: &[KeyframePose], before: Option<&Arc<Self>>) {
        for pose in poses {
            let held = before.and_then(|map| map.keyframes.get(&pose.keyframe_id));
            let seen = held.filter(|held| held.pose == *pose).copied();
            let seen = seen.unwrap_or(SeenKeyframe {
                pose: *pose,
                changed_at: self.version,
            });
            self.keyframes.insert(pose.keyframe_id, seen);
        }
        let Some(before) = before else { return };
        self.gone.clone_from(&before.gone);
        let gone = before
            .keyframes
            .keys()
            .filter(|id| !self.keyframes.contains_key(id));
        let version = self.version;
        self.gone.extend(gone.map(|id| (version, *id)));
        let excess = self.gone.len().saturating_sub(MAX_GONE);
        self.gone.drain(..excess);
    }
}
