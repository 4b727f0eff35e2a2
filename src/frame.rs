//! Pictures with a time: frames, the keyframes kept of them, and batches of keyframes.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::clock::{Stamp, Stopwatch};
use crate::pose::Rigid;

/// 8-bit sRGB, rows top to bottom, `pixels.len() == 3 * width_px * height_px`.
#[derive(Clone, PartialEq, Eq)]
pub struct RgbImage {
    pub width_px: u32,
    pub height_px: u32,
    pub pixels: Vec<u8>,
}

impl std::fmt::Debug for RgbImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "RgbImage({}x{})", self.width_px, self.height_px)
    }
}

impl RgbImage {
    /// The size of a picture whose pixels are elsewhere.
    pub fn hollow(width_px: u32, height_px: u32) -> Self {
        Self {
            width_px,
            height_px,
            pixels: Vec::new(),
        }
    }

    /// Whether its pixels are elsewhere.
    pub fn is_hollow(&self) -> bool {
        self.pixels.is_empty()
    }

    /// Scaled down so that the longer side is at most `max_side_px`; a smaller picture is copied.
    pub fn shrunk(&self, max_side_px: u32) -> Self {
        let longest = self.width_px.max(self.height_px);
        if longest <= max_side_px {
            return self.clone();
        }
        let scaled = |side: u32| {
            let side = f64::from(side) * f64::from(max_side_px) / f64::from(longest);
            (side.round() as u32).max(1)
        };
        self.resized(scaled(self.width_px), scaled(self.height_px))
    }

    /// Low-passed to another size, which may change the aspect. Not `FilterType::Box`: at fractional scales it moves
    /// edges by a sixth of a pixel, Hamming by a fiftieth.
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        self.filtered(width_px, height_px, fast_image_resize::FilterType::Hamming)
    }

    /// The same by a cubic filter (a = -0.5), as networks have seen their pictures: sharper, and it overshoots at edges.
    pub fn resized_cubic(&self, width_px: u32, height_px: u32) -> Self {
        self.filtered(
            width_px,
            height_px,
            fast_image_resize::FilterType::CatmullRom,
        )
    }

    fn filtered(
        &self,
        width_px: u32,
        height_px: u32,
        filter: fast_image_resize::FilterType,
    ) -> Self {
        use fast_image_resize::{PixelType, ResizeAlg, ResizeOptions, Resizer, images};
        let source =
            images::ImageRef::new(self.width_px, self.height_px, &self.pixels, PixelType::U8x3)
                .expect("three bytes per pixel");
        let mut target = images::Image::new(width_px, height_px, PixelType::U8x3);
        let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
        Resizer::new()
            .resize(&source, &mut target, &options)
            .expect("both pictures are U8x3");
        Self {
            width_px,
            height_px,
            pixels: target.into_vec(),
        }
    }
}

/// z-depth along the camera axis, in the length unit of whoever made it; 0 = no value.
/// `confidence` is 0 (unverified: never use) to 1, one per pixel; only its order means anything between models.
#[derive(Clone, PartialEq)]
pub struct DepthMap {
    pub width_px: u32,
    pub height_px: u32,
    pub depth: Vec<f32>,
    pub confidence: Vec<f32>,
}

impl DepthMap {
    /// No pixels at all.
    pub fn none() -> Self {
        Self {
            width_px: 0,
            height_px: 0,
            depth: Vec::new(),
            confidence: Vec::new(),
        }
    }

    /// The same in another unit, `factor` of which make one of the old.
    pub fn scale(&mut self, factor: f64) {
        for value in &mut self.depth {
            *value = (f64::from(*value) * factor) as f32;
        }
    }

    /// So many pixels of it, each from the middle of what it stands for.
    pub fn thinned(&self, width_px: u32, height_px: u32) -> Self {
        let (from, to) = ([self.width_px, self.height_px], [width_px, height_px]);
        let middle = |ix: u32, side: usize| {
            let doubled = u64::from(2 * ix + 1) * u64::from(from[side]);
            (doubled / u64::from(2 * to[side])) as usize
        };
        let places: Vec<usize> = (0..height_px)
            .flat_map(|y| (0..width_px).map(move |x| (x, y)))
            .map(|(x, y)| middle(y, 1) * from[0] as usize + middle(x, 0))
            .collect();
        let picked = |values: &[f32]| {
            let value = |&at: &usize| values.get(at).copied().unwrap_or(0.0);
            places.iter().map(value).collect()
        };
        Self {
            width_px,
            height_px,
            depth: picked(&self.depth),
            confidence: picked(&self.confidence),
        }
    }

    /// Depth and confidence of pixel `at`; `None` where no depth was verified.
    pub fn verified(&self, at: usize) -> Option<(f32, f32)> {
        let (depth, confidence) = (*self.depth.get(at)?, *self.confidence.get(at)?);
        let is_verified =
            depth > 0.0 && depth.is_finite() && confidence > 0.0 && confidence.is_finite();
        is_verified.then_some((depth, confidence))
    }

    /// Median of the verified depths; `None` where there are none.
    pub fn median(&self) -> Option<f32> {
        let usable = self
            .depth
            .iter()
            .zip(&self.confidence)
            .filter(|(d, c)| **c > 0.0 && **d > 0.0 && d.is_finite());
        let mut values: Vec<f32> = usable.map(|(d, _)| *d).collect();
        if values.is_empty() {
            return None;
        }
        let middle = values.len() / 2;
        Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

impl std::fmt::Debug for DepthMap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "DepthMap({}x{})", self.width_px, self.height_px)
    }
}

/// One picture from the world, already undistorted to the pinhole `intrinsics` when the calibration is known.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Counts from 0 in the order of arrival; gaps mean dropped or undecodable frames.
    pub seq: u64,
    pub stamp: Stamp,
    pub image: Arc<RgbImage>,
    /// `None`: the camera is uncalibrated and geometry must estimate the focal length.
    pub intrinsics: Option<Intrinsics>,
    /// Ground truth where the source has it (`world_from_cam`, OpenCV axes). Only `geometry::known` and `eval` may look.
    pub truth: Option<Rigid>,
    /// `odom_from_cam` in metres, where the source has odometry: its steps are right, its places drift.
    pub odometry: Option<Rigid>,
    /// Depth in metres by something that measures it (exact in synthetic scenes), at image size or smaller.
    pub truth_depth: Option<Arc<DepthMap>>,
    /// The source keeps it for measuring quality: it gets a place in the map, but no optimiser step learns from it.
    pub is_held_out: bool,
}

/// A frame that the map keeps. Ids count from 0 without gaps, in order of time.
#[derive(Debug, Clone)]
pub struct Keyframe {
    pub id: u32,
    pub frame: Frame,
    /// Runs since the frame was selected: latencies in reports.
    pub age: Stopwatch,
}

impl Keyframe {
    /// The same without what takes memory: the pixels, and measured depth.
    pub fn hollow(&self) -> Self {
        let image = &self.frame.image;
        let mut hollow = self.clone();
        hollow.frame.image = Arc::new(RgbImage::hollow(image.width_px, image.height_px));
        hollow.frame.truth_depth = None;
        hollow
    }
}

/// Keyframes for one inference; the first `n_shared` were in the batch before.
#[derive(Debug, Clone)]
pub struct Batch {
    pub id: u32,
    pub n_shared: usize,
    pub keyframes: Vec<Arc<Keyframe>>,
}
