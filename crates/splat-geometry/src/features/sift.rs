//! An image -> blobs with descriptors that survive scale, turn and light (SIFT, Lowe 2004).
//!
//! The descriptor samples a turned 20x20 grid instead of every pixel, which makes its cost independent of the scale;
//! values are the square roots of RootSIFT (Arandjelovic 2012).

use rayon::prelude::*;

use crate::features::descriptor::{Descriptors, Features, MAX_SUBMAP, SIFT_LENGTH};
use crate::features::scale_space::{Blob, Grey, Octave, SpareMemory, pyramid};

/// Cells along one side of the descriptor, and directions in each.
const CELLS: usize = 4;
const DIRECTIONS: usize = 8;
const LENGTH: usize = CELLS * CELLS * DIRECTIONS;
/// Width of a cell in units of the blob's blur.
const CELL_SIGMAS: f32 = 3.0;
/// Samples along one side: 4 for each cell, and half a cell beyond the border for the soft assignment.
const GRID: usize = 20;
/// The grid and one sample more on every side, for the gradients.
const PATCH: usize = GRID + 2;
const ORIENTATION_BINS: usize = 36;
/// Most pixels from a blob's centre to the rim of what its direction is taken from: 4.5 times the largest blur of an
/// octave, 1.6 * 2^(3.6 / 3).
const MAX_RADIUS: usize = 18;
const ROW: usize = 2 * MAX_RADIUS + 2;
/// Images with a shorter side have no features.
const MIN_SIDE_PX: usize = 24;

/// At most `max_features` points, the strongest first.
pub fn features(image: &Grey, max_features: usize) -> Features {
    features_within(&SpareMemory::default(), image, max_features)
}

/// The same in memory of earlier images.
pub fn features_within(spare: &SpareMemory, image: &Grey, max_features: usize) -> Features {
    if image.width.min(image.height) < MIN_SIDE_PX || !image.is_whole() {
        return Features::default();
    }
    let (octaves, mut found) = pyramid(image, spare);
    found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
    found.truncate(max_features);
    let layer_of = |blob: &Blob| &octaves[blob.octave].layers[blob.layer];
    let turned: Vec<Vec<(Blob, f32)>> = found
        .par_iter()
        .map(|blob| {
            let angles = orientations(layer_of(blob), blob);
            angles.into_iter().map(|angle| (*blob, angle)).collect()
        })
        .collect();
    let turned: Vec<(Blob, f32)> = turned.into_iter().flatten().take(max_features).collect();
    let shares = Shares::new();
    let described = |(blob, angle): &(Blob, f32)| descriptor(layer_of(blob), blob, *angle, &shares);
    let features = Features {
        pixels: turned
            .iter()
            .map(|(b, _)| pixel(&octaves[b.octave], b))
            .collect(),
        sigmas: turned
            .iter()
            .map(|(b, _)| b.sigma * octaves[b.octave].step)
            .collect(),
        descriptors: Descriptors::Sift(turned.par_iter().map(described).collect()),
    };
    spare.keep_all(octaves);
    features
}

/// Octave 0 is the input doubled about pixel centres at +0.5; halving keeps every second centre, which shifts nothing in
/// the coordinates of octave 0 counted at integers.
fn pixel(octave: &Octave, blob: &Blob) -> glam::DVec2 {
    let to_input = |v: f32| (f64::from(v * octave.step * 2.0) + 0.5) * 0.5;
    glam::DVec2::new(to_input(blob.x), to_input(blob.y))
}

/// Main directions of the gradient around a blob: the strongest, and a second one at 80 % of it or more.
fn orientations(layer: &Grey, blob: &Blob) -> Vec<f32> {
    let spread = 1.5 * blob.sigma;
    let radius = ((3.0 * spread).round() as i32).min(MAX_RADIUS as i32);
    let (cx, cy) = (blob.x.round() as i32, blob.y.round() as i32);
    let (top, bottom) = (
        (cy - radius).max(1),
        (cy + radius).min(layer.height as i32 - 2),
    );
    let (left, right) = (
        (cx - radius).max(1),
        (cx + radius).min(layer.width as i32 - 2),
    );
    let n = (right - left + 1).max(0) as usize;
    let near =
        |at: i32, centre: f32| (-(at as f32 - centre).powi(2) / (2.0 * spread * spread)).exp();
    let across: [f32; ROW] = std::array::from_fn(|i| near(left + i as i32, blob.x));
    let mut histogram = [0.0_f32; ORIENTATION_BINS + 1];
    for y in top..=bottom {
        let at = y as usize * layer.width + left as usize;
        let row = &layer.pixels[at - 1..at + n + 1];
        let (above, below) = (
            &layer.pixels[at - layer.width..][..n],
            &layer.pixels[at + layer.width..][..n],
        );
        let (mut turn, mut size) = ([0.0_f32; ROW], [0.0_f32; ROW]);
        polar(row, (above, below), &mut turn[..n], &mut size[..n]);
        let down = near(y, blob.y);
        for i in 0..n {
            let bin = (turn[i] * ORIENTATION_BINS as f32) as i32 as usize;
            histogram[bin.min(ORIENTATION_BINS)] += across[i] * down * size[i];
        }
    }
    // A full turn is none.
    histogram[0] += histogram[ORIENTATION_BINS];
    let mut bins = [0.0; ORIENTATION_BINS];
    bins.copy_from_slice(&histogram[..ORIENTATION_BINS]);
    peaks(bins)
}

/// Directions (share of a turn) and lengths of the gradients of a row; `row` reaches one pixel further on both sides.
#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn polar(row: &[f32], (above, below): (&[f32], &[f32]), turn: &mut [f32], size: &mut [f32]) {
    let n = turn.len();
    let (left, right) = (&row[..n], &row[2..n + 2]);
    let (above, below, size) = (&above[..n], &below[..n], &mut size[..n]);
    for i in 0..n {
        let (dx, dy) = (right[i] - left[i], below[i] - above[i]);
        turn[i] = turns(dy, dx);
        size[i] = (dx * dx + dy * dy).sqrt();
    }
}

fn peaks(mut histogram: [f32; ORIENTATION_BINS]) -> Vec<f32> {
    let n = ORIENTATION_BINS;
    for _ in 0..2 {
        let before = histogram;
        for i in 0..n {
            histogram[i] =
                0.25 * before[(i + n - 1) % n] + 0.5 * before[i] + 0.25 * before[(i + 1) % n];
        }
    }
    let highest = histogram.iter().copied().fold(0.0, f32::max);
    let mut peaks: Vec<(f32, f32)> = Vec::new();
    for i in 0..n {
        let (left, here, right) = (
            histogram[(i + n - 1) % n],
            histogram[i],
            histogram[(i + 1) % n],
        );
        if here > left && here >= right && here >= 0.8 * highest {
            let peak = i as f32 + 0.5 + 0.5 * (left - right) / (left - 2.0 * here + right);
            peaks.push((here, peak / n as f32 * std::f32::consts::TAU));
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.iter().take(2).map(|p| p.1).collect()
}

/// Share of a full turn in [0, 1] of a direction; a rational fit (error below 0.002 rad) because `atan2` is most of the cost.
#[inline(always)]
fn turns(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let ratio = ax.min(ay) / (ax.max(ay) + 1e-12);
    let s = ratio * ratio;
    let mut angle = ((-0.046_496_475 * s + 0.159_314_22) * s - 0.327_622_76) * s * ratio + ratio;
    if ay > ax {
        angle = std::f32::consts::FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = std::f32::consts::PI - angle;
    }
    if y < 0.0 {
        angle = std::f32::consts::TAU - angle;
    }
    angle * (1.0 / std::f32::consts::TAU)
}

/// How much a row or column of the grid adds to the rows or columns of cells: linear between the centres of two cells,
/// times a Gaussian over the whole.
struct Shares([[f32; CELLS]; GRID]);

impl Shares {
    fn new() -> Self {
        Self(std::array::from_fn(|i| {
            let from_centre = (i as f32 + 0.5) / 4.0 - 0.5 * (GRID as f32 / 4.0); // in cells
            let gaussian =
                (-(from_centre * from_centre) / (2.0 * (0.5 * CELLS as f32).powi(2))).exp();
            let at = from_centre + 0.5 * CELLS as f32 - 0.5;
            std::array::from_fn(|cell| (1.0 - (at - cell as f32).abs()).max(0.0) * gaussian)
        }))
    }
}

fn descriptor(layer: &Grey, blob: &Blob, angle: f32, shares: &Shares) -> [u8; LENGTH] {
    let mut patch = [0.0_f32; PATCH * PATCH];
    sample_turned(layer, blob, angle, &mut patch);
    let mut histogram = [0.0_f32; LENGTH];
    gather(&patch, shares, &mut histogram);
    root_bytes(&mut histogram)
}

#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn sample_turned(layer: &Grey, blob: &Blob, angle: f32, patch: &mut [f32; PATCH * PATCH]) {
    let spacing = CELL_SIGMAS * blob.sigma / 4.0;
    let (sine, cosine) = angle.sin_cos();
    let (sine, cosine) = (sine * spacing, cosine * spacing);
    let (most_x, most_y) = ((layer.width - 1) as f32, (layer.height - 1) as f32);
    let (last_x, last_y) = (layer.width as i32 - 2, layer.height as i32 - 2);
    for (row, out) in patch.chunks_exact_mut(PATCH).enumerate() {
        let v = row as f32 - 0.5 * (PATCH - 1) as f32;
        let (mut at, mut part_x, mut part_y) = ([0_i32; PATCH], [0.0; PATCH], [0.0; PATCH]);
        for column in 0..PATCH {
            let u = column as f32 - 0.5 * (PATCH - 1) as f32;
            let x = (blob.x + cosine * u - sine * v).max(0.0).min(most_x);
            let y = (blob.y + sine * u + cosine * v).max(0.0).min(most_y);
            let (left, top) = ((x as i32).min(last_x), (y as i32).min(last_y));
            at[column] = top * layer.width as i32 + left;
            part_x[column] = x - left as f32;
            part_y[column] = y - top as f32;
        }
        for column in 0..PATCH {
            let above = &layer.pixels[at[column] as usize..][..layer.width + 2];
            let (a, b) = (above[0], above[1]);
            let (c, d) = (above[layer.width], above[layer.width + 1]);
            let upper = a + part_x[column] * (b - a);
            let lower = c + part_x[column] * (d - c);
            out[column] = upper + part_y[column] * (lower - upper);
        }
    }
}

/// Adds every gradient of the patch to the two nearest directions of the nearest four cells.
#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn gather(patch: &[f32; PATCH * PATCH], shares: &Shares, histogram: &mut [f32; LENGTH]) {
    for row in 0..GRID {
        let (mut turn, mut size) = ([0.0_f32; GRID], [0.0_f32; GRID]);
        let above = &patch[row * PATCH + 1..][..GRID];
        let here = &patch[(row + 1) * PATCH..][..PATCH];
        let below = &patch[(row + 2) * PATCH + 1..][..GRID];
        for i in 0..GRID {
            let (dx, dy) = (here[i + 2] - here[i], below[i] - above[i]);
            turn[i] = turns(dy, dx) * DIRECTIONS as f32;
            size[i] = (dx * dx + dy * dy).sqrt();
        }
        let mut cells = [[0.0_f32; DIRECTIONS]; CELLS];
        for i in 0..GRID {
            let mut spread = [0.0_f32; DIRECTIONS];
            for (direction, out) in spread.iter_mut().enumerate() {
                // The circle closes: direction 0 is direction 8, too.
                let away = (turn[i] - direction as f32).abs();
                let away = away.min(DIRECTIONS as f32 - away);
                *out = (1.0 - away).max(0.0) * size[i];
            }
            for (cell, share) in cells.iter_mut().zip(shares.0[i]) {
                for (sum, part) in cell.iter_mut().zip(spread) {
                    *sum += share * part;
                }
            }
        }
        for (cell_row, share) in shares.0[row].iter().enumerate() {
            let out = &mut histogram[cell_row * CELLS * DIRECTIONS..][..CELLS * DIRECTIONS];
            for (sum, part) in out.iter_mut().zip(cells.as_flattened()) {
                *sum += share * part;
            }
        }
    }
}

/// Clips what one strong edge may contribute, then takes square roots so that the dot product is Hellinger's.
fn root_bytes(histogram: &mut [f32; LENGTH]) -> [u8; LENGTH] {
    let length = histogram
        .iter()
        .map(|v| v * v)
        .sum::<f32>()
        .sqrt()
        .max(1e-12);
    for v in histogram.iter_mut() {
        *v = (*v / length).min(0.2);
    }
    let sum = histogram.iter().sum::<f32>().max(1e-12);
    std::array::from_fn(|i| {
        let byte = (SIFT_LENGTH * (histogram[i] / sum).sqrt()).round() as u8;
        byte.min(MAX_SUBMAP)
    })
}
