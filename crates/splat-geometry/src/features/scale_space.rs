//! A grey image -> a pyramid of Gaussian-blurred copies, and the blobs found in their differences (Lowe 2004).
//!
//! Knows nothing of descriptors or cameras. Positions are in pixels of the input image, centres at +0.5.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

/// Numbers of spare memory at most: 128 MB, what pyramids of two images of 640x480 take.
const MAX_SPARE: usize = 1 << 25;
/// Layers per octave in which extrema are looked for (Lowe 2004, section 3.3).
const LAYERS: usize = 3;
/// Blur of the first layer of every octave, in pixels of that octave.
const BASE_SIGMA: f32 = 1.6;
/// Blur that a camera image is assumed to have (Lowe 2004).
const CAMERA_SIGMA: f32 = 0.5;
/// Differences below this (of 1 = black to white) are noise. Lower than Lowe's 0.04 / LAYERS: the strongest are
/// kept anyway, and dim rooms need the weak ones.
const MIN_CONTRAST: f32 = 0.006;
/// Principal curvature ratio above which a blob is an edge.
const MAX_EDGE_RATIO: f32 = 10.0;
const BORDER: usize = 5;

/// One channel, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Grey {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<f32>,
}

/// Blurred copies of one resolution: `layers[i]` has blur `BASE_SIGMA * 2^(i / LAYERS)` in its own pixels.
#[derive(Debug)]
pub struct Octave {
    /// Input pixels per pixel of this octave.
    pub step: f32,
    pub layers: Vec<Grey>,
}

/// Memory of earlier pyramids. The system clears what it hands out, and takes longer for that than blurring takes.
#[derive(Debug, Default)]
pub struct SpareMemory(Mutex<Vec<Vec<f32>>>);

impl SpareMemory {
    /// `n` numbers that mean nothing.
    fn take(&self, n: usize) -> Vec<f32> {
        let mut spare = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fitting = spare.iter().position(|numbers| numbers.len() == n);
        let found = fitting.map(|ix| spare.swap_remove(ix));
        drop(spare);
        found.unwrap_or_else(|| vec![0.0; n])
    }

    fn keep(&self, done: impl IntoIterator<Item = Grey>) {
        let mut spare = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        spare.extend(done.into_iter().map(|grey| grey.pixels));
        // Of images of another size, perhaps.
        let mut n_spare: usize = spare.iter().map(Vec::len).sum();
        while n_spare > MAX_SPARE {
            n_spare -= spare.remove(0).len();
        }
    }

    /// Of a pyramid that is no longer needed.
    pub fn keep_all(&self, octaves: Vec<Octave>) {
        self.keep(octaves.into_iter().flat_map(|octave| octave.layers));
    }
}

/// A blob: place in its octave's pixels (centres at integers), layer and blur.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blob {
    pub octave: usize,
    pub layer: usize,
    pub x: f32,
    pub y: f32,
    /// In pixels of the octave.
    pub sigma: f32,
    pub contrast: f32,
}

impl Grey {
    /// Whether there are as many pixels as the size says.
    pub fn is_whole(&self) -> bool {
        self.pixels.len() == self.width * self.height
    }

    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.pixels[y * self.width + x]
    }

    /// Linear between the centres of the pixels.
    fn doubled(&self, spare: &SpareMemory) -> Self {
        let (w, h) = (self.width, self.height);
        let row_of = |y: usize| &self.pixels[y.min(h - 1) * w..][..w];
        let mut pixels = spare.take(4 * w * h);
        pixels
            .par_chunks_mut(2 * w)
            .enumerate()
            .for_each_init(Vec::new, |mixed, (y, out)| {
                let near = row_of(y / 2);
                let far = row_of(if y % 2 == 0 {
                    (y / 2).saturating_sub(1)
                } else {
                    y / 2 + 1
                });
                mixed.clear();
                mixed.extend(near.iter().zip(far).map(|(a, b)| 0.75 * a + 0.25 * b));
                double_row(mixed, out);
            });
        Self {
            width: 2 * w,
            height: 2 * h,
            pixels,
        }
    }

    /// Every second pixel.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let rows = self.pixels.chunks_exact(self.width).step_by(2).take(height);
        let pixels = rows
            .flat_map(|row| row.chunks_exact(2).map(|pair| pair[0]))
            .collect();
        Self {
            width,
            height,
            pixels,
        }
    }

    /// Blurred by a Gaussian.
    pub fn blurred(&self, sigma: f32) -> Self {
        self.blurred_into(vec![0.0_f32; self.pixels.len()], sigma)
    }

    /// The same in memory of as many pixels.
    fn blurred_into(&self, mut pixels: Vec<f32>, sigma: f32) -> Self {
        let kernel = half_gaussian(sigma);
        let rows = pixels.par_chunks_mut(self.width).enumerate();
        rows.for_each_init(Vec::new, |padded, (y, out)| {
            self.blur_row(y, &kernel, padded, out);
        });
        self.of_same_size(pixels)
    }

    /// Blurred, and what that has added to each pixel.
    fn blurred_with_difference(&self, sigma: f32, spare: &SpareMemory) -> (Self, Self) {
        let kernel = half_gaussian(sigma);
        let n = self.pixels.len();
        let (mut pixels, mut difference) = (spare.take(n), spare.take(n));
        let rows = pixels.par_chunks_mut(self.width);
        let rows = rows.zip(difference.par_chunks_mut(self.width)).enumerate();
        rows.for_each_init(Vec::new, |padded, (y, (out, difference))| {
            self.blur_row(y, &kernel, padded, out);
            let before = &self.pixels[y * self.width..][..self.width];
            for ((difference, after), before) in difference.iter_mut().zip(out).zip(before) {
                *difference = *after - before;
            }
        });
        (self.of_same_size(pixels), self.of_same_size(difference))
    }

    fn of_same_size(&self, pixels: Vec<f32>) -> Self {
        Self {
            width: self.width,
            height: self.height,
            pixels,
        }
    }

    /// A Gaussian down and then along a row, while the row is in the first cache. `padded` is memory for the row with its margins.
    fn blur_row(&self, y: usize, kernel: &[f32], padded: &mut Vec<f32>, out: &mut [f32]) {
        let radius = kernel.len() - 1;
        let (w, h) = (self.width, self.height);
        padded.resize(w + 2 * radius, 0.0);
        let row_of = |by: isize| &self.pixels[mirrored(y as isize + by, h) * w..][..w];
        let pairs: Vec<[&[f32]; 2]> = (0..=radius as isize)
            .map(|k| [row_of(-k), row_of(k)])
            .collect();
        weighted_sum(&pairs, kernel, &mut padded[radius..radius + w]);
        for i in 1..=radius {
            padded[radius - i] = padded[radius + mirrored(-(i as isize), w)];
            padded[radius + w - 1 + i] = padded[radius + mirrored((w - 1 + i) as isize, w)];
        }
        let shifted: Vec<[&[f32]; 2]> = (0..=radius)
            .map(|k| [&padded[radius - k..][..w], &padded[radius + k..][..w]])
            .collect();
        weighted_sum(&shifted, kernel, out);
    }
}

/// The pyramid and its blobs: extrema of the differences of neighbouring layers, refined to parts of a pixel, in a fixed
/// order. Octave 0 has twice the input's resolution: small images hold most of their blobs there.
pub fn pyramid(image: &Grey, spare: &SpareMemory) -> (Vec<Octave>, Vec<Blob>) {
    let first = image.doubled(spare);
    let sigma = (BASE_SIGMA.powi(2) - (2.0 * CAMERA_SIGMA).powi(2)).sqrt();
    let mut base = first.blurred_into(spare.take(first.pixels.len()), sigma);
    spare.keep([first]);
    let (mut octaves, mut found) = (Vec::new(), Vec::new());
    let mut step = 0.5;
    while base.width.min(base.height) >= 24 && octaves.len() < 8 {
        let (mut layers, mut differences) = (vec![base], Vec::new());
        for i in 1..LAYERS + 3 {
            let grown = layer_sigma(i).powi(2) - layer_sigma(i - 1).powi(2);
            let (next, difference) = layers[i - 1].blurred_with_difference(grown.sqrt(), spare);
            differences.push(difference);
            layers.push(next);
        }
        base = layers[LAYERS].halved();
        found.extend(blobs(octaves.len(), &differences));
        spare.keep(differences);
        octaves.push(Octave { step, layers });
        step *= 2.0;
    }
    (octaves, found)
}

/// Of one octave; `differences[i]` is layer i + 1 less layer i.
fn blobs(octave_ix: usize, differences: &[Grey]) -> Vec<Blob> {
    let (w, h) = (differences[0].width, differences[0].height);
    let rows =
        (1..=LAYERS).flat_map(|layer| (BORDER..h.saturating_sub(BORDER)).map(move |y| (layer, y)));
    let rows: Vec<(usize, usize)> = rows.collect();
    let found: Vec<Vec<Blob>> = rows
        .par_iter()
        .map_init(Vec::new, |is_peak, &(layer, y)| {
            peaks_of_row(&differences[layer], y, is_peak);
            // Nearly all are none.
            let stretches = is_peak.chunks(16).enumerate();
            let some = stretches.filter(|(_, peaks)| peaks.iter().fold(0, |a, b| a | b) != 0);
            let peaks = some.flat_map(|(ix, peaks)| {
                let here = peaks
                    .iter()
                    .enumerate()
                    .filter(|(_, is_peak)| **is_peak != 0);
                here.map(move |(at, _)| 16 * ix + at)
            });
            peaks
                .filter(|x| (BORDER..w - BORDER).contains(x))
                .filter(|&x| beats_neighbour_layers(differences, layer, x, y))
                .filter_map(|x| refined(differences, layer, x, y))
                .map(|b| Blob {
                    octave: octave_ix,
                    ..b
                })
                .collect()
        })
        .collect();
    found.into_iter().flatten().collect()
}

/// Marks the pixels of a row that are clear enough and beaten by none of their eight neighbours.
#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn peaks_of_row(difference: &Grey, y: usize, is_peak: &mut Vec<u32>) {
    let w = difference.width;
    is_peak.clear();
    is_peak.resize(w, 0);
    let n = w - 2;
    let row = |y: usize, from: usize| &difference.pixels[y * w + from..][..n];
    let (a, b, c) = (row(y - 1, 0), row(y - 1, 1), row(y - 1, 2));
    let (d, e, f) = (row(y, 0), row(y, 1), row(y, 2));
    let (g, h, i) = (row(y + 1, 0), row(y + 1, 1), row(y + 1, 2));
    for (x, out) in is_peak[1..=n].iter_mut().enumerate() {
        let high = a[x]
            .max(b[x])
            .max(c[x].max(d[x]))
            .max(f[x].max(g[x]).max(h[x].max(i[x])));
        let low = a[x]
            .min(b[x])
            .min(c[x].min(d[x]))
            .min(f[x].min(g[x]).min(h[x].min(i[x])));
        let is_high = (e[x] >= high) & (e[x] >= 0.5 * MIN_CONTRAST);
        let is_low = (e[x] <= low) & (e[x] <= -0.5 * MIN_CONTRAST);
        *out = u32::from(is_high | is_low);
    }
}

fn layer_sigma(layer: usize) -> f32 {
    BASE_SIGMA * (layer as f32 / LAYERS as f32).exp2()
}

/// The middle and one side of a Gaussian.
fn half_gaussian(sigma: f32) -> Vec<f32> {
    let radius = (3.5 * sigma).ceil() as i32;
    let raw: Vec<f32> = (0..=radius)
        .map(|x| (-0.5 * (x as f32 / sigma).powi(2)).exp())
        .collect();
    let sum: f32 = raw[0] + 2.0 * raw[1..].iter().sum::<f32>();
    raw.iter().map(|v| v / sum).collect()
}

fn double_row(row: &[f32], out: &mut [f32]) {
    let last = row.len() - 1;
    for (x, pair) in out.chunks_exact_mut(2).enumerate() {
        pair[0] = 0.75 * row[x] + 0.25 * row[x.saturating_sub(1)];
        pair[1] = 0.75 * row[x] + 0.25 * row[(x + 1).min(last)];
    }
}

fn mirrored(i: isize, n: usize) -> usize {
    let n = n as isize;
    let folded = if i < 0 {
        -i
    } else if i >= n {
        2 * n - 2 - i
    } else {
        i
    };
    folded.clamp(0, n - 1) as usize
}

/// Pixels of a row that stay in registers while all rows are added to them.
const STRETCH: usize = 64;

/// The first weight counts once, every other one for both rows of its pair.
#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn weighted_sum(pairs: &[[&[f32]; 2]], weights: &[f32], out: &mut [f32]) {
    let n = out.len();
    if n < STRETCH {
        for i in 0..n {
            out[i] = weights[0] * pairs[0][0][i];
            for ([a, b], weight) in pairs.iter().zip(weights).skip(1) {
                out[i] += weight * (a[i] + b[i]);
            }
        }
        return;
    }
    // The last stretch covers some pixels a second time.
    let starts = (0..n - STRETCH).step_by(STRETCH).chain([n - STRETCH]);
    for start in starts {
        let middle = &pairs[0][0][start..start + STRETCH];
        let mut sum: [f32; STRETCH] = std::array::from_fn(|i| weights[0] * middle[i]);
        for ([a, b], &weight) in pairs.iter().zip(weights).skip(1) {
            let (a, b) = (&a[start..start + STRETCH], &b[start..start + STRETCH]);
            for i in 0..STRETCH {
                sum[i] += weight * (a[i] + b[i]);
            }
        }
        out[start..start + STRETCH].copy_from_slice(&sum);
    }
}

/// Whether a peak of its own layer is one among the layers above and below, too.
fn beats_neighbour_layers(differences: &[Grey], layer: usize, x: usize, y: usize) -> bool {
    let w = differences[layer].width;
    let centre = differences[layer].pixels[y * w + x];
    let beats = |other: f32| {
        if centre > 0.0 {
            centre >= other
        } else {
            centre <= other
        }
    };
    [layer - 1, layer + 1].into_iter().all(|l| {
        (y - 1..=y + 1).all(|row| {
            differences[l].pixels[row * w + x - 1..row * w + x + 2]
                .iter()
                .all(|&v| beats(v))
        })
    })
}

/// Quadratic fit around an extremum (Lowe 2004, equation 3), followed over at most a few pixels.
fn refined(differences: &[Grey], mut layer: usize, mut x: usize, mut y: usize) -> Option<Blob> {
    let (w, h) = (differences[0].width, differences[0].height);
    for _ in 0..4 {
        let (below, here, above) = (
            &differences[layer - 1],
            &differences[layer],
            &differences[layer + 1],
        );
        let c = here.at(x, y);
        let gradient = [
            0.5 * (here.at(x + 1, y) - here.at(x - 1, y)),
            0.5 * (here.at(x, y + 1) - here.at(x, y - 1)),
            0.5 * (above.at(x, y) - below.at(x, y)),
        ];
        let xx = here.at(x + 1, y) + here.at(x - 1, y) - 2.0 * c;
        let yy = here.at(x, y + 1) + here.at(x, y - 1) - 2.0 * c;
        let ss = above.at(x, y) + below.at(x, y) - 2.0 * c;
        let mixed = |a: f32, b: f32, c: f32, d: f32| 0.25 * (a - b - c + d);
        let xy = mixed(
            here.at(x + 1, y + 1),
            here.at(x - 1, y + 1),
            here.at(x + 1, y - 1),
            here.at(x - 1, y - 1),
        );
        let xs = mixed(
            above.at(x + 1, y),
            above.at(x - 1, y),
            below.at(x + 1, y),
            below.at(x - 1, y),
        );
        let ys = mixed(
            above.at(x, y + 1),
            above.at(x, y - 1),
            below.at(x, y + 1),
            below.at(x, y - 1),
        );
        let hessian = nalgebra::Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
        let offset = -(hessian.try_inverse()? * nalgebra::Vector3::from(gradient));
        if offset.iter().all(|o| o.abs() <= 0.6) {
            let contrast = c + 0.5
                * (gradient[0] * offset[0] + gradient[1] * offset[1] + gradient[2] * offset[2]);
            let (trace, det) = (xx + yy, xx * yy - xy * xy);
            let is_edge = det <= 0.0
                || trace * trace * MAX_EDGE_RATIO >= (MAX_EDGE_RATIO + 1.0).powi(2) * det;
            if contrast.abs() < MIN_CONTRAST || is_edge {
                return None;
            }
            let sigma = BASE_SIGMA * ((layer as f32 + offset[2]) / LAYERS as f32).exp2();
            let (x, y) = (x as f32 + offset[0], y as f32 + offset[1]);
            return Some(Blob {
                octave: 0,
                layer,
                x,
                y,
                sigma,
                contrast: contrast.abs(),
            });
        }
        let moved = |v: usize, by: f32| (v as f32 + by.clamp(-1.0, 1.0).round()) as usize;
        (x, y, layer) = (
            moved(x, offset[0]),
            moved(y, offset[1]),
            moved(layer, offset[2]),
        );
        let inside = x >= BORDER && y >= BORDER && x < w - BORDER && y < h - BORDER;
        if !inside || !(1..=LAYERS).contains(&layer) {
            return None;
        }
    }
    None
}
