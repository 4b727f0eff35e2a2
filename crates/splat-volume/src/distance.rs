//! A grid -> the distance of each cell to the nearest obstacle.
//!
//! Exact Euclidean distances by lower envelopes of parabolas: Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012.

use rayon::prelude::*;

use crate::grid::{Grid, OCCUPIED, UNKNOWN};

/// Of cells that nobody knows, as nvblox has it.
pub const UNKNOWN_DISTANCE: f32 = 1000.0;

/// Metres from the middle of each cell to the middle of the nearest occupied one; within obstacles negative, to the nearest that is not occupied.
/// At most `max`; cells that are unknown have `UNKNOWN_DISTANCE`.
pub fn signed_distances(grid: &Grid, max: f64) -> Vec<f32> {
    let (width, height) = (grid.extent.width as usize, grid.extent.height as usize);
    let outside = squared(grid, width, height, |cell| cell == OCCUPIED);
    let inside = squared(grid, width, height, |cell| cell != OCCUPIED);
    let metres = |squared: f32| (f64::from(squared).sqrt() * grid.resolution).min(max) as f32;
    grid.cells
        .iter()
        .zip(outside.iter().zip(&inside))
        .map(|(cell, (outside, inside))| match *cell {
            UNKNOWN => UNKNOWN_DISTANCE,
            OCCUPIED => -metres(*inside),
            _ => metres(*outside),
        })
        .collect()
}

/// In cells, squared; infinite where there is no site.
fn squared(grid: &Grid, width: usize, height: usize, is_site: fn(i8) -> bool) -> Vec<f32> {
    let site = |cell: &i8| {
        if is_site(*cell) { 0.0 } else { f32::INFINITY }
    };
    let mut rows: Vec<f32> = grid.cells.iter().map(site).collect();
    rows.par_chunks_mut(width.max(1)).for_each(lower_envelope);
    let mut columns = transposed(&rows, width, height);
    columns
        .par_chunks_mut(height.max(1))
        .for_each(lower_envelope);
    transposed(&columns, height, width)
}

fn transposed(rows: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut columns = vec![0.0; rows.len()];
    columns
        .par_chunks_mut(height.max(1))
        .enumerate()
        .for_each(|(x, column)| {
            for (y, value) in column.iter_mut().enumerate() {
                *value = rows[y * width + x];
            }
        });
    columns
}

/// f(q) -> min over q of (p - q)^2 + f(q).
pub(crate) fn lower_envelope(line: &mut [f32]) {
    // Parabolas of the envelope: where each stands, its height, and from where on it is the lowest.
    let mut parabolas: Vec<(f64, f64, f64)> = Vec::new();
    for (q, f) in line.iter().enumerate() {
        if !f.is_finite() {
            continue;
        }
        let (q, f) = (q as f64, f64::from(*f));
        let mut from = f64::NEG_INFINITY;
        while let Some((v, g, start)) = parabolas.last().copied() {
            from = ((f + q * q) - (g + v * v)) / (2.0 * (q - v));
            if from > start {
                break;
            }
            parabolas.pop();
            from = f64::NEG_INFINITY;
        }
        parabolas.push((q, f, from));
    }
    if parabolas.is_empty() {
        return;
    }
    let mut at = 0;
    for (p, value) in line.iter_mut().enumerate() {
        let p = p as f64;
        while at + 1 < parabolas.len() && parabolas[at + 1].2 <= p {
            at += 1;
        }
        let (v, g, _) = parabolas[at];
        *value = ((p - v) * (p - v) + g) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{Extent, FREE};
    use glam::IVec2;
    use rand::{RngExt, SeedableRng};

    fn random_grid(seed: u64) -> Grid {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(seed);
        let (width, height) = (37, 23);
        let cells = (0..width * height)
            .map(|_| match rng.random_range(0..20) {
                0 => OCCUPIED,
                1..4 => UNKNOWN,
                _ => FREE,
            })
            .collect();
        Grid {
            extent: Extent {
                first: IVec2::ZERO,
                width,
                height,
            },
            resolution: 0.1,
            cells,
            is_cropped: false,
        }
    }

    #[test]
    fn distances_are_those_of_brute_force() {
        for seed in 0..20 {
            let grid = random_grid(seed);
            let found = signed_distances(&grid, 1e9);
            let place = |at: usize| glam::DVec2::new((at % 37) as f64, (at / 37) as f64);
            for (at, cell) in grid.cells.iter().enumerate() {
                let is_occupied = *cell == OCCUPIED;
                let nearest = (0..grid.cells.len())
                    .filter(|other| (grid.cells[*other] == OCCUPIED) != is_occupied)
                    .map(|other| place(at).distance(place(other)) * 0.1)
                    .fold(f64::INFINITY, f64::min);
                let wanted = match *cell {
                    UNKNOWN => 1000.0,
                    OCCUPIED => -nearest,
                    _ => nearest,
                };
                assert!((f64::from(found[at]) - wanted).abs() < 1e-5, "{seed} {at}");
            }
        }
    }

    #[test]
    fn without_obstacles_everything_is_far() {
        let mut grid = random_grid(1);
        grid.cells.fill(FREE);
        assert!(signed_distances(&grid, 2.0).iter().all(|d| *d == 2.0));
        grid.cells.fill(OCCUPIED);
        assert!(signed_distances(&grid, 2.0).iter().all(|d| *d == -2.0));
    }
}
