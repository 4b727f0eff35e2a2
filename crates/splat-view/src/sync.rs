//! What one client holds, and what it lacks of the newest map. There is no queue: a slow client gets fewer revisions.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::Deserialize;

use crate::chunk::Chunk;
use crate::hash::Hash;
use crate::messages;
use crate::view_map::{SeenKeyframe, ViewMap};

/// Keyframes of a message.
const KEYFRAMES: usize = 500;

/// The first message of a client.
#[derive(Debug, Clone, Deserialize)]
pub struct Hello {
    pub protocol: u32,
    #[serde(default = "most")]
    pub max_splats: usize,
    #[serde(default)]
    pub sh_degree: u8,
    /// Of what it holds; empty for nothing.
    #[serde(default)]
    pub map_id: String,
    #[serde(default)]
    pub epoch: u32,
    /// Key, number of splats, and hash of each chunk that it holds.
    #[serde(default)]
    pub chunks: Vec<(u32, usize, u32, u32)>,
}

fn most() -> usize {
    usize::MAX
}

/// Of one client.
#[derive(Debug)]
pub struct ClientState {
    max_splats: usize,
    sh_degree: u8,
    /// Where the viewer stands, in the splat frame.
    eye: [f64; 3],
    has_moved: bool,
    /// Version of the view map that it received last.
    version: Option<u32>,
    /// Version of each chunk that it holds.
    chunks: BTreeMap<u32, u32>,
}

/// What is to be said to a client, in order: `before`, the updates of `chunks`, `after`.
#[derive(Debug)]
pub struct Plan {
    pub map: Arc<ViewMap>,
    pub before: Vec<String>,
    /// Nearest first, with the version that the client holds.
    pub chunks: Vec<(Arc<Chunk>, Option<u32>)>,
    pub after: String,
}

impl ClientState {
    /// Compares what the client says that it holds with the first map that there is.
    pub fn new(hello: &Hello, map: &ViewMap) -> Self {
        let mut state = Self {
            max_splats: hello.max_splats,
            sh_degree: hello.sh_degree.min(3),
            eye: [0.0; 3],
            has_moved: false,
            version: None,
            chunks: BTreeMap::new(),
        };
        // Another map: the client drops everything by itself.
        if hello.map_id != messages::hex(&map.map_id) {
            return state;
        }
        for (key, n, a, b) in &hello.chunks {
            let chunk = map.chunks.get(key).filter(|_| hello.epoch == map.epoch);
            let is_equal = chunk.is_some_and(|chunk| {
                chunk.len() == *n && chunk.hash(state.sh_degree) == Hash([*a, *b])
            });
            // What differs begins anew; what the map lacks is dropped.
            let version = if is_equal { map.version } else { 0 };
            state.chunks.insert(*key, version);
        }
        state
    }

    /// The client holds nothing any more.
    pub fn forget(&mut self) {
        self.version = None;
        self.chunks.clear();
    }

    pub fn stand_at(&mut self, eye: [f64; 3]) {
        if eye.iter().all(|v| v.is_finite()) {
            self.eye = eye;
            self.has_moved = true;
        }
    }

    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// `None` where the client holds the map already.
    pub fn plan(&mut self, map: &Arc<ViewMap>) -> Option<Plan> {
        let is_new = self.version != Some(map.version);
        let is_larger = map.n_splats() > self.max_splats;
        let may_choose_anew = std::mem::take(&mut self.has_moved) && is_larger;
        if !is_new && !may_choose_anew {
            return None;
        }
        let begins = self.version.is_none_or(|version| version < map.began_at);
        // A new epoch: every chunk begins anew. The client keeps what it has until then, moved with its keyframes.
        let wanted = self.wanted(map);
        let is_wanted: BTreeSet<u32> = wanted.iter().map(|chunk| chunk.key).collect();
        let gone: Vec<u32> = self
            .chunks
            .keys()
            .copied()
            .filter(|key| !is_wanted.contains(key))
            .collect();
        let mut before = vec![messages::map(map, self.sh_degree)];
        before.extend(self.keyframes(map, begins));
        if !gone.is_empty() {
            before.push(messages::dropped(&gone));
            gone.iter().for_each(|key| _ = self.chunks.remove(key));
        }
        let n = wanted.iter().map(|chunk| chunk.len()).sum();
        let hash: Hash = wanted.iter().map(|chunk| chunk.hash(self.sh_degree)).sum();
        let lacks = |chunk: &Arc<Chunk>| {
            let held = self
                .chunks
                .get(&chunk.key)
                .copied()
                .filter(|held| *held > 0);
            held.is_none_or(|held| held < chunk.version)
                .then(|| (Arc::clone(chunk), held))
        };
        let chunks: Vec<_> = wanted.iter().filter_map(lacks).collect();
        self.version = Some(map.version);
        wanted
            .iter()
            .for_each(|chunk| _ = self.chunks.insert(chunk.key, map.version));
        Some(Plan {
            map: Arc::clone(map),
            before,
            chunks,
            after: messages::synced(map, n, hash),
        })
    }

    /// The chunks nearest to where the viewer stands, as many as it can show, nearest first.
    fn wanted(&self, map: &ViewMap) -> Vec<Arc<Chunk>> {
        let distance = |chunk: &Chunk| {
            let square = |k: usize| (f64::from(chunk.origin[k]) - self.eye[k]).powi(2);
            square(0) + square(1) + square(2)
        };
        let mut chunks: Vec<&Arc<Chunk>> = map.chunks.values().collect();
        chunks.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        let mut n = 0;
        let fits = |chunk: &&&Arc<Chunk>| {
            n += chunk.len();
            n <= self.max_splats
        };
        chunks
            .iter()
            .take_while(fits)
            .map(|chunk| Arc::clone(chunk))
            .collect()
    }

    fn keyframes(&self, map: &ViewMap, begins: bool) -> Vec<String> {
        let since = self.version.filter(|_| !begins).unwrap_or(0);
        let is_new = |seen: &&SeenKeyframe| seen.changed_at > since;
        let new: Vec<SeenKeyframe> = map.keyframes.values().filter(is_new).copied().collect();
        let is_gone = |(at, id): &&(u32, u32)| *at > since && !map.keyframes.contains_key(id);
        let gone: Vec<u32> = map.gone.iter().filter(is_gone).map(|(_, id)| *id).collect();
        let mut said: Vec<String> = new
            .chunks(KEYFRAMES)
            .map(|some| messages::keyframes(some, &[]))
            .collect();
        if !gone.is_empty() {
            said.push(messages::keyframes(&[], &gone));
        }
        said
    }
}
