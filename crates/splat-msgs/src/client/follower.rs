//! Whole snapshots and deltas -> the published map, as a client holds it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::client::assembler::Assembler;
use crate::map_messages::{MAX_MESSAGE_BYTES, SplatDelta};
use crate::ros;
use crate::type_hash::dds_type_name;
use splat_types::snapshot::Snapshot;
use splat_types::splats::layout;
use splat_types::splats::splats::Splats;

/// Pieces of one delta that may wait for the others.
const MAX_PIECES: usize = 4096;

/// What a message led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Followed {
    /// Nothing that can be seen yet.
    Nothing,
    /// The held map is another revision.
    Advanced,
    /// A delta does not go onto what is held: ask for the whole map.
    Missed,
}

/// Follows one publisher.
#[derive(Debug)]
pub struct Follower {
    assembler: Assembler,
    held: Option<Snapshot>,
    /// Pieces of the delta in the making.
    pieces: BTreeMap<u32, SplatDelta>,
    n_bytes: usize,
    max_bytes: usize,
}

impl Follower {
    /// `max_bytes` bounds what waits to be complete; a larger map never completes.
    pub fn new(max_bytes: usize) -> Self {
        Self {
            assembler: Assembler::new(max_bytes),
            held: None,
            pieces: BTreeMap::new(),
            n_bytes: 0,
            max_bytes,
        }
    }

    /// The newest map, poses as of its last whole snapshot.
    pub fn held(&self) -> Option<&Snapshot> {
        self.held.as_ref()
    }

    /// A payload as it travels; `dds_type` as its key spells it.
    pub fn add_payload(&mut self, dds_type: &str, payload: &[u8]) -> Followed {
        if dds_type != dds_type_name::<SplatDelta>() {
            return match self.assembler.add_payload(dds_type, payload) {
                Some(snapshot) => self.take_whole(snapshot),
                None => Followed::Nothing,
            };
        }
        if payload.len() > MAX_MESSAGE_BYTES {
            return Followed::Nothing;
        }
        match ros::decode(payload) {
            Ok(delta) => self.add_delta(delta),
            Err(_) => Followed::Nothing,
        }
    }

    /// The newer of two is held; another epoch or map always.
    fn take_whole(&mut self, snapshot: Snapshot) -> Followed {
        let is_old = self.held.as_ref().is_some_and(|held| {
            held.map_id == snapshot.map_id && held.revision >= snapshot.revision
        });
        if is_old {
            return Followed::Nothing;
        }
        self.held = Some(snapshot);
        Followed::Advanced
    }

    pub fn add_delta(&mut self, delta: SplatDelta) -> Followed {
        let is_sound = delta.sh_degree <= layout::MAX_SH_DEGREE
            && delta.piece_ix < delta.n_pieces
            && delta.n_pieces as usize <= MAX_PIECES
            && delta.data.len() == delta.ids.len() * layout::bytes_per_splat(delta.sh_degree)
            && crc32c::crc32c(&delta.data) == delta.crc32c;
        let Some(held) = self.held.as_ref().filter(|_| is_sound) else {
            return if is_sound {
                Followed::Missed
            } else {
                Followed::Nothing
            };
        };
        if held.map_id == delta.map_id && held.revision >= delta.revision {
            return Followed::Nothing;
        }
        let fits = held.map_id == delta.map_id
            && held.epoch == delta.epoch
            && held.revision == delta.base_revision
            && held.splats.sh_degree == delta.sh_degree;
        if !fits {
            return Followed::Missed;
        }
        let is_other = self.pieces.values().next().is_some_and(|first| {
            first.revision != delta.revision || first.map_sha256 != delta.map_sha256
        });
        if is_other {
            self.forget_pieces();
        }
        self.n_bytes += delta.data.len() + 4 * (delta.ids.len() + delta.removed.len()) + 256;
        if self.n_bytes > self.max_bytes {
            self.forget_pieces();
            return Followed::Missed;
        }
        let n_pieces = delta.n_pieces as usize;
        self.pieces.insert(delta.piece_ix, delta);
        if self.pieces.len() < n_pieces {
            return Followed::Nothing;
        }
        let pieces = std::mem::take(&mut self.pieces);
        self.forget_pieces();
        match self.held.as_ref().and_then(|held| applied(held, &pieces)) {
            Some(next) => {
                self.held = Some(next);
                Followed::Advanced
            }
            None => Followed::Missed,
        }
    }

    fn forget_pieces(&mut self) {
        self.pieces.clear();
        self.n_bytes = 0;
    }
}

/// `None` where the pieces do not give what they say.
fn applied(held: &Snapshot, pieces: &BTreeMap<u32, SplatDelta>) -> Option<Snapshot> {
    let first = pieces.values().next()?;
    let removed: BTreeSet<u32> = pieces
        .values()
        .flat_map(|p| p.removed.iter().copied())
        .collect();
    let mut fresh = Splats {
        sh_degree: held.splats.sh_degree,
        ..Splats::default()
    };
    let mut fresh_ids: Vec<u32> = Vec::new();
    for piece in pieces.values() {
        layout::decode(&piece.data, &mut fresh)?;
        fresh_ids.extend(&piece.ids);
    }
    if !fresh_ids.is_sorted_by(|a, b| a < b) {
        return None;
    }
    let mut splats = Splats {
        sh_degree: held.splats.sh_degree,
        ..Splats::default()
    };
    let mut ids = Vec::new();
    let mut fresh_ix = 0;
    let mut take_fresh = |below: Option<u32>, splats: &mut Splats, ids: &mut Vec<u32>| {
        while let Some(id) = fresh_ids
            .get(fresh_ix)
            .filter(|id| below.is_none_or(|b| **id < b))
        {
            splats.push(&fresh, fresh_ix);
            ids.push(*id);
            fresh_ix += 1;
        }
    };
    let is_fresh = |id: u32| fresh_ids.binary_search(&id).is_ok();
    for (ix, id) in held.splat_ids.iter().enumerate() {
        take_fresh(Some(*id), &mut splats, &mut ids);
        if !removed.contains(id) && !is_fresh(*id) {
            splats.push(&held.splats, ix);
            ids.push(*id);
        }
    }
    take_fresh(None, &mut splats, &mut ids);
    let is_whole = splats.len() == first.n_splats as usize
        && layout::fault(&splats).is_none()
        && layout::digest(&splats) == first.map_sha256;
    is_whole.then(|| Snapshot {
        revision: first.revision,
        stamp: first.header.stamp.into(),
        splats: Arc::new(splats),
        splat_ids: Arc::new(ids),
        ..held.clone()
    })
}
