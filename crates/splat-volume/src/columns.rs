//! Voxels -> for each cell of the ground plane columns of bits: where surfaces were seen, where free space, and what is behind surfaces.

use std::collections::HashMap;

use glam::{IVec2, IVec3};

use crate::voxels::{SIDE, State, Voxels};

/// Voxels of a column, from `BELOW` under the level of the ground on.
pub const HEIGHT: i32 = 128;
/// Of them below that level.
pub const BELOW: i32 = 40;
const N_CELLS: usize = (SIDE * SIDE) as usize;

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
            for (at, column) in columns.iter_mut().enumerate() {
                let (x, y) = (at as i32 % SIDE, at as i32 / SIDE);
                let Some(states) = voxels.states(block, x, y) else {
                    break;
                };
                for (k, state) in states.into_iter().enumerate() {
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
        self.tiles.len() * (N_CELLS * size_of::<Column>() + 24)
    }
}
