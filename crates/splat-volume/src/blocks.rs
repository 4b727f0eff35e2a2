//! Blocks of voxels, in memory or on disk.

use std::collections::HashMap;
use std::sync::Arc;

use glam::IVec3;

use splat_types::pages::{Page, PageStore};

/// Voxels along an edge of a block.
pub const SIDE: i32 = 8;
pub(crate) const N_VOXELS: usize = (SIDE * SIDE * SIDE) as usize;
/// Of a voxel on disk.
const VOXEL_BYTES: usize = 8;
/// Of a block in memory.
pub(crate) const BLOCK_BYTES: usize = N_VOXELS * size_of::<Voxel>();
/// Of any block in memory: index, pointers, the record's place.
const ENTRY_BYTES: usize = 120;

/// A sum that keyframes can be taken out of again.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Voxel {
    /// Of distances in steps, each times its weight.
    pub(crate) sum: i32,
    pub(crate) weight: u32,
}

/// x fastest, then y.
pub(crate) type Block = [Voxel; N_VOXELS];

/// A copy of the whole shares the blocks until they change.
#[derive(Debug, Clone)]
enum Place {
    InMemory(Arc<Block>),
    OnDisk(Arc<dyn Page>),
}

/// By index: block (x, y, z) holds the voxels from `SIDE` times that on.
#[derive(Debug, Clone, Default)]
pub(crate) struct Blocks {
    places: HashMap<IVec3, Place>,
    n_in_memory: usize,
}

/// What became of blocks that memory had no room for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct PagedOut {
    pub(crate) n_written: usize,
    /// Why the others were not.
    pub(crate) reason: Option<String>,
}

impl Blocks {
    pub(crate) fn len(&self) -> usize {
        self.places.len()
    }

    pub(crate) fn n_in_memory(&self) -> usize {
        self.n_in_memory
    }

    /// Of memory.
    pub(crate) fn bytes(&self) -> usize {
        self.n_in_memory * BLOCK_BYTES + self.places.len() * ENTRY_BYTES
    }

    pub(crate) fn indices(&self) -> impl Iterator<Item = IVec3> + '_ {
        self.places.keys().copied()
    }

    /// A block whose record cannot be read is not there: nobody knows its voxels.
    pub(crate) fn get(&self, index: IVec3) -> Option<Arc<Block>> {
        match self.places.get(&index)? {
            Place::InMemory(block) => Some(Arc::clone(block)),
            Place::OnDisk(page) => page.read().ok().and_then(|bytes| parse(&bytes)),
        }
    }

    /// To be changed; an empty one where there is none, or none that can be read.
    pub(crate) fn get_mut(&mut self, index: IVec3) -> &mut Block {
        let n_in_memory = &mut self.n_in_memory;
        let place = self.places.entry(index).or_insert_with(|| {
            *n_in_memory += 1;
            Place::InMemory(Arc::new([Voxel::default(); N_VOXELS]))
        });
        if let Place::OnDisk(page) = place {
            let read = page.read().ok().and_then(|bytes| parse(&bytes));
            *n_in_memory += 1;
            *place =
                Place::InMemory(read.unwrap_or_else(|| Arc::new([Voxel::default(); N_VOXELS])));
        }
        match place {
            Place::InMemory(block) => Arc::make_mut(block),
            Place::OnDisk(_) => unreachable!("it has just been read"),
        }
    }

    pub(crate) fn insert(&mut self, index: IVec3, block: Arc<Block>) {
        self.remove(index);
        self.places.insert(index, Place::InMemory(block));
        self.n_in_memory += 1;
    }

    pub(crate) fn remove(&mut self, index: IVec3) {
        if let Some(Place::InMemory(_)) = self.places.remove(&index) {
            self.n_in_memory -= 1;
        }
    }

    /// Writes up to `n` blocks of memory to the store, those first that are farthest by `distance`.
    pub(crate) fn page_out(
        &mut self,
        n: usize,
        store: &dyn PageStore,
        distance: impl Fn(IVec3) -> i64,
    ) -> PagedOut {
        let mut done = PagedOut::default();
        for index in self.farthest(n, distance) {
            let Some(place) = self.places.get_mut(&index) else {
                continue;
            };
            let Place::InMemory(block) = place else {
                continue;
            };
            let reason = match store.put(&record(block)) {
                Ok(Some(page)) => {
                    *place = Place::OnDisk(Arc::from(page));
                    self.n_in_memory -= 1;
                    done.n_written += 1;
                    continue;
                }
                Ok(None) => "the limit is reached".to_owned(),
                Err(e) => e.to_string(),
            };
            done.reason = Some(reason);
            break;
        }
        done
    }

    /// Forgets up to `n` blocks of memory, the farthest first -> which.
    pub(crate) fn forget(&mut self, n: usize, distance: impl Fn(IVec3) -> i64) -> Vec<IVec3> {
        let gone = self.farthest(n, distance);
        gone.iter().for_each(|index| self.remove(*index));
        gone
    }

    fn farthest(&self, n: usize, distance: impl Fn(IVec3) -> i64) -> Vec<IVec3> {
        let in_memory = self
            .places
            .iter()
            .filter(|(_, place)| matches!(place, Place::InMemory(_)));
        // Equal distances in the order of indices: runs agree.
        let mut all: Vec<(i64, [i32; 3])> = in_memory
            .map(|(index, _)| (-distance(*index), index.to_array()))
            .collect();
        let n = n.min(all.len());
        if n < all.len() {
            all.select_nth_unstable(n);
            all.truncate(n);
        }
        all.into_iter()
            .map(|(_, index)| IVec3::from_array(index))
            .collect()
    }
}

fn record(block: &Block) -> Vec<u8> {
    let voxels = block.iter();
    voxels
        .flat_map(|voxel| {
            let mut bytes = [0; VOXEL_BYTES];
            bytes[..4].copy_from_slice(&voxel.sum.to_le_bytes());
            bytes[4..].copy_from_slice(&voxel.weight.to_le_bytes());
            bytes
        })
        .collect()
}

fn parse(bytes: &[u8]) -> Option<Arc<Block>> {
    let (rows, rest) = bytes.as_chunks::<VOXEL_BYTES>();
    if rows.len() != N_VOXELS || !rest.is_empty() {
        return None;
    }
    let voxel = |row: &[u8; VOXEL_BYTES]| {
        let [a, b, c, d, e, f, g, h] = *row;
        Voxel {
            sum: i32::from_le_bytes([a, b, c, d]),
            weight: u32::from_le_bytes([e, f, g, h]),
        }
    };
    let mut block = [Voxel::default(); N_VOXELS];
    for (own, row) in block.iter_mut().zip(rows) {
        *own = voxel(row);
    }
    Some(Arc::new(block))
}
