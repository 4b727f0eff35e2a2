//! Voxels -> for each cell of the ground plane columns of bits: where surfaces were seen, where free space, and what is behind surfaces.

use std::collections::HashMap;

use glam::{IVec2, IVec3};

use crate::blocks::SIDE;
use crate::voxels::{State, Voxels};

/// Voxels of a column, from `BELOW` under the level of the ground on.
pub const HEIGHT: i32 = 128;
/// Of them below that level.
pub const BELOW: i32 = 40;
const N_CELLS: usize = (SIDE * SIDE) as usize;
/// Of the columns of a tile.
const TILE_BYTES: usize = N_CELLS * size_of::<Column>() + 24;

/// Bit `k` stands for the voxel `k` above the foot of the columns.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Column {
    pub surface: u128,
    pub free: u128,
    /// Behind surfaces.
    pub inside: u128,
}

/// The columns of all cells that have voxels, in tiles as wide as a block.
#[derive(Debug, Default)]
pub struct Columns {
    /// Index of the lowest voxel.
    pub foot: i32,
    tiles: HashMap<IVec2, Box<[Column; N_CELLS]>>,
}

impl Columns {
    /// For a ground around the voxel with this index along z.
    pub fn above(ground: i32) -> Self {
        Self {
            foot: ground - BELOW,
            tiles: HashMap::new(),
        }
    }

    /// Reads the tiles anew that blocks lie above or below of.
    pub fn update(&mut self, voxels: &Voxels, tiles: impl IntoIterator<Item = IVec2>) {
        for tile in tiles {
            let column = self.read(voxels, tile);
            if column.iter().all(|c| *c == Column::default()) {
                self.tiles.remove(&tile);
            } else {
                self.tiles.insert(tile, column);
            }
        }
    }

    fn read(&self, voxels: &Voxels, tile: IVec2) -> Box<[Column; N_CELLS]> {
        let mut columns = Box::new([Column::default(); N_CELLS]);
        let (first, last) = (
            self.foot.div_euclid(SIDE),
            (self.foot + HEIGHT - 1).div_euclid(SIDE),
        );
        for z in first..=last {
            let block = IVec3::new(tile.x, tile.y, z);
            let Some(view) = voxels.block(block) else {
                continue;
            };
            for (at, column) in columns.iter_mut().enumerate() {
                let (x, y) = (at as i32 % SIDE, at as i32 / SIDE);
                for (k, state) in view.states(x, y).into_iter().enumerate() {
                    let bit = z * SIDE + k as i32 - self.foot;
                    if !(0..HEIGHT).contains(&bit) {
                        continue;
                    }
                    match state {
                        State::Surface => column.surface |= 1 << bit,
                        State::Free => column.free |= 1 << bit,
                        State::Inside => column.inside |= 1 << bit,
                        State::Unknown => {}
                    }
                }
            }
        }
        columns
    }

    /// Forgets the tiles that are farthest from one of them, until the rest takes no more -> which.
    pub(crate) fn forget(&mut self, focus: IVec2, max_bytes: usize) -> Vec<IVec2> {
        let most = max_bytes / TILE_BYTES;
        if self.tiles.len() <= most {
            return Vec::new();
        }
        let mut all: Vec<(i64, [i32; 2])> = self
            .tiles
            .keys()
            .map(|tile| {
                let away = (*tile - focus).as_i64vec2().length_squared();
                (away, tile.to_array())
            })
            .collect();
        // An eighth more than needed: a while passes until the next time.
        let kept = most - most / 8;
        all.select_nth_unstable(kept);
        let gone = all.split_off(kept).into_iter();
        let gone: Vec<IVec2> = gone.map(|(_, tile)| IVec2::from_array(tile)).collect();
        for tile in &gone {
            self.tiles.remove(tile);
        }
        gone
    }

    /// Tiles in the order of their indices.
    pub fn tiles(&self) -> Vec<IVec2> {
        let mut all: Vec<IVec2> = self.tiles.keys().copied().collect();
        all.sort_unstable_by_key(|t| [t.y, t.x]);
        all
    }

    pub fn tile(&self, tile: IVec2) -> Option<&[Column; N_CELLS]> {
        self.tiles.get(&tile).map(|columns| &**columns)
    }

    pub fn bytes(&self) -> usize {
        self.tiles.len() * TILE_BYTES
    }
}
