//! A grey picture -> a pyramid of Gaussian-blurred copies, and the blobs found in their differences (Lowe 2004).
//!
//! Knows nothing of descriptors or cameras. Positions are in pixels of the input picture, centres at +0.5.

use rayon::prelude::*;

/// Layers per octave in which extrema are looked for (Lowe 2004, section 3.3).
const LAYERS: usize = 3;
/// Blur of the first layer of every octave, in pixels of that octave.
const BASE_SIGMA: f32 = 1.6;
/// Blur that a camera picture is assumed to have (Lowe 2004).
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
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.pixels[y * self.width + x]
    }

    /// Bilinear, clamped to the border; integer coordinates are pixel centres.
    #[inline]
    pub fn sample(&self, x: f32, y: f32) -> f32 {
        let x = x.clamp(0.0, (self.width - 1) as f32);
        let y = y.clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (top, bottom) = (y0 * self.width, y1 * self.width);
        let p = &self.pixels;
        let a = p[top + x0] + fx * (p[top + x1] - p[top + x0]);
        let b = p[bottom + x0] + fx * (p[bottom + x1] - p[bottom + x0]);
        a + fy * (b - a)
    }

    fn doubled(&self) -> Self {
        let (width, height) = (self.width * 2, self.height * 2);
        let mut pixels = vec![0.0; width * height];
        pixels
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, out) in row.iter_mut().enumerate() {
                    *out = self.sample((x as f32 + 0.5) * 0.5 - 0.5, (y as f32 + 0.5) * 0.5 - 0.5);
                }
            });
        Self {
            width,
            height,
            pixels,
        }
    }

    /// Every second pixel.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let rows = (0..height).flat_map(|y| (0..width).map(move |x| (2 * x, 2 * y)));
        Self {
            width,
            height,
            pixels: rows.map(|(x, y)| self.at(x, y)).collect(),
        }
    }

    fn blurred(&self, sigma: f32) -> Self {
        let kernel = gaussian(sigma);
        let radius = kernel.len() / 2;
        let (w, h) = (self.width, self.height);
        let mut across = vec![0.0_f32; w * h];
        across
            .par_chunks_mut(w)
            .zip(self.pixels.par_chunks(w))
            .for_each(|(out, row)| blur_row(row, &kernel, out));
        let mut pixels = vec![0.0_f32; w * h];
        pixels.par_chunks_mut(w).enumerate().for_each(|(y, out)| {
            let row_of = |k: usize| mirrored(y as isize + k as isize - radius as isize, h) * w;
            let rows: Vec<&[f32]> = (0..kernel.len())
                .map(|k| &across[row_of(k)..row_of(k) + w])
                .collect();
            weighted_sum(&rows, &kernel, out);
        });
        Self {
            width: w,
            height: h,
            pixels,
        }
    }
}

/// The pyramid. Octave 0 has twice the input's resolution: small pictures hold most of their blobs there.
pub fn pyramid(picture: &Grey) -> Vec<Octave> {
    let first = picture.doubled();
    let mut base = first.blurred((BASE_SIGMA.powi(2) - (2.0 * CAMERA_SIGMA).powi(2)).sqrt());
    let mut octaves = Vec::new();
    let mut step = 0.5;
    while base.width.min(base.height) >= 24 && octaves.len() < 8 {
        let mut layers = vec![base];
        for i in 1..LAYERS + 3 {
            let grown = layer_sigma(i).powi(2) - layer_sigma(i - 1).powi(2);
            layers.push(layers[i - 1].blurred(grown.sqrt()));
        }
        base = layers[LAYERS].halved();
        octaves.push(Octave { step, layers });
        step *= 2.0;
    }
    octaves
}

/// Extrema of the differences of neighbouring layers, refined to parts of a pixel, in a fixed order.
pub fn blobs(octaves: &[Octave]) -> Vec<Blob> {
    octaves
        .iter()
        .enumerate()
        .flat_map(|(ix, octave)| blobs_of_octave(ix, octave))
        .collect()
}

fn blobs_of_octave(octave_ix: usize, octave: &Octave) -> Vec<Blob> {
    let (w, h) = (octave.layers[0].width, octave.layers[0].height);
    let differences: Vec<Grey> = octave
        .layers
        .par_windows(2)
        .map(|pair| {
            let pixels = pair[1]
                .pixels
                .iter()
                .zip(&pair[0].pixels)
                .map(|(a, b)| a - b)
                .collect();
            Grey {
                width: w,
                height: h,
                pixels,
            }
        })
        .collect();
    let rows =
        (1..=LAYERS).flat_map(|layer| (BORDER..h.saturating_sub(BORDER)).map(move |y| (layer, y)));
    let rows: Vec<(usize, usize)> = rows.collect();
    let found: Vec<Vec<Blob>> = rows
        .par_iter()
        .map(|&(layer, y)| {
            let candidates =
                (BORDER..w - BORDER).filter(|&x| is_extremum(&differences, layer, x, y));
            candidates
                .filter_map(|x| refined(&differences, layer, x, y))
                .map(|b| Blob {
                    octave: octave_ix,
                    ..b
                })
                .collect()
        })
        .collect();
    found.into_iter().flatten().collect()
}

fn layer_sigma(layer: usize) -> f32 {
    BASE_SIGMA * (layer as f32 / LAYERS as f32).exp2()
}

fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (3.5 * sigma).ceil() as i32;
    let raw: Vec<f32> = (-radius..=radius)
        .map(|x| (-0.5 * (x as f32 / sigma).powi(2)).exp())
        .collect();
    let sum: f32 = raw.iter().sum();
    raw.iter().map(|v| v / sum).collect()
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

fn blur_row(row: &[f32], kernel: &[f32], out: &mut [f32]) {
    let (w, radius) = (row.len(), kernel.len() / 2);
    let padded: Vec<f32> = (0..w + 2 * radius)
        .map(|i| row[mirrored(i as isize - radius as isize, w)])
        .collect();
    let shifted: Vec<&[f32]> = (0..kernel.len()).map(|k| &padded[k..k + w]).collect();
    weighted_sum(&shifted, kernel, out);
}

/// Most of the time of finding features goes here.
#[multiversion::multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn weighted_sum(rows: &[&[f32]], weights: &[f32], out: &mut [f32]) {
    // A short stretch of the output stays in registers while all rows are added to it.
    const STRETCH: usize = 32;
    let n = out.len();
    for start in (0..n - n % STRETCH).step_by(STRETCH) {
        let mut sum = [0.0_f32; STRETCH];
        for (row, &weight) in rows.iter().zip(weights) {
            for (s, &v) in sum.iter_mut().zip(&row[start..start + STRETCH]) {
                *s += weight * v;
            }
        }
        out[start..start + STRETCH].copy_from_slice(&sum);
    }
    for i in n - n % STRETCH..n {
        out[i] = rows
            .iter()
            .zip(weights)
            .map(|(row, weight)| weight * row[i])
            .sum();
    }
}

fn is_extremum(differences: &[Grey], layer: usize, x: usize, y: usize) -> bool {
    let w = differences[layer].width;
    let centre = differences[layer].pixels[y * w + x];
    if centre.abs() < 0.5 * MIN_CONTRAST {
        return false;
    }
    let beats = |other: f32| {
        if centre > 0.0 {
            centre >= other
        } else {
            centre <= other
        }
    };
    [layer, layer - 1, layer + 1].into_iter().all(|l| {
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
