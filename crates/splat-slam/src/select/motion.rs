//! Images -> sharpness, corners, their tracks, and what of the motion depth has caused.

use glam::DVec2;

use crate::select::grey::GreyImage;
use crate::select::optical_flow::{Pyramid, optical_flow};
use splat_types::image::RgbImage;

/// Longer side of the image that motion is measured on.
const TRACK_SIDE_PX: u32 = 320;
/// Corners are the strongest of each cell of a grid, so that they cover the image.
const CELL_PX: usize = 20;
/// Smaller eigenvalue of the structure tensor summed over 5x5 pixels, on grey 0..1: sensor noise of two levels
/// on a blank wall gives 0.0023.
const MIN_CORNER_RESPONSE: f32 = 5e-3;
/// Mean absolute difference, grey 0..1, above which a track has slipped.
const MAX_TRACK_ERROR: f32 = 0.1;
/// Rounds of the robust fit of a shift, turn and zoom.
const FIT_ROUNDS: usize = 10;

/// Grey 0..1, box-filtered down to at most `TRACK_SIDE_PX`.
pub(crate) fn small_grey(image: &RgbImage) -> GreyImage {
    grey_of_side(image, TRACK_SIDE_PX)
}

/// Grey 0..1, its longer side divided by a whole number so that it is at most `max_side_px`.
pub(crate) fn grey_of_side(image: &RgbImage, max_side_px: u32) -> GreyImage {
    let longest = image.width_px.max(image.height_px);
    grey_divided(image, longest.div_ceil(max_side_px) as usize)
}

/// The same, with sides divided so that there are at most `max_px` pixels: a wide image keeps its detail.
pub(crate) fn grey_of_size(image: &RgbImage, max_px: usize) -> GreyImage {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let is_small = |factor: &usize| (width / factor) * (height / factor) <= max_px;
    grey_divided(image, (1..).find(is_small).unwrap_or(1))
}

/// Means of squares of `factor` pixels a side, at least 1.
fn grey_divided(image: &RgbImage, factor: usize) -> GreyImage {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let factor = factor.max(1);
    let (small_width, small_height) = ((width / factor).max(1), (height / factor).max(1));
    let norm = 1.0 / (255.0 * 4.0 * (factor * factor) as f32);
    let mut grey = Vec::with_capacity(small_width * small_height);
    for row in 0..small_height {
        for column in 0..small_width {
            let mut sum = 0_u32;
            for y in row * factor..((row + 1) * factor).min(height) {
                for x in column * factor..((column + 1) * factor).min(width) {
                    let p = 3 * (y * width + x);
                    // Green counts double: close to luma, and whole numbers.
                    sum += u32::from(image.pixels[p])
                        + 2 * u32::from(image.pixels[p + 1])
                        + u32::from(image.pixels[p + 2]);
                }
            }
            grey.push(sum as f32 * norm);
        }
    }
    GreyImage {
        width: small_width,
        height: small_height,
        values: grey,
    }
}

/// Variance of the Laplacian (Pech-Pacheco 2000).
pub(crate) fn sharpness(grey: &GreyImage) -> f32 {
    let (width, height) = grey.size();
    if width < 3 || height < 3 {
        return 0.0;
    }
    let at = &grey.values;
    let (mut sum, mut sum_sq) = (0.0_f64, 0.0_f64);
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let p = y * width + x;
            let laplacian =
                f64::from(at[p - 1] + at[p + 1] + at[p - width] + at[p + width] - 4.0 * at[p]);
            sum += laplacian;
            sum_sq += laplacian * laplacian;
        }
    }
    let n = ((width - 2) * (height - 2)) as f64;
    (sum_sq / n - (sum / n).powi(2)) as f32
}

/// The strongest corner of each grid cell.
pub(crate) fn corners(grey: &GreyImage) -> Vec<[f32; 2]> {
    corners_in_cells(grey, CELL_PX, MIN_CORNER_RESPONSE, |_| true)
}

/// The strongest corner of each cell of `cell_px` that is asked for, by its column and row, where the smaller eigenvalue of
/// its structure tensor is above `min_response`.
pub(crate) fn corners_in_cells(
    grey: &GreyImage,
    cell_px: usize,
    min_response: f32,
    is_asked: impl Fn([usize; 2]) -> bool,
) -> Vec<[f32; 2]> {
    let (width, height) = grey.size();
    if width < 2 * cell_px || height < 2 * cell_px {
        return Vec::new();
    }
    let response = corner_response(grey);
    let mut found = Vec::new();
    for cell_y in (0..height).step_by(cell_px) {
        for cell_x in (0..width).step_by(cell_px) {
            if !is_asked([cell_x / cell_px, cell_y / cell_px]) {
                continue;
            }
            let (ys, xs) = (
                cell_y..(cell_y + cell_px).min(height),
                cell_x..(cell_x + cell_px).min(width),
            );
            let pixels = ys.flat_map(|y| xs.clone().map(move |x| (x, y)));
            let best = pixels
                .max_by(|a, b| response[a.1 * width + a.0].total_cmp(&response[b.1 * width + b.0]));
            if let Some((x, y)) = best.filter(|(x, y)| response[y * width + x] > min_response) {
                found.push([x as f32, y as f32]);
            }
        }
    }
    found
}

/// Smaller eigenvalue of the structure tensor of Sobel derivatives summed over 5x5 pixels (Shi and Tomasi 1994), 0 on the
/// border pixels.
fn corner_response(grey: &GreyImage) -> Vec<f32> {
    let (width, height) = grey.size();
    // Derivative and smoothing share the scale that makes a slope of 1 per pixel a response of 1.
    let norm = 0.125_f32.sqrt();
    let (derivative, smoothing) = ([-norm, 0.0, norm], [norm, 2.0 * norm, norm]);
    let dx = grey.filtered(&derivative, &smoothing);
    let dy = grey.filtered(&smoothing, &derivative);
    let summed = |a: &GreyImage, b: &GreyImage| {
        let values = a.values.iter().zip(&b.values).map(|(a, b)| a * b).collect();
        let products = GreyImage { values, ..*a };
        products.filtered(&[1.0; 5], &[1.0; 5]).values
    };
    let (xx, xy, yy) = (summed(&dx, &dx), summed(&dx, &dy), summed(&dy, &dy));
    let mut response = vec![0.0; width * height];
    for y in 1..height - 1 {
        for p in y * width + 1..(y + 1) * width - 1 {
            let spread = ((xx[p] - yy[p]).powi(2) + 4.0 * xy[p] * xy[p]).sqrt();
            response[p] = ((xx[p] + yy[p] - spread) * 0.5).max(0.0);
        }
    }
    response
}

/// The levels that tracking needs.
pub(crate) fn pyramid(grey: GreyImage) -> Pyramid {
    let longest = grey.width.max(grey.height);
    // The coarsest level keeps about 40 pixels, so that motion of a tenth of the image stays within its window.
    let max_level = (longest / 40).max(1).ilog2() as usize;
    Pyramid::new(grey, max_level)
}

/// Where each point went; `None` where the track was lost.
pub(crate) fn track(from: &Pyramid, to: &Pyramid, points: &[[f32; 2]]) -> Vec<Option<[f32; 2]>> {
    optical_flow(from, to, points)
        .into_iter()
        .map(|found| found.filter(|f| f.error < MAX_TRACK_ERROR).map(|f| f.at))
        .collect()
}

/// Pixels by which the tracks deviate from the shift, turn and zoom that fits most of them: what depth causes, while
/// a camera that only turns causes little. The 80th percentile, because most of an image may lie at one depth.
pub(crate) fn parallax_flow(tracks: &[([f32; 2], [f32; 2])]) -> f64 {
    let pairs: Vec<(DVec2, DVec2)> = tracks
        .iter()
        .map(|(a, b)| (DVec2::from(a.map(f64::from)), DVec2::from(b.map(f64::from))))
        .collect();
    let mut weights = vec![1.0; pairs.len()];
    let mut residuals = vec![0.0; pairs.len()];
    // Iteratively reweighted towards the smallest sum of distances. As complex numbers: to = turn * from + shift.
    for _ in 0..FIT_ROUNDS {
        let total: f64 = weights.iter().sum();
        let mean = |pick: fn(&(DVec2, DVec2)) -> DVec2| {
            pairs
                .iter()
                .zip(&weights)
                .map(|(pair, w)| pick(pair) * *w)
                .sum::<DVec2>()
                / total
        };
        let (from_mean, to_mean) = (mean(|p| p.0), mean(|p| p.1));
        let (mut turn, mut spread) = (DVec2::ZERO, 0.0);
        for ((from, to), w) in pairs.iter().zip(&weights) {
            let (from, to) = (*from - from_mean, *to - to_mean);
            turn += DVec2::new(from.dot(to), from.perp_dot(to)) * *w;
            spread += from.length_squared() * w;
        }
        let turn = if spread > 0.0 {
            turn / spread
        } else {
            DVec2::X
        };
        for (i, (from, to)) in pairs.iter().enumerate() {
            residuals[i] = (to_mean + turn.rotate(*from - from_mean) - *to).length();
            weights[i] = 1.0 / residuals[i].max(1.0);
        }
    }
    residuals.sort_by(f64::total_cmp);
    residuals
        .get(residuals.len() * 4 / 5)
        .copied()
        .unwrap_or(0.0)
}

pub(crate) fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
