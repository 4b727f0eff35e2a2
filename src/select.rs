//! Frames -> keyframes -> batches, by image motion, sharpness and time; knows no poses.
//!
//! Corners of the last keyframe are tracked from frame to frame (pyramidal Lucas-Kanade); their median motion
//! decides. A frame on which the tracks die shows something else and is a keyframe too.

use std::collections::VecDeque;
use std::sync::Arc;

use glam::DVec2;
use kornia_image::{Image, ImageSize};
use kornia_imgproc::features::gftt_response;
use kornia_imgproc::optical_flow_pyr_lk::{PyrLKParams, calc_optical_flow_pyr_lk};

use crate::clock::Stopwatch;
use crate::config::SelectParams;
use crate::frame::{Batch, Frame, Keyframe, RgbImage};

/// Longer side of the picture that motion is measured on.
const TRACK_SIDE_PX: u32 = 320;
/// Corners are the strongest of each cell of a grid, so that they cover the picture.
const CELL_PX: usize = 20;
/// Fewer tracked corners than this say nothing (blank wall, black frame).
const MIN_CORNERS: usize = 12;
/// When fewer of the corners survive, the view has changed.
const MIN_SURVIVORS: f64 = 0.35;
/// Smaller eigenvalue of the structure tensor summed over 5x5 pixels, on grey 0..1: sensor noise of two levels
/// on a blank wall gives 0.0023.
const MIN_CORNER_RESPONSE: f32 = 5e-3;
/// Mean absolute difference, grey 0..1, above which a track has slipped.
const MAX_TRACK_ERROR: f32 = 0.1;
/// Tracks are followed forth and back; where they don't return to within this they have slipped.
const MAX_RETURN_PX: f32 = 1.5;
/// Rounds of the robust fit of a shift, turn and zoom.
const FIT_ROUNDS: usize = 10;
/// Frames whose median sharpness is the measure.
const SHARPNESS_WINDOW: usize = 15;

/// Decides which frames are keyframes. Frames come in order of time.
#[derive(Debug)]
pub struct Selector {
    params: SelectParams,
    next_id: u32,
    last: Option<LastKeyframe>,
    sharpness: VecDeque<f32>,
}

struct LastKeyframe {
    stamp_secs: f64,
    n_corners: usize,
    /// (corner in the keyframe, where it is in `grey`).
    tracks: Vec<([f32; 2], [f32; 2])>,
    /// The newest frame.
    grey: Image<f32, 1>,
}

impl std::fmt::Debug for LastKeyframe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "LastKeyframe({} of {} tracks)",
            self.tracks.len(),
            self.n_corners
        )
    }
}

/// What tracking says of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Motion {
    /// Shares of the longer side: the median motion, and the motion that depth causes (`parallax_flow`).
    Measured { flow: f64, parallax: f64 },
    /// Most tracks died: the view is another one.
    Lost,
    /// Nothing to track.
    Unknown,
}

impl Selector {
    pub fn new(params: SelectParams) -> Self {
        Self {
            params,
            next_id: 0,
            last: None,
            sharpness: VecDeque::new(),
        }
    }

    /// Returns the frame as a keyframe when the map should keep it.
    pub fn push(&mut self, frame: Frame) -> Option<Keyframe> {
        if self.params.all {
            return Some(self.keep(frame));
        }
        let grey = small_grey(&frame.image);
        let sharpness = sharpness(&grey);
        let is_sharp = self.is_sharp(sharpness);
        let stamp_secs = frame.stamp.secs();
        if let Some(last) = &mut self.last {
            let motion = last.follow(grey.clone());
            let too_soon = stamp_secs - last.stamp_secs < 1.0 / self.params.max_rate_hz - 1e-6;
            let moved = match motion {
                Motion::Unknown => false,
                // A blurry frame loses its tracks too; the next sharp one finds them still lost.
                Motion::Lost => is_sharp,
                Motion::Measured { flow, parallax } => {
                    let params = &self.params;
                    let share = (flow / params.min_flow).max(parallax / params.min_parallax);
                    share >= 1.0 && (is_sharp || flow >= params.min_flow + params.max_wait)
                }
            };
            if too_soon || !moved {
                return None;
            }
        }
        self.last = Some(LastKeyframe::new(stamp_secs, grey));
        Some(self.keep(frame))
    }

    fn keep(&mut self, frame: Frame) -> Keyframe {
        let id = self.next_id;
        self.next_id += 1;
        Keyframe {
            id,
            frame,
            age: Stopwatch::start(),
        }
    }

    fn is_sharp(&mut self, sharpness: f32) -> bool {
        let mut sorted: Vec<f32> = self.sharpness.iter().copied().collect();
        sorted.sort_by(f32::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        if self.sharpness.len() == SHARPNESS_WINDOW {
            self.sharpness.pop_front();
        }
        self.sharpness.push_back(sharpness);
        f64::from(sharpness) >= self.params.min_sharpness * f64::from(median)
    }
}

impl LastKeyframe {
    fn new(stamp_secs: f64, grey: Image<f32, 1>) -> Self {
        let corners = corners(&grey);
        Self {
            stamp_secs,
            n_corners: corners.len(),
            tracks: corners.into_iter().map(|c| (c, c)).collect(),
            grey,
        }
    }

    /// Follows the corners into the next frame and says how far they are from where the keyframe had them.
    fn follow(&mut self, grey: Image<f32, 1>) -> Motion {
        if self.n_corners < MIN_CORNERS || self.grey.size() != grey.size() {
            // A blank keyframe measures no motion; the first frame with something to see takes its place.
            let sees_more = corners(&grey).len() >= 2 * MIN_CORNERS.max(self.n_corners);
            self.grey = grey;
            return if sees_more {
                Motion::Lost
            } else {
                Motion::Unknown
            };
        }
        let (width, height) = (grey.width() as f32, grey.height() as f32);
        let from: Vec<[f32; 2]> = self.tracks.iter().map(|(_, at)| *at).collect();
        let Some(to) = track(&self.grey, &grey, &from) else {
            return Motion::Unknown;
        };
        let positions: Vec<[f32; 2]> = to.iter().map(|t| t.unwrap_or([-1.0, -1.0])).collect();
        let back = track(&grey, &self.grey, &positions).unwrap_or_default();
        let returned = |i: usize| {
            back.get(i)
                .copied()
                .flatten()
                .is_some_and(|b| distance(b, from[i]) <= MAX_RETURN_PX)
        };
        let inside = |p: [f32; 2]| p[0] >= 0.0 && p[1] >= 0.0 && p[0] < width && p[1] < height;
        self.tracks = (0..from.len())
            .filter_map(|i| {
                to[i]
                    .filter(|p| inside(*p) && returned(i))
                    .map(|p| (self.tracks[i].0, p))
            })
            .collect();
        self.grey = grey;
        if (self.tracks.len() as f64) < MIN_SURVIVORS * self.n_corners as f64 {
            return Motion::Lost;
        }
        let mut motion: Vec<f32> = self
            .tracks
            .iter()
            .map(|(start, at)| distance(*start, *at))
            .collect();
        motion.sort_by(f32::total_cmp);
        let longest = f64::from(width.max(height));
        Motion::Measured {
            flow: f64::from(motion[motion.len() / 2]) / longest,
            parallax: parallax_flow(&self.tracks) / longest,
        }
    }
}

/// Groups keyframes into batches that share some with the batch before.
#[derive(Debug)]
pub struct Batcher {
    size: usize,
    overlap: usize,
    next_id: u32,
    n_shared: usize,
    keyframes: Vec<Arc<Keyframe>>,
}

impl Batcher {
    pub fn new(params: &SelectParams) -> Self {
        Self {
            size: params.batch_size,
            overlap: params.batch_overlap,
            next_id: 0,
            n_shared: 0,
            keyframes: Vec::with_capacity(params.batch_size),
        }
    }

    /// Returns a batch when this keyframe fills it.
    pub fn push(&mut self, keyframe: Keyframe) -> Option<Batch> {
        self.keyframes.push(Arc::new(keyframe));
        (self.keyframes.len() >= self.size).then(|| self.take())
    }

    /// The last, shorter batch; `None` when every keyframe has been in one.
    pub fn finish(&mut self) -> Option<Batch> {
        (self.keyframes.len() > self.n_shared).then(|| self.take())
    }

    fn take(&mut self) -> Batch {
        let shared = self.keyframes.len().saturating_sub(self.overlap);
        let rest = self.keyframes[shared..].to_vec();
        let keyframes = std::mem::replace(&mut self.keyframes, rest);
        let batch = Batch {
            id: self.next_id,
            n_shared: self.n_shared,
            keyframes,
        };
        self.next_id += 1;
        self.n_shared = self.keyframes.len();
        batch
    }
}

/// Grey 0..1, box-filtered down to at most `TRACK_SIDE_PX`.
fn small_grey(image: &RgbImage) -> Image<f32, 1> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let factor = (image.width_px.max(image.height_px))
        .div_ceil(TRACK_SIDE_PX)
        .max(1) as usize;
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
    let size = ImageSize {
        width: small_width,
        height: small_height,
    };
    Image::new(size, grey).expect("one value per pixel")
}

/// Variance of the Laplacian (Pech-Pacheco 2000).
fn sharpness(grey: &Image<f32, 1>) -> f32 {
    let (width, height) = (grey.width(), grey.height());
    if width < 3 || height < 3 {
        return 0.0;
    }
    let at = grey.as_slice();
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

/// The strongest corner of each grid cell (Shi-Tomasi).
fn corners(grey: &Image<f32, 1>) -> Vec<[f32; 2]> {
    let (width, height) = (grey.width(), grey.height());
    let Ok(mut response) = Image::from_size_val(grey.size(), 0.0_f32) else {
        return Vec::new();
    };
    if width < 2 * CELL_PX
        || height < 2 * CELL_PX
        || gftt_response(grey, &mut response, 3, 5, false).is_err()
    {
        return Vec::new();
    }
    let response = response.as_slice();
    let mut found = Vec::new();
    for cell_y in (0..height).step_by(CELL_PX) {
        for cell_x in (0..width).step_by(CELL_PX) {
            let (ys, xs) = (
                cell_y..(cell_y + CELL_PX).min(height),
                cell_x..(cell_x + CELL_PX).min(width),
            );
            let pixels = ys.flat_map(|y| xs.clone().map(move |x| (x, y)));
            let best = pixels
                .max_by(|a, b| response[a.1 * width + a.0].total_cmp(&response[b.1 * width + b.0]));
            if let Some((x, y)) =
                best.filter(|(x, y)| response[y * width + x] > MIN_CORNER_RESPONSE)
            {
                found.push([x as f32, y as f32]);
            }
        }
    }
    found
}

/// Where each point went; `None` where the track was lost.
fn track(
    from: &Image<f32, 1>,
    to: &Image<f32, 1>,
    points: &[[f32; 2]],
) -> Option<Vec<Option<[f32; 2]>>> {
    let longest = from.width().max(from.height());
    // The coarsest level keeps about 40 pixels, so that motion of a tenth of the picture stays within its window.
    let max_level = (longest / 40).max(1).ilog2() as usize;
    let params = PyrLKParams {
        max_level,
        max_iter: 15,
        ..PyrLKParams::default()
    };
    let result = calc_optical_flow_pyr_lk(from, to, points, None, &params).ok()?;
    let tracked = |i: usize| result.status[i] == 1 && result.error[i] < MAX_TRACK_ERROR;
    Some(
        (0..points.len())
            .map(|i| tracked(i).then(|| result.next_pts[i]))
            .collect(),
    )
}

/// Pixels by which the tracks deviate from the shift, turn and zoom that fits most of them: what depth causes, while
/// a camera that only turns causes little. The 80th percentile, because most of a picture may lie at one depth.
fn parallax_flow(tracks: &[([f32; 2], [f32; 2])]) -> f64 {
    let pairs: Vec<(DVec2, DVec2)> =
        tracks.iter().map(|(a, b)| (DVec2::from(a.map(f64::from)), DVec2::from(b.map(f64::from)))).collect();
    let mut weights = vec![1.0; pairs.len()];
    let mut residuals = vec![0.0; pairs.len()];
    // Iteratively reweighted towards the smallest sum of distances. As complex numbers: to = turn * from + shift.
    for _ in 0..FIT_ROUNDS {
        let total: f64 = weights.iter().sum();
        let mean = |pick: fn(&(DVec2, DVec2)) -> DVec2| {
            pairs.iter().zip(&weights).map(|(pair, w)| pick(pair) * *w).sum::<DVec2>() / total
        };
        let (from_mean, to_mean) = (mean(|p| p.0), mean(|p| p.1));
        let (mut turn, mut spread) = (DVec2::ZERO, 0.0);
        for ((from, to), w) in pairs.iter().zip(&weights) {
            let (from, to) = (*from - from_mean, *to - to_mean);
            turn += DVec2::new(from.dot(to), from.perp_dot(to)) * *w;
            spread += from.length_squared() * w;
        }
        let turn = if spread > 0.0 { turn / spread } else { DVec2::X };
        for (i, (from, to)) in pairs.iter().enumerate() {
            residuals[i] = (to_mean + turn.rotate(*from - from_mean) - *to).length();
            weights[i] = 1.0 / residuals[i].max(1.0);
        }
    }
    residuals.sort_by(f64::total_cmp);
    residuals.get(residuals.len() * 4 / 5).copied().unwrap_or(0.0)
}

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[cfg(test)]
mod tests;
