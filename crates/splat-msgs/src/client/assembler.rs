//! Messages -> snapshot: what a client does. Takes pieces in any order, twice, of several revisions at once, and
//! from peers that lie: memory follows the bytes that came, never the counts that were declared.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::de::DeserializeOwned;

use crate::map_messages::{KeyframeArray, MAX_MESSAGE_BYTES, SplatChunk, SplatManifest};
use crate::ros::{self, Message};
use crate::type_hash::dds_type_name;
use splat_types::snapshot::{KeyframePose, Scale, Snapshot};
use splat_types::splats::layout;
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;

/// Snapshots that may be in the making at once; the one that waited longest makes room.
const MAX_OPEN: usize = 4;
/// What keeping one message costs besides its content; without it, empty messages would cost nothing.
const KEEP_BYTES: usize = 128;

/// What came so far, by what became of it. Every message is counted once.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    pub used: u64,
    /// Already there, or part of a snapshot that is not newer than one handed out.
    pub superfluous: u64,
    /// Undecodable, contradictory or failing a check.
    pub rejected: u64,
    /// Messages thrown away with an incomplete snapshot, for room or because a newer one was complete.
    pub abandoned: u64,
}

/// All that pieces of one snapshot must agree on.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Identity {
    map_id: [u8; 16],
    epoch: u32,
    revision: u32,
}

/// What chunks and manifest both state; chunks that state something else are another snapshot's.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Shape {
    map_sha256: [u8; 32],
    n_splats: u32,
    n_chunks: u32,
    sh_degree: u8,
}

#[derive(Debug)]
struct Piece {
    first_splat: u32,
    ids: Vec<u32>,
    data: Vec<u8>,
}

#[derive(Debug)]
struct Open {
    identity: Identity,
    /// `None` until the manifest or a chunk is there.
    shape: Option<Shape>,
    manifest: Option<(u32, Scale, Stamp)>,
    /// By chunk_ix.
    pieces: BTreeMap<u32, Piece>,
    /// By first_ix.
    keyframes: BTreeMap<u32, Vec<KeyframePose>>,
    n_messages: u64,
    n_bytes: usize,
    /// Number of the last message that helped it.
    touched: u64,
}

/// Puts the snapshots of one publisher together. Hands out each at most once, revisions of a map in rising order.
#[derive(Debug)]
pub struct Assembler {
    max_bytes: usize,
    open: Vec<Open>,
    newest: Option<Identity>,
    n_seen: u64,
    counts: Counts,
}

/// What became of one message.
enum Outcome {
    Used,
    Superfluous,
    Rejected,
}

impl Assembler {
    /// `max_bytes` bounds all incomplete snapshots together; a map larger than that never completes.
    pub fn new(max_bytes: usize) -> Self {
        Self {
            max_bytes,
            open: Vec::new(),
            newest: None,
            n_seen: 0,
            counts: Counts::default(),
        }
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// A payload as it travels; `dds_type` as its key spells it. Other types are rejected.
    pub fn add_payload(&mut self, dds_type: &str, payload: &[u8]) -> Option<Snapshot> {
        if payload.len() <= MAX_MESSAGE_BYTES {
            if dds_type == dds_type_name::<SplatChunk>() {
                return self.add_decoded(payload, Self::add_chunk);
            } else if dds_type == dds_type_name::<SplatManifest>() {
                return self.add_decoded(payload, Self::add_manifest);
            } else if dds_type == dds_type_name::<KeyframeArray>() {
                return self.add_decoded(payload, Self::add_keyframes);
            }
        }
        self.counts.rejected += 1;
        None
    }

    pub fn add_chunk(&mut self, chunk: SplatChunk) -> Option<Snapshot> {
        let identity = Identity {
            map_id: chunk.map_id,
            epoch: chunk.epoch,
            revision: chunk.revision,
        };
        let shape = Shape {
            map_sha256: chunk.map_sha256,
            n_splats: chunk.n_splats,
            n_chunks: chunk.n_chunks,
            sh_degree: chunk.sh_degree,
        };
        let n_bytes = chunk.data.len();
        let n_splats = chunk.ids.len();
        let is_sound = shape.sh_degree <= layout::MAX_SH_DEGREE
            && n_bytes > 0
            && n_bytes <= MAX_MESSAGE_BYTES
            && n_bytes == n_splats * layout::bytes_per_splat(shape.sh_degree)
            && chunk.chunk_ix < shape.n_chunks
            && chunk.first_splat < shape.n_splats
            && crc32c::crc32c(&chunk.data) == chunk.crc32c;
        self.add(
            &identity,
            is_sound.then_some(n_bytes + 4 * n_splats + KEEP_BYTES),
            |open| {
                if !open.takes(&shape) {
                    return Outcome::Rejected;
                }
                if open.pieces.contains_key(&chunk.chunk_ix) {
                    return Outcome::Superfluous;
                }
                open.pieces.insert(
                    chunk.chunk_ix,
                    Piece {
                        first_splat: chunk.first_splat,
                        ids: chunk.ids,
                        data: chunk.data,
                    },
                );
                Outcome::Used
            },
        )
    }

    #[expect(
        clippy::needless_pass_by_value,
        reason = "like its two sisters it takes what was received"
    )]
    pub fn add_manifest(&mut self, manifest: SplatManifest) -> Option<Snapshot> {
        let identity = Identity {
            map_id: manifest.map_id,
            epoch: manifest.epoch,
            revision: manifest.revision,
        };
        let shape = Shape {
            map_sha256: manifest.map_sha256,
            n_splats: manifest.n_splats,
            n_chunks: manifest.n_chunks,
            sh_degree: manifest.sh_degree,
        };
        let scale = Scale::of_numbers((
            manifest.scale_source,
            manifest.metres_per_unit,
            manifest.scale_std,
        ));
        let is_sound = shape.sh_degree <= layout::MAX_SH_DEGREE
            && shape.n_chunks <= shape.n_splats
            && (shape.n_chunks == 0) == (shape.n_splats == 0);
        self.add(
            &identity,
            (is_sound && scale.is_some()).then_some(KEEP_BYTES),
            |open| {
                if !open.takes(&shape) {
                    return Outcome::Rejected;
                }
                if open.manifest.is_some() {
                    return Outcome::Superfluous;
                }
                open.manifest =
                    scale.map(|scale| (manifest.n_keyframes, scale, manifest.header.stamp.into()));
                Outcome::Used
            },
        )
    }

    #[expect(
        clippy::needless_pass_by_value,
        reason = "like its two sisters it takes what was received"
    )]
    pub fn add_keyframes(&mut self, array: KeyframeArray) -> Option<Snapshot> {
        let identity = Identity {
            map_id: array.map_id,
            epoch: array.epoch,
            revision: array.revision,
        };
        let poses: Option<Vec<KeyframePose>> =
            array.keyframes.iter().map(|pose| pose.to_pose()).collect();
        let n_bytes = poses
            .as_ref()
            .map(|poses| size_of_val(&poses[..]) + KEEP_BYTES);
        self.add(&identity, n_bytes, |open| {
            if open.keyframes.contains_key(&array.first_ix) {
                return Outcome::Superfluous;
            }
            open.keyframes
                .insert(array.first_ix, poses.unwrap_or_default());
            Outcome::Used
        })
    }

    fn add_decoded<T: Message + DeserializeOwned>(
        &mut self,
        payload: &[u8],
        add: fn(&mut Self, T) -> Option<Snapshot>,
    ) -> Option<Snapshot> {
        match ros::decode(payload) {
            Ok(message) => add(self, message),
            Err(_) => {
                self.counts.rejected += 1;
                None
            }
        }
    }

    /// `n_bytes` is `None` for a message that is unsound by itself.
    fn add(
        &mut self,
        identity: &Identity,
        n_bytes: Option<usize>,
        apply: impl FnOnce(&mut Open) -> Outcome,
    ) -> Option<Snapshot> {
        self.n_seen += 1;
        let Some(n_bytes) = n_bytes.filter(|n_bytes| *n_bytes <= self.max_bytes) else {
            self.counts.rejected += 1;
            return None;
        };
        if !self.is_newer(identity) {
            self.counts.superfluous += 1;
            return None;
        }
        let open_ix = self.open_ix(identity);
        match apply(&mut self.open[open_ix]) {
            Outcome::Superfluous => self.counts.superfluous += 1,
            Outcome::Rejected => self.counts.rejected += 1,
            Outcome::Used => {
                self.counts.used += 1;
                let open = &mut self.open[open_ix];
                open.n_messages += 1;
                open.n_bytes += n_bytes;
                open.touched = self.n_seen;
                if open.has_all() {
                    let open = self.open.swap_remove(open_ix);
                    return self.close(open);
                }
                self.make_room();
            }
        }
        None
    }

    fn is_newer(&self, identity: &Identity) -> bool {
        match &self.newest {
            Some(newest) if newest.map_id == identity.map_id => identity.revision > newest.revision,
            _ => true,
        }
    }

    fn open_ix(&mut self, identity: &Identity) -> usize {
        if let Some(ix) = self.open.iter().position(|open| open.identity == *identity) {
            return ix;
        }
        if self.open.len() == MAX_OPEN {
            self.abandon_oldest();
        }
        self.open.push(Open::new(identity.clone(), self.n_seen));
        self.open.len() - 1
    }

    fn make_room(&mut self) {
        while self.open.iter().map(|open| open.n_bytes).sum::<usize>() > self.max_bytes {
            self.abandon_oldest();
        }
    }

    fn abandon_oldest(&mut self) {
        let oldest = (0..self.open.len()).min_by_key(|ix| self.open[*ix].touched);
        if let Some(ix) = oldest {
            self.counts.abandoned += self.open.swap_remove(ix).n_messages;
        }
    }

    fn close(&mut self, open: Open) -> Option<Snapshot> {
        let n_messages = open.n_messages;
        let identity = open.identity.clone();
        let Some(snapshot) = open.into_snapshot() else {
            // Each piece was sound, the whole is not: somebody sent a forged one among them.
            self.counts.rejected += n_messages;
            self.counts.used -= n_messages;
            return None;
        };
        self.newest = Some(identity);
        let (kept, stale): (Vec<Open>, Vec<Open>) = std::mem::take(&mut self.open)
            .into_iter()
            .partition(|open| self.is_newer(&open.identity));
        self.counts.abandoned += stale.iter().map(|open| open.n_messages).sum::<u64>();
        self.open = kept;
        Some(snapshot)
    }
}

impl Open {
    fn new(identity: Identity, touched: u64) -> Self {
        Self {
            identity,
            shape: None,
            manifest: None,
            pieces: BTreeMap::new(),
            keyframes: BTreeMap::new(),
            n_messages: 0,
            n_bytes: 0,
            touched,
        }
    }

    fn takes(&mut self, shape: &Shape) -> bool {
        self.shape.get_or_insert_with(|| shape.clone()) == shape
    }

    fn has_all(&self) -> bool {
        let (Some(shape), Some((n_keyframes, ..))) = (&self.shape, &self.manifest) else {
            return false;
        };
        let n_poses: usize = self.keyframes.values().map(Vec::len).sum();
        self.pieces.len() == shape.n_chunks as usize
            && n_poses >= *n_keyframes as usize
            && !self.keyframes.is_empty()
    }

    /// `None` when ranges leave holes, the hash differs or a number is not finite.
    fn into_snapshot(self) -> Option<Snapshot> {
        let shape = self.shape?;
        let (n_keyframes, scale, stamp) = self.manifest?;
        let mut splats = Splats {
            sh_degree: shape.sh_degree,
            ..Splats::default()
        };
        let mut ids: Vec<u32> = Vec::new();
        for piece in self.pieces.values() {
            ids.extend(&piece.ids);
            if piece.first_splat as usize != splats.len() {
                return None;
            }
            layout::decode(&piece.data, &mut splats)?;
        }
        let mut poses = Vec::new();
        for (first_ix, some) in self.keyframes {
            if first_ix as usize != poses.len() {
                return None;
            }
            poses.extend(some);
        }
        let is_whole = splats.len() == shape.n_splats as usize
            && poses.len() == n_keyframes as usize
            && layout::digest(&splats) == shape.map_sha256
            && ids.is_sorted_by(|a, b| a < b)
            && layout::fault(&splats).is_none();
        is_whole.then(|| Snapshot {
            map_id: self.identity.map_id,
            epoch: self.identity.epoch,
            revision: self.identity.revision,
            stamp,
            scale,
            poses,
            splats: Arc::new(splats),
            splat_ids: Arc::new(ids),
        })
    }
}
