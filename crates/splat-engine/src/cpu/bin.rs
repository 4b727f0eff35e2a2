//! bin: visible splats -> for each tile of the image, the splats that touch it, near to far.
//!
//! After `project`. One depth order for the whole image, then appended to per-tile lists: every list comes out sorted.

use rayon::prelude::*;

use crate::cpu::project::{ProjectedSplat, TILE_PX};

/// Splats of one parallel task.
const CHUNK: usize = 512;
/// Pairs of splat and tile that an image may have; 8 bytes each here, more in the gradients. A sane map needs
/// fewer than a hundredth. Beyond, the farthest splats are left out and counted.
const MAX_PAIRS: u64 = 1 << 26;
/// Slack of the exact tests, in units of the exponent: rounding must not cut a visible pixel.
pub(crate) const CUT_SLACK: f32 = 0.05;

/// Splats per tile. A splat in a tile is an instance.
#[derive(Debug, Default)]
pub struct Tiles {
    pub width_px: u32,
    pub height_px: u32,
    pub n_x: usize,
    pub n_y: usize,
    /// Instances of tile t: `instances[starts[t]..starts[t + 1]]`; tiles row by row.
    pub starts: Vec<u32>,
    /// Index into the visible splats.
    pub instances: Vec<u32>,
    /// Instances of visible splat v, in order of tiles: `places[place_ranges[v][0]..place_ranges[v][1]]`.
    pub place_ranges: Vec<[u32; 2]>,
    /// Tile, and place in the tile's list.
    pub places: Vec<[u32; 2]>,
    /// Farthest splats left out because of `MAX_PAIRS`.
    pub n_left_out: usize,
    order: DepthOrder,
    hits: Vec<Hits>,
    fill: Vec<u32>,
}

/// Visible splats, near to far: depth in the upper half of a key, the splat's number in the lower.
#[derive(Debug, Default)]
struct DepthOrder {
    keys: Vec<u64>,
    scratch: Vec<u64>,
}

/// Tiles that a run of splats touches.
#[derive(Debug, Default)]
struct Hits {
    tiles: Vec<u32>,
    /// Ends in `tiles`, one per splat.
    ends: Vec<u32>,
}

/// Sorts the visible splats into tiles.
pub fn bin(visible: &[ProjectedSplat], width_px: u32, height_px: u32, out: &mut Tiles) {
    out.width_px = width_px;
    out.height_px = height_px;
    out.n_x = (width_px as usize).div_ceil(TILE_PX);
    out.n_y = (height_px as usize).div_ceil(TILE_PX);
    sort_by_depth(visible, out);
    leave_out_farthest(visible, out);
    find_hits(visible, out);
    count(out);
    place(out);
}

/// `order` holds depth bits above the visible index: sorted by depth, then by index.
fn sort_by_depth(visible: &[ProjectedSplat], out: &mut Tiles) {
    const DIGIT_BITS: u32 = 11;
    out.order.keys.clear();
    // Depths are positive, so that their bits order as they do.
    out.order.keys.extend(
        visible
            .iter()
            .enumerate()
            .map(|(ix, s)| u64::from(s.depth.to_bits()) << 32 | ix as u64),
    );
    out.order.scratch.clear();
    out.order.scratch.resize(visible.len(), 0);
    for pass in 0..3 {
        let digit = |key: u64| (key >> (32 + pass * DIGIT_BITS)) as usize & ((1 << DIGIT_BITS) - 1);
        let mut ends = [0u32; 1 << DIGIT_BITS];
        for &key in &out.order.keys {
            ends[digit(key)] += 1;
        }
        let mut sum = 0;
        for end in &mut ends {
            sum += std::mem::replace(end, sum);
        }
        for &key in &out.order.keys {
            let slot = &mut ends[digit(key)];
            out.order.scratch[*slot as usize] = key;
            *slot += 1;
        }
        std::mem::swap(&mut out.order.keys, &mut out.order.scratch);
    }
}

fn leave_out_farthest(visible: &[ProjectedSplat], out: &mut Tiles) {
    let mut n_pairs = 0;
    let n_fit = out.order.keys.iter().take_while(|&&key| {
        let [x0, y0, x1, y1] = visible[visible_ix(key)].tiles.map(u64::from);
        n_pairs += (x1 - x0) * (y1 - y0);
        n_pairs <= MAX_PAIRS
    });
    let n_fit = n_fit.count();
    out.n_left_out = out.order.keys.len() - n_fit;
    out.order.keys.truncate(n_fit);
}

fn find_hits(visible: &[ProjectedSplat], out: &mut Tiles) {
    let (order, n_x) = (&out.order.keys, out.n_x);
    out.hits
        .resize_with(order.len().div_ceil(CHUNK), Hits::default);
    out.hits
        .par_iter_mut()
        .zip(order.par_chunks(CHUNK))
        .for_each(|(hits, keys)| {
            hits.tiles.clear();
            hits.ends.clear();
            for &key in keys {
                let splat = &visible[visible_ix(key)];
                let [x0, y0, x1, y1] = splat.tiles.map(usize::from);
                for y in y0..y1 {
                    let touched = (x0..x1).filter(|&x| touches(splat, x, y));
                    hits.tiles.extend(touched.map(|x| (y * n_x + x) as u32));
                }
                hits.ends.push(hits.tiles.len() as u32);
            }
        });
}

/// Whether the ellipse of alpha = `MIN_ALPHA` reaches a pixel centre's bounds in the tile: minimum of the convex
/// exponent over the rectangle (the corner test of StopThePop, Radl et al. 2024, made exact).
fn touches(splat: &ProjectedSplat, tile_x: usize, tile_y: usize) -> bool {
    let [a, b, c] = splat.conic;
    let side = (TILE_PX - 1) as f32;
    let x0 = (tile_x * TILE_PX) as f32 + 0.5 - splat.center[0];
    let y0 = (tile_y * TILE_PX) as f32 + 0.5 - splat.center[1];
    let (x1, y1) = (x0 + side, y0 + side);
    let near_x = 0.0_f32.max(x0).min(x1);
    let near_y = 0.0_f32.max(y0).min(y1);
    let exponent = |x: f32, y: f32| 0.5 * (a * x * x + c * y * y) + b * x * y;
    // The minimum lies on an edge that faces the centre; along it the exponent is a parabola.
    let on_vertical = exponent(near_x, (-b * near_x / c).max(y0).min(y1));
    let on_horizontal = exponent((-b * near_y / a).max(x0).min(x1), near_y);
    on_vertical.min(on_horizontal) <= splat.cut + CUT_SLACK
}

fn count(out: &mut Tiles) {
    out.starts.clear();
    out.starts.resize(out.n_x * out.n_y + 1, 0);
    for hits in &out.hits {
        for &tile in &hits.tiles {
            out.starts[tile as usize + 1] += 1;
        }
    }
    for t in 1..out.starts.len() {
        out.starts[t] += out.starts[t - 1];
    }
}

fn place(out: &mut Tiles) {
    let n_visible = out.order.keys.len() + out.n_left_out;
    let n_instances = out.starts.last().map_or(0, |&n| n as usize);
    out.instances.resize(n_instances, 0);
    out.places.clear();
    out.places.reserve(n_instances);
    out.place_ranges.clear();
    out.place_ranges.resize(n_visible, [0; 2]);
    // Runs from a tile's first instance to its end while the tile fills.
    out.fill.clear();
    out.fill.extend_from_slice(&out.starts);
    for (hits, keys) in out.hits.iter().zip(out.order.keys.chunks(CHUNK)) {
        let mut begin = 0;
        for (&key, &end) in keys.iter().zip(&hits.ends) {
            let visible_ix = visible_ix(key);
            let first = out.places.len() as u32;
            for &tile in &hits.tiles[begin..end as usize] {
                let next = &mut out.fill[tile as usize];
                out.instances[*next as usize] = visible_ix as u32;
                out.places.push([tile, *next - out.starts[tile as usize]]);
                *next += 1;
            }
            begin = end as usize;
            out.place_ranges[visible_ix] = [first, out.places.len() as u32];
        }
    }
}

fn visible_ix(key: u64) -> usize {
    (key & u64::from(u32::MAX)) as usize
}

impl Tiles {
    pub fn n_tiles(&self) -> usize {
        self.n_x * self.n_y
    }

    /// Visible splats of a tile, near to far.
    pub fn of(&self, tile: usize) -> &[u32] {
        &self.instances[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}
