//! Volumes that are larger than their memory.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use glam::IVec2;

use crate::world::World;
use crate::{keyframes, round};
use splat_types::pages::{Page, PageStore};
use splat_volume::error::VolumeError;
use splat_volume::grid::{UNKNOWN, grid};
use splat_volume::params::GridParams;
use splat_volume::volume::{KeyframeDepth, Volume};

/// Records in memory that is not counted.
#[derive(Debug, Default)]
struct Shelf {
    n_held: Arc<AtomicUsize>,
    max: usize,
    is_broken: Arc<AtomicBool>,
}

#[derive(Debug)]
struct Record {
    bytes: Vec<u8>,
    n_held: Arc<AtomicUsize>,
    is_broken: Arc<AtomicBool>,
}

impl PageStore for Shelf {
    fn put(&self, bytes: &[u8]) -> io::Result<Option<Box<dyn Page>>> {
        if self.n_held.load(Ordering::Relaxed) >= self.max {
            return Ok(None);
        }
        self.n_held.fetch_add(1, Ordering::Relaxed);
        Ok(Some(Box::new(Record {
            bytes: bytes.to_vec(),
            n_held: Arc::clone(&self.n_held),
            is_broken: Arc::clone(&self.is_broken),
        })))
    }

    fn describe(&self) -> String {
        "a shelf".to_owned()
    }
}

impl Page for Record {
    fn n_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    fn read(&self) -> io::Result<Vec<u8>> {
        if self.is_broken.load(Ordering::Relaxed) {
            return Err(io::Error::other("the shelf is broken"));
        }
        Ok(self.bytes.clone())
    }
}

impl Drop for Record {
    fn drop(&mut self) {
        self.n_held.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Fine enough that the room takes more than the least budget.
fn params(max_mib: u64) -> GridParams {
    GridParams {
        resolution: 0.025,
        max_mib,
        ..GridParams::default()
    }
}

fn fused(mut volume: Volume, keyframes: &[KeyframeDepth]) -> (Volume, Vec<VolumeError>) {
    let mut faults = Vec::new();
    for n in 1..=keyframes.len() {
        faults.extend(volume.set_keyframes(&keyframes[..n]));
        faults.extend(volume.fuse(usize::MAX).1);
    }
    (volume, faults)
}

#[test]
fn blocks_on_disk_are_what_they_were_in_memory() {
    let keyframes = keyframes(&World::room(), &round());
    let (mut whole, _) = fused(Volume::new(&params(4096)), &keyframes);
    assert!(whole.bytes() > 24 << 20, "{} bytes", whole.bytes());
    let shelf = Shelf {
        max: usize::MAX,
        ..Shelf::default()
    };
    let (n_held, is_broken) = (Arc::clone(&shelf.n_held), Arc::clone(&shelf.is_broken));
    let volume = Volume::new(&params(16)).paging_to(Box::new(shelf));
    let (mut volume, faults) = fused(volume, &keyframes);
    assert_eq!(faults, []);
    assert!(volume.bytes() <= 16 << 20, "{} bytes", volume.bytes());
    assert!(n_held.load(Ordering::Relaxed) > 1000);
    let indices = whole.voxels().indices();
    assert_eq!(indices, volume.voxels().indices());
    for index in indices.iter().step_by(7) {
        let at = *index * 8 + 3;
        assert_eq!(volume.voxels().voxel(at), whole.voxels().voxel(at));
    }
    let grids = [&mut whole, &mut volume].map(|v| grid(v, None, IVec2::ZERO).unwrap());
    assert_eq!(grids[0], grids[1]);
    // What was handed out stays as it was while the volume goes on, and its records with it.
    let shared = volume.voxels().clone();
    let kept = [&shared, whole.voxels()].map(|v| v.voxel(indices[0] * 8 + 3));
    drop(volume);
    assert!(n_held.load(Ordering::Relaxed) > 1000);
    assert_eq!(kept[0], kept[1]);
    is_broken.store(true, Ordering::Relaxed);
    let lost = indices
        .iter()
        .filter(|index| shared.block(**index).is_none());
    assert!(lost.count() > 1000, "nobody knows what cannot be read");
    drop(shared);
    assert_eq!(n_held.load(Ordering::Relaxed), 0);
}

#[test]
fn beyond_disk_and_memory_far_blocks_are_unknown_and_that_is_said() {
    let keyframes = keyframes(&World::room(), &round());
    for shelf in [None, Some(500)] {
        let mut volume = Volume::new(&params(16));
        if let Some(max) = shelf {
            volume = volume.paging_to(Box::new(Shelf {
                max,
                ..Shelf::default()
            }));
        }
        let (mut volume, faults) = fused(volume, &keyframes);
        // One keyframe's own blocks come on top.
        assert!(volume.bytes() <= 16 << 20, "{} bytes", volume.bytes());
        let said = faults.iter().map(ToString::to_string).next().unwrap();
        let why = match shelf {
            None => "no place for it on disk",
            Some(_) => "the limit is reached: a shelf",
        };
        assert!(
            said.contains("grid.max_mib") && said.contains(why),
            "{said}"
        );
        let grid = grid(&mut volume, None, IVec2::ZERO).unwrap();
        assert!(grid.cells.iter().any(|cell| *cell != UNKNOWN));
    }
}

#[test]
fn a_block_that_cannot_be_read_says_nothing_after_its_keyframes_left() {
    let keyframes = keyframes(&World::room(), &round());
    let shelf = Shelf {
        max: usize::MAX,
        ..Shelf::default()
    };
    let is_broken = Arc::clone(&shelf.is_broken);
    let volume = Volume::new(&params(16)).paging_to(Box::new(shelf));
    let (mut volume, _) = fused(volume, &keyframes);
    is_broken.store(true, Ordering::Relaxed);
    volume.set_keyframes(&[]);
    // Those that had lost their depth to memory stay; nothing is behind a surface where nothing is known.
    let unknown = volume.voxels().indices();
    assert!(unknown.len() < 20_000);
    volume.set_keyframes(&keyframes[keyframes.len() - 1..]);
    assert_eq!(volume.fuse(usize::MAX).0, 0);
}
