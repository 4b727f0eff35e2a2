//! A colour image -> luma and colours at the size of the depth map, by area averaging.

use crate::mvs::params::MvsParams;
use splat_types::image::RgbImage;

/// Luma from -0.5 to 0.5: centred, so that sums of squares keep their digits.
#[derive(Debug, Clone)]
pub(crate) struct Grey {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) values: Vec<f32>,
    pub(crate) colours: Vec<[u8; 3]>,
}

/// Cells of the cost volume, 7 bytes each, that one sweep may take: larger settings get a smaller image.
const MAX_CELLS: usize = 1 << 27;

/// Rec. 601 luma.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

impl Grey {
    /// At the size of the depth map.
    pub(crate) fn of_image(image: &RgbImage, params: &MvsParams) -> Self {
        let (width, height) = (image.width_px as usize, image.height_px as usize);
        let mut colours = Vec::new();
        let grey = Self::resized(
            image,
            working_size(width, height, params),
            Some(&mut colours),
        );
        Self { colours, ..grey }
    }

    /// Of the same image twice the size of this, as far as the image has it; without colours.
    pub(crate) fn finer(&self, image: &RgbImage) -> Self {
        let width = (2 * self.width).min(image.width_px as usize);
        let height = (2 * self.height).min(image.height_px as usize);
        Self::resized(image, (width, height), None)
    }

    pub(crate) fn empty() -> Self {
        Self {
            width: 0,
            height: 0,
            values: Vec::new(),
            colours: Vec::new(),
        }
    }

    /// An image whose pixels do not fit its size counts as empty. The colours go where they are asked for.
    fn resized(
        image: &RgbImage,
        (width, height): (usize, usize),
        mut colours: Option<&mut Vec<[u8; 3]>>,
    ) -> Self {
        let (from_width, from_height) = (image.width_px as usize, image.height_px as usize);
        let fits = from_width
            .checked_mul(from_height)
            .and_then(|n| n.checked_mul(3))
            == Some(image.pixels.len());
        if !fits || image.pixels.is_empty() {
            return Self::empty();
        }
        let pixels = image.pixels.as_chunks::<3>().0;
        let is_whole = |factor| (from_width, from_height) == (factor * width, factor * height);
        let shares = [from_width, from_height].into_iter().zip([width, height]);
        let shares: Vec<Vec<Share>> = shares.map(|(from, into)| shares_of(from, into)).collect();
        let mut sums = vec![[0.0_f32; 3]; width];
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            if is_whole(1) {
                means_of_squares::<1>(pixels, from_width, y, &mut sums);
            } else if is_whole(2) {
                means_of_squares::<2>(pixels, from_width, y, &mut sums);
            } else {
                means_of_shares(pixels, from_width, (&shares[0], &shares[1][y]), &mut sums);
            }
            for sum in &sums {
                let luma: f32 = sum.iter().zip(LUMA).map(|(c, weight)| c * weight).sum();
                values.push(luma / 255.0 - 0.5);
            }
            if let Some(colours) = &mut colours {
                colours.extend(sums.iter().map(|sum| sum.map(|c| c.round() as u8)));
            }
        }
        Self {
            width,
            height,
            values,
            colours: Vec::new(),
        }
    }

    pub(crate) fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }
}

/// Never larger than the image, longer side at most `params.max_side`.
fn working_size(width: usize, height: usize, params: &MvsParams) -> (usize, usize) {
    let (w, h) = (width as f64, height as f64);
    let by_side = f64::from(params.max_side) / w.max(h);
    let by_memory = (MAX_CELLS as f64 / (w * h * params.depth_planes.max(1) as f64)).sqrt();
    let scale = by_side.min(by_memory).min(1.0);
    (
        (w * scale).round().max(1.0) as usize,
        (h * scale).round().max(1.0) as usize,
    )
}

/// The stretch of old pixels under one new pixel.
struct Share {
    from: f64,
    to: f64,
}

impl Share {
    /// Old pixel and its share; the shares add up to 1.
    fn cells(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        let last = (self.to.ceil() as usize).max(self.from as usize + 1);
        (self.from as usize..last).map(|ix| {
            let overlap = self.to.min(ix as f64 + 1.0) - self.from.max(ix as f64);
            (ix, (overlap / (self.to - self.from)) as f32)
        })
    }
}

/// A row of means of `SIDE` by `SIDE` pixels, 1 or 2, which are the shares that any size has, without their cost: sums of so few
/// bytes, and their quarters, are exact.
fn means_of_squares<const SIDE: usize>(
    pixels: &[[u8; 3]],
    from_width: usize,
    y: usize,
    means: &mut [[f32; 3]],
) {
    let rows: [&[[u8; 3]]; SIDE] =
        std::array::from_fn(|dy| &pixels[(SIDE * y + dy) * from_width..][..from_width]);
    for (x, mean) in means.iter_mut().enumerate() {
        let mut sum = [0_u16; 3];
        for row in rows {
            for pixel in &row[SIDE * x..SIDE * (x + 1)] {
                for (sum, value) in sum.iter_mut().zip(pixel) {
                    *sum += u16::from(*value);
                }
            }
        }
        *mean = sum.map(|sum| f32::from(sum) / (SIDE * SIDE) as f32);
    }
}

/// A row of means over parts of pixels.
fn means_of_shares(
    pixels: &[[u8; 3]],
    from_width: usize,
    (columns, row): (&[Share], &Share),
    means: &mut [[f32; 3]],
) {
    means.fill([0.0; 3]);
    for (from_y, share_y) in row.cells() {
        let pixels = &pixels[from_y * from_width..(from_y + 1) * from_width];
        for (mean, column) in means.iter_mut().zip(columns) {
            for (from_x, share_x) in column.cells() {
                for (mean, value) in mean.iter_mut().zip(pixels[from_x]) {
                    *mean += share_y * share_x * f32::from(value);
                }
            }
        }
    }
}

fn shares_of(from: usize, into: usize) -> Vec<Share> {
    let edge = |ix: usize| ix as f64 * from as f64 / into as f64;
    (0..into)
        .map(|ix| Share {
            from: edge(ix),
            to: edge(ix + 1).min(from as f64),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_finer_image_shows_the_same_at_up_to_twice_the_size() {
        let (width_px, height_px) = (32, 24);
        let pixels = (0..3 * width_px * height_px).map(|ix| (ix * 37 % 251) as u8);
        let image = RgbImage {
            width_px,
            height_px,
            pixels: pixels.collect(),
        };
        let grey = Grey::resized(&image, (8, 6), None);
        let finer = grey.finer(&image);
        assert_eq!((finer.width, finer.height), (16, 12));
        for (ix, value) in grey.values.iter().enumerate() {
            let (x, y) = (2 * (ix % 8), 2 * (ix / 8));
            let four = [finer.row(y), finer.row(y + 1)].map(|row| row[x] + row[x + 1]);
            assert!((value - (four[0] + four[1]) / 4.0).abs() < 1e-5, "{ix}");
        }
        let full = Grey::resized(&image, (32, 24), None);
        assert_eq!(full.finer(&image).values, full.values);
    }

    #[test]
    fn whole_pixels_are_averaged_as_parts_of_pixels_are() {
        let pixels: Vec<[u8; 3]> = (0..32 * 24)
            .map(|ix: usize| [ix * 37, ix * 91, ix * 53].map(|v| (v % 256) as u8))
            .collect();
        for side in [1, 2] {
            let (width, height) = (32 / side, 24 / side);
            let columns = shares_of(32, width);
            for (y, row) in shares_of(24, height).iter().enumerate() {
                let (mut whole, mut parts) = (vec![[0.0; 3]; width], vec![[0.0; 3]; width]);
                match side {
                    1 => means_of_squares::<1>(&pixels, 32, y, &mut whole),
                    _ => means_of_squares::<2>(&pixels, 32, y, &mut whole),
                }
                means_of_shares(&pixels, 32, (&columns, row), &mut parts);
                assert_eq!(whole, parts, "row {y} of squares of {side}");
            }
        }
    }
}
