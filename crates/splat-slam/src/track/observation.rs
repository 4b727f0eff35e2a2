//! A frame -> what tracking keeps of it: corners with their bits, and a thumbnail to look it up by.

use glam::DVec2;

use crate::track::params::TrackParams;
use crate::working_camera::WorkingCamera;
use splat_geometry::features::descriptor::{Descriptors, working_image};
use splat_geometry::features::orb;
use splat_geometry::features::scale_space::Grey;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::time::Stamp;

/// Size of a thumbnail.
const THUMBNAIL: (usize, usize) = (32, 24);
pub(crate) const THUMBNAIL_LEN: usize = THUMBNAIL.0 * THUMBNAIL.1;
/// Below this standard deviation, of 1 = black to white, a thumbnail is blank and like no other.
const MIN_CONTRAST: f32 = 0.01;
/// Sigma of a corner of the finest level, as `features::orb` states it.
const FINEST_SIGMA: f32 = 2.0;
/// Side of the cells in which corners are looked up.
const CELL_PX: f64 = 16.0;

/// Of one frame, about 35 KiB with 600 corners.
#[derive(Debug)]
pub(crate) struct Observation {
    pub(crate) seq: u64,
    pub(crate) stamp: Stamp,
    /// As the source states them, for an image of `frame_px`.
    pub(crate) intrinsics: Option<Intrinsics>,
    pub(crate) frame_px: (u32, u32),
    /// Size of the image that the corners were found on.
    pub(crate) working_px: (u32, u32),
    /// In pixels of the working image, as the lens shows them.
    pub(crate) pixels: Vec<DVec2>,
    /// Levels are 1.2 apart; 1 for the finest.
    pub(crate) levels: Vec<f32>,
    pub(crate) bits: Vec<[u64; 4]>,
    pub(crate) thumbnail: Vec<f32>,
}

/// Corners where the pinhole would show them, by cells.
#[derive(Debug)]
pub(crate) struct UndistortedObservation {
    pub(crate) camera: WorkingCamera,
    /// In the order of `Observation::pixels`; not a number where the lens says nothing.
    pub(crate) pixels: Vec<DVec2>,
    columns: usize,
    rows: usize,
    cells: Vec<Vec<u32>>,
}

impl Observation {
    pub(crate) fn of(frame: &Frame, params: &TrackParams) -> Self {
        let image = working_image(&frame.image, params.max_side);
        let found = orb::features(&image, params.max_features);
        let bits = match found.descriptors {
            Descriptors::Orb(bits) => bits,
            Descriptors::Sift(_) | Descriptors::Xfeat(_) => Vec::new(),
        };
        let level = |sigma: &f32| (sigma / FINEST_SIGMA).max(1.0);
        Self {
            seq: frame.seq,
            stamp: frame.stamp,
            intrinsics: frame.intrinsics,
            frame_px: (frame.image.width_px, frame.image.height_px),
            working_px: (image.width as u32, image.height as u32),
            levels: found.sigmas.iter().map(level).collect(),
            pixels: found.pixels,
            bits,
            thumbnail: thumbnail(&image),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.bits.len()
    }

    /// Cosine of two thumbnails; 0 where one is blank.
    pub(crate) fn likeness(&self, other: &Self) -> f32 {
        let pairs = self.thumbnail.iter().zip(&other.thumbnail);
        pairs.map(|(a, b)| a * b).sum()
    }
}

impl UndistortedObservation {
    pub(crate) fn of(seen: &Observation, camera: WorkingCamera) -> Self {
        let pixels: Vec<DVec2> = seen.pixels.iter().map(|p| camera.undistorted(*p)).collect();
        let n_cells = |side: u32| (f64::from(side) / CELL_PX).ceil().max(1.0) as usize;
        let columns = n_cells(camera.pinhole.width_px);
        let rows = n_cells(camera.pinhole.height_px);
        let mut undistorted = Self {
            camera,
            pixels,
            columns,
            rows,
            cells: vec![Vec::new(); columns * rows],
        };
        for i in 0..undistorted.pixels.len() {
            let at = undistorted.pixels[i];
            let size = (camera.pinhole.width_px, camera.pinhole.height_px);
            let is_inside =
                at.cmpge(DVec2::ZERO).all() && at.x < f64::from(size.0) && at.y < f64::from(size.1);
            if is_inside {
                let cell = (at / CELL_PX).as_uvec2();
                undistorted.cells[cell.y as usize * columns + cell.x as usize].push(i as u32);
            }
        }
        undistorted
    }

    /// Numbers of the corners that may lie within `radius` of a pixel, in a fixed order.
    pub(crate) fn near(&self, pixel: DVec2, radius: f64) -> impl Iterator<Item = usize> {
        let span = |at: f64, n: usize| {
            let first = ((at - radius) / CELL_PX).max(0.0) as usize;
            let last = ((at + radius) / CELL_PX).max(0.0) as usize;
            first.min(n)..(last + 1).min(n)
        };
        let columns = span(pixel.x, self.columns);
        let cells = span(pixel.y, self.rows)
            .flat_map(move |row| columns.clone().map(move |column| (row, column)));
        cells
            .flat_map(|(row, column)| &self.cells[row * self.columns + column])
            .map(|i| *i as usize)
            .filter(move |i| self.pixels[*i].distance_squared(pixel) <= radius * radius)
    }
}

/// Means of blocks, less their mean, of length 1; nothing for a blank image.
fn thumbnail(image: &Grey) -> Vec<f32> {
    let (columns, rows) = THUMBNAIL;
    if image.width < columns || image.height < rows || !image.is_whole() {
        return Vec::new();
    }
    let span = |i: usize, n: usize, side: usize| i * side / n..(i + 1) * side / n;
    let mut out = Vec::with_capacity(columns * rows);
    for row in 0..rows {
        let ys = span(row, rows, image.height);
        for column in 0..columns {
            let xs = span(column, columns, image.width);
            let lines = ys
                .clone()
                .map(|y| &image.pixels[y * image.width..][xs.clone()]);
            let sum: f32 = lines.map(|line| line.iter().sum::<f32>()).sum();
            out.push(sum / (xs.len() * ys.len()) as f32);
        }
    }
    let n = out.len() as f32;
    let mean = out.iter().sum::<f32>() / n;
    out.iter_mut().for_each(|v| *v -= mean);
    let length = out.iter().map(|v| v * v).sum::<f32>().sqrt();
    // False for what is not a number, too.
    let has_contrast = length >= MIN_CONTRAST * n.sqrt();
    if !has_contrast {
        return Vec::new();
    }
    out.iter_mut().for_each(|v| *v /= length);
    out
}
