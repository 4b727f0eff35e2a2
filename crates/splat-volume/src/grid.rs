//! Columns above the ground -> cells that are free, occupied or unknown.
//!
//! Unknown is never free. A cell is occupied where a surface rises above the local ground and below the height of the robot, or where the ground
//! falls away; it is free where nothing does and enough of the space that the robot needs was seen to be empty.

use std::collections::{HashMap, VecDeque};

use glam::{DVec2, IVec2};

use crate::blocks::SIDE;
use crate::columns::{Column, Columns, HEIGHT};
use crate::params::GridParams;
use crate::volume::Volume;

pub const FREE: i8 = 0;
pub const OCCUPIED: i8 = 100;
pub const UNKNOWN: i8 = -1;
/// Cells along a side; what is farther from the robot is left out. 205 m at 5 cm, 16 MiB.
pub const MAX_SIDE: i32 = 4096;
/// A grid grows by so many cells at once: a change of its size makes Nav2 clear all layers.
const GROWTH: i32 = 128;
/// Heights of a tile's cells, from below: this share of them lies below its ground, and another one not far above it, or it is no ground.
const GROUND_SHARE: f64 = 0.2;
const FLAT_SHARE: f64 = 0.7;
/// A tile with fewer surfaces says nothing of the ground.
const MIN_SURFACES: usize = 8;
/// Ground is begun where a tile lies so near the ground plane, metres.
const NEAR_PLANE: f64 = 0.1;
/// Share of the robot's height that was seen free above ground that was seen, and above any other.
const FREE_OVER_GROUND: f64 = 0.25;
const FREE_OVER_NOTHING: f64 = 0.5;
/// Where no ground was seen, free space begins at most so high above it, metres: what nobody has seen from above may stand below.
const MAX_UNSEEN: f64 = 0.1;
/// A hole is free space below the ground in more than one voxel.
const MIN_HOLE: u32 = 2;

/// Where a grid lies: cell (0, 0) of it is `first` of the level frame, whose cell (x, y) begins at (x, y) times the resolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    pub first: IVec2,
    pub width: i32,
    pub height: i32,
}

/// Row by row from the lowest y; -1, 0 or 100.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    pub extent: Extent,
    /// Metres.
    pub resolution: f64,
    pub cells: Vec<i8>,
    /// Some of the map lies beyond its border.
    pub is_cropped: bool,
}

impl Extent {
    /// Of all tiles, whole `GROWTH`s of cells, no smaller than `before` and around `focus` where they are too many.
    pub fn around(tiles: &[IVec2], before: Option<Self>, focus: IVec2) -> (Self, bool) {
        let mut low = tiles.iter().fold(IVec2::MAX, |a, b| a.min(*b * SIDE));
        let mut high = tiles.iter().fold(IVec2::MIN, |a, b| a.max((*b + 1) * SIDE));
        if tiles.is_empty() {
            (low, high) = (focus, focus + 1);
        }
        if let Some(before) = before {
            low = low.min(before.first);
            high = high.max(before.first + IVec2::new(before.width, before.height));
        }
        let step = IVec2::splat(GROWTH);
        let mut first = low.div_euclid(step) * step;
        let mut last = (high - 1).div_euclid(step) * step + step;
        let is_cropped = (last - first).max_element() > MAX_SIDE;
        if is_cropped {
            let middle = focus.div_euclid(step) * step;
            first = first.max(middle - MAX_SIDE / 2);
            last = last.min(middle + MAX_SIDE / 2).max(first + step);
        }
        let size = last - first;
        let extent = Self {
            first,
            width: size.x,
            height: size.y,
        };
        (extent, is_cropped)
    }

    pub fn n_cells(&self) -> usize {
        self.width as usize * self.height as usize
    }

    fn index(&self, cell: IVec2) -> Option<usize> {
        let at = cell - self.first;
        let is_inside = at.x >= 0 && at.y >= 0 && at.x < self.width && at.y < self.height;
        is_inside.then(|| at.y as usize * self.width as usize + at.x as usize)
    }
}

impl Grid {
    /// Lower left corner, metres.
    pub fn origin(&self) -> DVec2 {
        self.extent.first.as_dvec2() * self.resolution
    }

    /// Of a cell of the level frame; unknown outside.
    pub fn cell(&self, cell: IVec2) -> i8 {
        self.extent.index(cell).map_or(UNKNOWN, |at| self.cells[at])
    }

    /// The first and the last cell of the part that holds all known ones; `None` where none is.
    pub fn known(&self) -> Option<(IVec2, IVec2)> {
        let width = self.extent.width;
        let cells = self.cells.iter().enumerate();
        let known = cells.filter(|(_, cell)| **cell != UNKNOWN);
        let places = known.map(|(at, _)| IVec2::new(at as i32 % width, at as i32 / width));
        let bounds = places.fold(None, |bounds: Option<(IVec2, IVec2)>, at| {
            let (low, high) = bounds.unwrap_or((at, at));
            Some((low.min(at), high.max(at)))
        });
        let first = self.extent.first;
        bounds.map(|(low, high)| (low + first, high + first))
    }

    /// The smallest part that holds all cells that differ from `before`, which has the same extent: x, y, width and height in cells of the
    /// grid; `None` where none does.
    pub fn changed_since(&self, before: &Self) -> Option<[usize; 4]> {
        let width = self.extent.width as usize;
        let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
        for (at, (new, old)) in self.cells.iter().zip(&before.cells).enumerate() {
            if new != old {
                let place = [at % width, at / width];
                low = [0, 1].map(|i| low[i].min(place[i]));
                high = [0, 1].map(|i| high[i].max(place[i] + 1));
            }
        }
        (low[0] < high[0]).then(|| [low[0], low[1], high[0] - low[0], high[1] - low[1]])
    }

    /// Cells of a part, row by row.
    pub fn part(&self, [x, y, width, height]: [usize; 4]) -> Vec<i8> {
        let side = self.extent.width as usize;
        (y..y + height)
            .flat_map(|row| &self.cells[row * side + x..row * side + x + width])
            .copied()
            .collect()
    }
}

/// Cells of all that was fused, no smaller than `before` and around the cell `focus` where they are too many; `None` while no ground was found.
pub fn grid(volume: &mut Volume, before: Option<Extent>, focus: IVec2) -> Option<Grid> {
    let ground = volume.ground()?;
    let params = volume.params().clone();
    let voxel = (ground.height / params.resolution).floor() as i32;
    Some(of_columns(volume.columns(), voxel, &params, before, focus))
}

/// `ground` is the index of the ground plane's voxel along z.
fn of_columns(
    columns: &Columns,
    ground: i32,
    params: &GridParams,
    before: Option<Extent>,
    focus: IVec2,
) -> Grid {
    let tiles = columns.tiles();
    let (extent, is_cropped) = Extent::around(&tiles, before, focus);
    let mut cells = vec![UNKNOWN; extent.n_cells()];
    let heights = ground_heights(columns, &tiles, ground - columns.foot, params);
    let rules = Rules::new(params);
    for tile in &tiles {
        let (Some(own), Some(height)) = (columns.tile(*tile), heights.get(tile)) else {
            continue;
        };
        for (at, column) in own.iter().enumerate() {
            let cell = *tile * SIDE + IVec2::new(at as i32 % SIDE, at as i32 / SIDE);
            if let Some(index) = extent.index(cell) {
                cells[index] = rules.judge(column, *height);
            }
        }
    }
    Grid {
        extent,
        resolution: params.resolution,
        cells,
        is_cropped,
    }
}

/// Local ground of each tile, as a bit of its columns: from the ground plane on, over tiles that rise or fall less than the slope that the robot
/// climbs; elsewhere that of the nearest such tile.
fn ground_heights(
    columns: &Columns,
    tiles: &[IVec2],
    plane: i32,
    params: &GridParams,
) -> HashMap<IVec2, i32> {
    let voxel = params.resolution;
    let slope = params.max_slope_deg.to_radians().tan();
    let climb = (slope * f64::from(SIDE)).round() as i32 + 1;
    let candidates: HashMap<IVec2, i32> = tiles
        .iter()
        .filter_map(|tile| Some((*tile, lowest_surface(columns.tile(*tile)?, climb)?)))
        .collect();
    let near = (NEAR_PLANE / voxel).ceil() as i32;
    let mut heights = HashMap::new();
    let mut queue = VecDeque::new();
    for tile in tiles {
        if let Some(height) = candidates.get(tile)
            && (height - plane).abs() <= near
        {
            heights.insert(*tile, *height);
            queue.push_back(*tile);
        }
    }
    let has: std::collections::HashSet<IVec2> = tiles.iter().copied().collect();
    // Twice: over ground that was seen, then to all other tiles.
    for is_seen in [true, false] {
        if !is_seen {
            let mut reached: Vec<IVec2> = heights.keys().copied().collect();
            reached.sort_unstable_by_key(|t| [t.y, t.x]);
            queue = reached.into();
        }
        while let Some(tile) = queue.pop_front() {
            let height = heights[&tile];
            for step in [IVec2::X, IVec2::Y, IVec2::NEG_X, IVec2::NEG_Y] {
                let next = tile + step;
                if !has.contains(&next) || heights.contains_key(&next) {
                    continue;
                }
                if !is_seen {
                    heights.insert(next, height);
                    queue.push_back(next);
                } else if let Some(own) = candidates.get(&next)
                    && (own - height).abs() <= climb
                {
                    heights.insert(next, *own);
                    queue.push_back(next);
                }
            }
        }
    }
    for tile in tiles {
        heights.entry(*tile).or_insert(plane);
    }
    heights
}

/// `None`: too few cells show a surface, or their heights differ by more than the ground does: noise and edges are no ramp to a table.
fn lowest_surface(columns: &[Column; 64], climb: i32) -> Option<i32> {
    let mut lowest: Vec<i32> = columns
        .iter()
        .filter(|column| column.surface != 0)
        .map(|column| column.surface.trailing_zeros() as i32)
        .collect();
    lowest.sort_unstable();
    let at = |share: f64| lowest.get((lowest.len() as f64 * share) as usize).copied();
    let (ground, most) = (at(GROUND_SHARE)?, at(FLAT_SHARE)?);
    (lowest.len() >= MIN_SURFACES && most - ground <= climb).then_some(ground)
}

/// What is free and what is not, in voxels above the local ground.
struct Rules {
    low: i32,
    high: i32,
    drop_off: i32,
    max_unseen: i32,
}

impl Rules {
    fn new(params: &GridParams) -> Self {
        let voxels = |metres: f64| (metres / params.resolution).round() as i32;
        let low = voxels(params.min_height).max(1);
        Self {
            low,
            high: voxels(params.max_height).max(low + 1),
            drop_off: voxels(params.drop_off).max(1),
            max_unseen: voxels(MAX_UNSEEN),
        }
    }

    fn judge(&self, column: &Column, ground: i32) -> i8 {
        // What lies on the ground itself may stand a voxel above or below it.
        let band = bits(ground + self.low + 1, ground + self.high + 1);
        let floor = bits(ground - self.drop_off + 1, ground + self.low + 1);
        let below = bits(0, ground - self.drop_off + 1);
        if column.surface & band != 0 {
            return OCCUPIED;
        }
        let has_ground = column.surface & floor != 0;
        let is_hole = column.surface & below != 0 || (column.free & below).count_ones() >= MIN_HOLE;
        if !has_ground && is_hole {
            return OCCUPIED;
        }
        let share = if has_ground {
            FREE_OVER_GROUND
        } else {
            FREE_OVER_NOTHING
        };
        let free = column.free & band;
        let n_unseen = free.trailing_zeros() as i32 - (ground + self.low + 1);
        let begins_low = has_ground || n_unseen <= self.max_unseen;
        // Between free voxels something may hang or stand that nobody has seen well enough: the top of a table.
        let highest = HEIGHT - free.leading_zeros() as i32;
        let between = bits(ground + self.low + 1 + n_unseen.max(0), highest);
        let is_whole = between & !free == 0 && column.inside & band == 0;
        let is_seen = f64::from(free.count_ones()) >= share * f64::from(band.count_ones());
        if free != 0 && begins_low && is_whole && is_seen {
            FREE
        } else {
            UNKNOWN
        }
    }
}

/// Bits from `low` to before `high`, as far as columns reach.
fn bits(low: i32, high: i32) -> u128 {
    let (low, high) = (low.clamp(0, HEIGHT), high.clamp(0, HEIGHT));
    let below = |n: i32| {
        if n >= HEIGHT {
            u128::MAX
        } else {
            (1_u128 << n) - 1
        }
    };
    below(high) & !below(low)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_is_judged_above_its_ground() {
        let params = GridParams::default();
        let rules = Rules::new(&params);
        let judge = |surface: u128, free: u128| {
            rules.judge(
                &Column {
                    surface,
                    free,
                    inside: 0,
                },
                40,
            )
        };
        let air = bits(42, 80);
        assert_eq!(judge(1 << 40, air), FREE);
        assert_eq!(judge(1 << 41, air), FREE, "a bump of a voxel");
        assert_eq!(judge((1 << 40) | (1 << 50), air), OCCUPIED);
        assert_eq!(judge((1 << 40) | (1 << 90), air), FREE, "above the robot");
        assert_eq!(judge(0, 0), UNKNOWN);
        assert_eq!(
            judge(1 << 40, 0),
            UNKNOWN,
            "nothing was seen above the ground"
        );
        assert_eq!(judge(0, air), FREE);
        assert_eq!(
            judge(0, bits(50, 80)),
            UNKNOWN,
            "what stands below was not seen"
        );
        let behind = Column {
            surface: 1 << 40,
            free: air & bits(0, 60),
            inside: 1 << 65,
        };
        assert_eq!(rules.judge(&behind, 40), UNKNOWN, "something is in there");
        let table = air & !bits(54, 57);
        assert_eq!(judge(1 << 40, table), UNKNOWN, "seen badly");
        assert_eq!(judge(1 << 30, air), OCCUPIED, "stairs that go down");
        assert_eq!(judge(0, air | bits(20, 38)), OCCUPIED, "a hole");
    }

    #[test]
    fn bits_reach_no_farther_than_columns() {
        assert_eq!(bits(0, 128), u128::MAX);
        assert_eq!(bits(-5, 2), 3);
        assert_eq!(bits(126, 500).count_ones(), 2);
        assert_eq!(bits(9, 3), 0);
    }

    #[test]
    fn a_grid_grows_in_big_steps_and_is_bounded() {
        let tiles = [IVec2::new(-1, 0), IVec2::new(3, 2)];
        let (extent, is_cropped) = Extent::around(&tiles, None, IVec2::ZERO);
        assert_eq!(extent.first, IVec2::new(-128, 0));
        assert_eq!((extent.width, extent.height, is_cropped), (256, 128, false));
        let more = [tiles[0], tiles[1], IVec2::new(5, 5)];
        assert_eq!(Extent::around(&more, Some(extent), IVec2::ZERO).0, extent);
        let far = [IVec2::new(2500, 2500)];
        let (wide, is_cropped) = Extent::around(&far, Some(extent), IVec2::new(20_000, 20_000));
        assert!(is_cropped && wide.width <= MAX_SIDE && wide.height <= MAX_SIDE);
        assert!(wide.index(IVec2::new(20_000, 20_000)).is_some());
    }
}
