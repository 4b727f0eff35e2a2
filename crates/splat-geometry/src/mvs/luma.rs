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
        Self::resized(image, working_size(width, height, params))
    }

    /// Of the same image twice the size of this, as far as the image has it; without colours.
    pub(crate) fn finer(&self, image: &RgbImage) -> Self {
        let width = (2 * self.width).min(image.width_px as usize);
        let height = (2 * self.height).min(image.height_px as usize);
        let mut finer = Self::resized(image, (width, height));
        finer.colours = Vec::new();
        finer
    }

    pub(crate) fn empty() -> Self {
        Self {
            width: 0,
            height: 0,
            values: Vec::new(),
            colours: Vec::new(),
        }
    }

    /// An image whose pixels do not fit its size counts as empty.
    fn resized(image: &RgbImage, (width, height): (usize, usize)) -> Self {
        let (from_width, from_height) = (image.width_px as usize, image.height_px as usize);
        let fits = from_width
            .checked_mul(from_height)
            .and_then(|n| n.checked_mul(3))
            == Some(image.pixels.len());
        if !fits || image.pixels.is_empty() {
            return Self::empty();
        }
        let columns = shares(from_width, width);
        let rows = shares(from_height, height);
        let mut sums = vec![[0.0_f32; 3]; width];
        let (mut values, mut colours) = (Vec::new(), Vec::new());
        values.reserve_exact(width * height);
        colours.reserve_exact(width * height);
        for row in &rows {
            sums.fill([0.0; 3]);
            for (from_y, share_y) in row.cells() {
                let pixels = &image.pixels[3 * from_y * from_width..3 * (from_y + 1) * from_width];
                let (pixels, _) = pixels.as_chunks::<3>();
                for (sum, column) in sums.iter_mut().zip(&columns) {
                    for (from_x, share_x) in column.cells() {
                        for (sum, value) in sum.iter_mut().zip(pixels[from_x]) {
                            *sum += share_y * share_x * f32::from(value);
                        }
                    }
                }
            }
            for sum in &sums {
                let luma: f32 = sum.iter().zip(LUMA).map(|(c, weight)| c * weight).sum();
                values.push(luma / 255.0 - 0.5);
                colours.push(sum.map(|c| c.round() as u8));
            }
        }
        Self {
            width,
            height,
            values,
            colours,
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

fn shares(from: usize, into: usize) -> Vec<Share> {
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
        let grey = Grey::resized(&image, (8, 6));
        let finer = grey.finer(&image);
        assert_eq!((finer.width, finer.height), (16, 12));
        for (ix, value) in grey.values.iter().enumerate() {
            let (x, y) = (2 * (ix % 8), 2 * (ix / 8));
            let four = [finer.row(y), finer.row(y + 1)].map(|row| row[x] + row[x + 1]);
            assert!((value - (four[0] + four[1]) / 4.0).abs() < 1e-5, "{ix}");
        }
        let full = Grey::resized(&image, (32, 24));
        assert_eq!(full.finer(&image).values, full.values);
    }
}
