//! A picture -> distinctive points with descriptors that survive scale, turn and light (SIFT, Lowe 2004).
//!
//! Knows nothing of cameras or other pictures. The descriptor samples a turned 20x20 grid instead of every pixel,
//! which makes its cost independent of the scale; values are the square roots of RootSIFT (Arandjelovic 2012).

use fast_image_resize as fir;
use rayon::prelude::*;

use crate::frame::RgbImage;
use crate::geometry::scale_space::{Blob, Grey, Octave, blobs, pyramid};

pub const DESCRIPTOR_BYTES: usize = 128;
/// Cells along one side of the descriptor, and directions in each.
const CELLS: usize = 4;
const DIRECTIONS: usize = 8;
/// Width of a cell in units of the blob's blur.
const CELL_SIGMAS: f32 = 3.0;
/// Samples along one side: 4 for each cell, and half a cell beyond the border for the soft assignment.
const GRID: usize = 20;
const ORIENTATION_BINS: usize = 36;

pub type Descriptor = [u8; DESCRIPTOR_BYTES];

/// Points of one picture, the strongest first.
#[derive(Debug, Clone, Default)]
pub struct Features {
    /// In pixels of the working picture, centres at +0.5.
    pub pixels: Vec<glam::DVec2>,
    /// Blur at which the point was found, in pixels of the working picture.
    pub sigmas: Vec<f32>,
    pub descriptors: Vec<Descriptor>,
}

/// The grey picture that features are found on: the longer side is at most `max_side`.
pub fn working_picture(image: &RgbImage, max_side: u32) -> Grey {
    let luma = |p: &[u8]| {
        (77 * u32::from(p[0]) + 150 * u32::from(p[1]) + 29 * u32::from(p[2])) as f32
            / (256.0 * 255.0)
    };
    let (w, h) = (image.width_px, image.height_px);
    let pixels: Vec<f32> = image.pixels.chunks_exact(3).map(luma).collect();
    let full = Grey {
        width: w as usize,
        height: h as usize,
        pixels,
    };
    let (small_w, small_h) = working_size(w, h, max_side);
    if (small_w, small_h) == (w, h) || full.pixels.len() != full.width * full.height {
        return full;
    }
    resized(&full, small_w, small_h).unwrap_or(full)
}

pub fn working_size(width_px: u32, height_px: u32, max_side: u32) -> (u32, u32) {
    let longest = width_px.max(height_px);
    if longest <= max_side {
        return (width_px, height_px);
    }
    let scaled = |side: u32| {
        ((f64::from(side) * f64::from(max_side) / f64::from(longest)).round() as u32).max(1)
    };
    (scaled(width_px), scaled(height_px))
}

/// At most `max_features` points of a picture. Pictures below 24 pixels on a side have none.
pub fn features(picture: &Grey, max_features: usize) -> Features {
    if picture.width.min(picture.height) < 24
        || picture.pixels.len() != picture.width * picture.height
    {
        return Features::default();
    }
    let octaves = pyramid(picture);
    let mut found = blobs(&octaves);
    found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
    found.truncate(max_features);
    let weights = CellWeights::new();
    let described: Vec<Vec<(Blob, Descriptor)>> = found
        .par_iter()
        .map(|blob| {
            let layer = &octaves[blob.octave].layers[blob.layer];
            let describe = |angle| (*blob, descriptor(layer, blob, angle, &weights));
            orientations(layer, blob)
                .into_iter()
                .map(describe)
                .collect()
        })
        .collect();
    let mut out = Features::default();
    for (blob, descriptor) in described.into_iter().flatten().take(max_features) {
        out.push(&octaves[blob.octave], &blob, descriptor);
    }
    out
}

impl Features {
    pub fn len(&self) -> usize {
        self.pixels.len()
    }

    pub fn is_empty(&self) -> bool {
        self.pixels.is_empty()
    }

    fn push(&mut self, octave: &Octave, blob: &Blob, descriptor: Descriptor) {
        // Octave 0 is the input doubled about pixel centres at +0.5; halving keeps every second centre, which shifts
        // nothing in the coordinates of octave 0 counted at integers.
        let to_first = |v: f32| f64::from(v * octave.step * 2.0);
        let to_input = |v: f32| (to_first(v) + 0.5) * 0.5;
        self.pixels
            .push(glam::DVec2::new(to_input(blob.x), to_input(blob.y)));
        self.sigmas.push(blob.sigma * octave.step);
        self.descriptors.push(descriptor);
    }
}

fn resized(full: &Grey, width: u32, height: u32) -> Option<Grey> {
    let bytes: Vec<u8> = full.pixels.iter().flat_map(|v| v.to_ne_bytes()).collect();
    let source = fir::images::Image::from_vec_u8(
        full.width as u32,
        full.height as u32,
        bytes,
        fir::PixelType::F32,
    )
    .ok()?;
    let mut target = fir::images::Image::new(width, height, fir::PixelType::F32);
    let options =
        fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(fir::FilterType::Hamming));
    fir::Resizer::new()
        .resize(&source, &mut target, &options)
        .ok()?;
    let words = target.buffer().chunks_exact(4);
    let pixels = words
        .map(|b| f32::from_ne_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    Some(Grey {
        width: width as usize,
        height: height as usize,
        pixels,
    })
}

/// Main directions of the gradient around a blob: the strongest, and a second one at 80 % of it or more.
fn orientations(layer: &Grey, blob: &Blob) -> Vec<f32> {
    let spread = 1.5 * blob.sigma;
    let radius = (3.0 * spread).round() as i32;
    let (cx, cy) = (blob.x.round() as i32, blob.y.round() as i32);
    let mut histogram = [0.0_f32; ORIENTATION_BINS];
    for y in (cy - radius).max(1)..=(cy + radius).min(layer.height as i32 - 2) {
        for x in (cx - radius).max(1)..=(cx + radius).min(layer.width as i32 - 2) {
            let (ux, uy) = (x as usize, y as usize);
            let dx = layer.at(ux + 1, uy) - layer.at(ux - 1, uy);
            let dy = layer.at(ux, uy + 1) - layer.at(ux, uy - 1);
            let away = ((x as f32 - blob.x).powi(2) + (y as f32 - blob.y).powi(2))
                / (2.0 * spread * spread);
            let turn = turns(dy, dx) * ORIENTATION_BINS as f32;
            histogram[turn as usize % ORIENTATION_BINS] +=
                (-away).exp() * (dx * dx + dy * dy).sqrt();
        }
    }
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
#[inline]
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
    angle / std::f32::consts::TAU
}

/// How much each grid sample adds to each cell: bilinear between cell centres times a Gaussian over the whole.
struct CellWeights {
    /// For every sample up to four (cell, weight).
    shares: Vec<[(usize, f32); 4]>,
}

impl CellWeights {
    fn new() -> Self {
        let along = |i: usize| (i as f32 + 0.5) / 4.0 - 0.5 * (GRID as f32 / 4.0); // in cells from the centre
        let mut shares = Vec::with_capacity(GRID * GRID);
        for row in 0..GRID {
            for column in 0..GRID {
                let (x, y) = (along(column), along(row));
                let gaussian = (-(x * x + y * y) / (2.0 * (0.5 * CELLS as f32).powi(2))).exp();
                let mut share = [(0, 0.0); 4];
                for (k, slot) in share.iter_mut().enumerate() {
                    let (bx, by) = (x + 0.5 * CELLS as f32 - 0.5, y + 0.5 * CELLS as f32 - 0.5);
                    let (cx, cy) = (bx.floor() + (k % 2) as f32, by.floor() + (k / 2) as f32);
                    let inside =
                        (0.0..CELLS as f32).contains(&cx) && (0.0..CELLS as f32).contains(&cy);
                    if inside {
                        let weight = (1.0 - (bx - cx).abs()) * (1.0 - (by - cy).abs()) * gaussian;
                        *slot = (cy as usize * CELLS + cx as usize, weight);
                    }
                }
                shares.push(share);
            }
        }
        Self { shares }
    }
}

fn descriptor(layer: &Grey, blob: &Blob, angle: f32, weights: &CellWeights) -> Descriptor {
    let spacing = CELL_SIGMAS * blob.sigma / 4.0;
    let (sine, cosine) = angle.sin_cos();
    const SIDE: usize = GRID + 2;
    let mut patch = [0.0_f32; SIDE * SIDE];
    for (i, out) in patch.iter_mut().enumerate() {
        let u = ((i % SIDE) as f32 - 0.5 * (SIDE - 1) as f32) * spacing;
        let v = ((i / SIDE) as f32 - 0.5 * (SIDE - 1) as f32) * spacing;
        *out = layer.sample(
            blob.x + cosine * u - sine * v,
            blob.y + sine * u + cosine * v,
        );
    }
    let mut histogram = [0.0_f32; DESCRIPTOR_BYTES];
    for row in 0..GRID {
        for column in 0..GRID {
            let at = (row + 1) * SIDE + column + 1;
            let (dx, dy) = (
                patch[at + 1] - patch[at - 1],
                patch[at + SIDE] - patch[at - SIDE],
            );
            let magnitude = (dx * dx + dy * dy).sqrt();
            let turn = turns(dy, dx) * DIRECTIONS as f32;
            let (bin, part) = (turn as usize, turn - turn.floor());
            let (bin, next) = (bin % DIRECTIONS, (bin + 1) % DIRECTIONS);
            for &(cell, weight) in &weights.shares[row * GRID + column] {
                let amount = weight * magnitude;
                histogram[cell * DIRECTIONS + bin] += amount * (1.0 - part);
                histogram[cell * DIRECTIONS + next] += amount * part;
            }
        }
    }
    root_bytes(&mut histogram)
}

/// Clips what one strong edge may contribute, then takes square roots so that the dot product is Hellinger's.
fn root_bytes(histogram: &mut [f32; DESCRIPTOR_BYTES]) -> Descriptor {
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
    // A root of a share is below 1; 512 spreads the usual 0 to 0.4 over a byte.
    std::array::from_fn(|i| (512.0 * (histogram[i] / sum).sqrt()).min(255.0) as u8)
}

#[cfg(test)]
mod tests {
    use glam::DVec2;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::geometry::matching::{Wide, matches};

    /// Soft spots on grey: (x, y, sigma, height) each, coordinates with pixel centres at +0.5.
    fn spots(width: usize, height: usize, spots: &[(f32, f32, f32, f32)]) -> Grey {
        let value = |x: f32, y: f32| {
            let one = |s: &(f32, f32, f32, f32)| {
                s.3 * (-((x - s.0).powi(2) + (y - s.1).powi(2)) / (2.0 * s.2 * s.2)).exp()
            };
            0.5 + spots.iter().map(one).sum::<f32>()
        };
        let pixels = (0..width * height)
            .map(|i| value((i % width) as f32 + 0.5, (i / width) as f32 + 0.5))
            .collect();
        Grey {
            width,
            height,
            pixels,
        }
    }

    #[test]
    fn a_spot_is_found_where_it_is_at_every_size() {
        for (sigma, at) in [
            (1.5, (40.3, 33.8)),
            (3.0, (41.7, 30.2)),
            (6.0, (40.0, 32.5)),
        ] {
            let found = features(&spots(90, 70, &[(at.0, at.1, sigma, 0.4)]), 10);
            let truth = DVec2::new(f64::from(at.0), f64::from(at.1));
            let off = found
                .pixels
                .first()
                .map_or(f64::INFINITY, |p| p.distance(truth));
            assert!(
                off < 0.1,
                "sigma {sigma}: {off} px off, {:?}",
                found.pixels.first()
            );
        }
    }

    #[test]
    fn a_picture_turned_by_a_quarter_matches_itself() {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(4);
        let mut spot = || {
            let (x, y) = (rng.random_range(10.0..190.0), rng.random_range(10.0..150.0));
            (
                x,
                y,
                rng.random_range(1.5..5.0),
                rng.random_range(-0.3..0.3),
            )
        };
        let list: Vec<_> = (0..150).map(|_| spot()).collect();
        let upright = spots(200, 160, &list);
        let turned_list: Vec<_> = list.iter().map(|s| (160.0 - s.1, s.0, s.2, s.3)).collect();
        let turned = spots(160, 200, &turned_list);
        let (a, b) = (features(&upright, 300), features(&turned, 300));
        let found = matches(&Wide::new(&a.descriptors), &Wide::new(&b.descriptors));
        let is_right = |&&(i, j): &&(u32, u32)| {
            let p = a.pixels[i as usize];
            b.pixels[j as usize].distance(DVec2::new(160.0 - p.y, p.x)) < 0.5
        };
        let n_right = found.iter().filter(is_right).count();
        assert!(
            n_right > 60 && 10 * n_right >= 9 * found.len(),
            "{n_right} of {} are right",
            found.len()
        );
    }
}
