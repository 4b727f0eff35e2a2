//! Decoded image -> frame: order, size, working scale, undistortion, pace and counts, the same for every source.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::calibration::lens_for_size;
use crate::frame_source::SourceCounts;
use crate::pace::Pace;
use crate::params::SourceParams;
use splat_image::buffer_pool::Pool;
use splat_image::pixel_format::resize;
use splat_image::undistort::Undistorter;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, SecondImage};
use splat_types::image::{Filter, Resampler, RgbImage};
use splat_types::inertial::ImuSpan;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// What a source knows of an image besides its pixels.
#[derive(Debug, Default)]
pub struct Extras {
    pub truth: Option<Rigid>,
    pub odometry: Option<Rigid>,
    pub imu: Option<ImuSpan>,
    pub sensor_depth: Option<DepthMap>,
    pub second: Option<SecondImage>,
    /// This image's own lens, where the images of an input differ; their sizes may then differ, too.
    pub lens: Option<CameraModel>,
    pub is_held_out: bool,
}

/// An image that was counted and may become a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    pub seq: u64,
    pub stamp: Stamp,
}

/// How images of one size, taken through one lens, become frames.
#[derive(Debug)]
struct Working {
    lens: Option<CameraModel>,
    source_size: (u32, u32),
    size: (u32, u32),
    intrinsics: Option<Intrinsics>,
    rectifier: Option<Undistorter>,
}

#[derive(Debug)]
pub struct Intake {
    params: SourceParams,
    /// The lens of the images as they arrive; `None` while nothing usable is known.
    lens: Option<CameraModel>,
    working: Option<Working>,
    resampler: Resampler,
    pool: Pool,
    last_stamp: Option<Stamp>,
    n_frames: u64,
    counts: SourceCounts,
    warned: BTreeSet<&'static str>,
    pace: Pace,
}

impl Intake {
    pub fn new(params: &SourceParams, lens: Option<CameraModel>) -> Self {
        Self {
            params: params.clone(),
            lens,
            working: None,
            resampler: Resampler::default(),
            pool: Pool::default(),
            last_stamp: None,
            n_frames: 0,
            counts: SourceCounts::default(),
            warned: BTreeSet::new(),
            pace: Pace::new(params.rate),
        }
    }

    /// Whether `max_frames` frames have gone out.
    pub fn is_full(&self) -> bool {
        self.params.max_frames > 0 && self.n_frames >= self.params.max_frames
    }

    pub fn counts(&self) -> SourceCounts {
        self.counts.clone()
    }

    /// An image to decode into; its size and content are anything.
    pub fn spare(&mut self) -> RgbImage {
        self.pool.spare()
    }

    /// So many images were made and never came here.
    pub fn missed(&mut self, n_images: u64) {
        self.counts.dropped += n_images;
    }

    /// The frame that comes next goes without the depth image that its source has a topic for.
    pub fn without_depth(&mut self) {
        self.counts.without_depth += 1;
    }

    /// The frame that comes next goes without an image of the second camera.
    pub fn without_second(&mut self) {
        self.counts.without_second += 1;
    }

    /// The frame that comes next goes without samples of the IMU.
    pub fn without_imu(&mut self) {
        self.counts.without_imu += 1;
    }

    /// The camera stopped and will be opened again.
    pub fn interrupted(&mut self) {
        self.counts.interruptions += 1;
    }

    /// Time begins anew: the next image may have any stamp.
    pub fn begin_anew(&mut self) {
        self.last_stamp = None;
    }

    /// Counts an image and says whether it is worth decoding: its stamp must be later than the last frame's.
    pub fn arrive(&mut self, stamp: Stamp) -> Option<Arrival> {
        let seq = self.counts.received;
        self.counts.received += 1;
        if self.last_stamp.is_some_and(|last| stamp <= last) {
            self.counts.out_of_order += 1;
            let last = self.last_stamp.unwrap_or_default();
            self.warn_once(
                "order",
                &format!(
                    "frame {seq} has stamp {stamp}, not later than {last}; such frames are left out"
                ),
            );
            return None;
        }
        Some(Arrival { seq, stamp })
    }

    /// An image arrived that cannot be used.
    pub fn undecodable(&mut self, seq: u64, reason: &str) {
        self.counts.undecodable += 1;
        self.warn_once(
            "undecodable",
            &format!("frame {seq} is left out, and so are others like it: {reason}"),
        );
    }

    /// An image arrived of which not even the stamp can be read.
    pub fn unreadable(&mut self, reason: &str) {
        let seq = self.counts.received;
        self.counts.received += 1;
        self.undecodable(seq, reason);
    }

    /// The input ended early.
    pub fn fault(&mut self, reason: String) {
        tracing::warn!("{reason}");
        self.counts.fault = Some(reason);
    }

    /// Logs each kind of trouble once, not once per frame.
    pub fn warn_once(&mut self, kind: &'static str, message: &str) {
        if self.warned.insert(kind) {
            tracing::warn!("{message}");
        }
    }

    /// The frame of a decoded image; `None`, and a count, where its size is not that of the first one.
    pub fn frame(&mut self, arrival: Arrival, image: RgbImage, extras: Extras) -> Option<Frame> {
        let size = (image.width_px, image.height_px);
        let lens = extras.lens.or(self.lens);
        let has_own_lens = extras.lens.is_some();
        let is_ready = self
            .working
            .as_ref()
            .is_some_and(|w| w.lens == lens && (w.source_size == size || !has_own_lens));
        if !is_ready {
            self.working = Some(self.prepare(lens, size));
        }
        let working = self.working.take().expect("made above");
        let frame = if working.source_size == size {
            Some(self.shape(&working, arrival, image, extras))
        } else {
            let (w, h) = working.source_size;
            self.undecodable(
                arrival.seq,
                &format!("it has {}x{} px, the first one {w}x{h} px", size.0, size.1),
            );
            None
        };
        self.working = Some(working);
        frame
    }

    fn shape(
        &mut self,
        working: &Working,
        arrival: Arrival,
        rgb_image: RgbImage,
        extras: Extras,
    ) -> Frame {
        let mut small = self.scaled(rgb_image, working.size);
        let image = match &working.rectifier {
            Some(rectifier) => {
                let mut straight = self.pool.spare_of(small.pixels.len());
                rectifier.rectify_into(&mut small, &mut straight);
                self.pool.take_back(small);
                straight
            }
            None => small,
        };
        let sensor_depth = extras
            .sensor_depth
            .map(|depth| Arc::new(fit_depth(&depth, working)));
        self.last_stamp = Some(arrival.stamp);
        self.n_frames += 1;
        self.pace.wait_for(arrival.stamp);
        Frame {
            seq: arrival.seq,
            stamp: arrival.stamp,
            image: self.pool.lend(image),
            intrinsics: working.intrinsics,
            truth: extras.truth,
            odometry: extras.odometry,
            imu: extras.imu,
            sensor_depth,
            second: extras.second.map(Arc::new),
            is_held_out: extras.is_held_out,
        }
    }

    fn prepare(&mut self, lens: Option<CameraModel>, source_size: (u32, u32)) -> Working {
        let size = size_within(source_size, self.params.max_side);
        let key = lens;
        let plain = |intrinsics| Working {
            lens: key,
            source_size,
            size,
            intrinsics,
            rectifier: None,
        };
        let Some(lens) = lens else {
            return plain(None);
        };
        let lens = match lens_for_size(&lens, source_size.0, source_size.1) {
            Ok(lens) => lens.resized(size.0, size.1),
            Err(found) => {
                self.warn_once(
                    "calibration",
                    &format!("camera counts as uncalibrated: {found}"),
                );
                return plain(None);
            }
        };
        if !self.params.rectify || lens.distortion == Distortion::None {
            return plain(Some(lens.intrinsics));
        }
        let Some(rectifier) = Undistorter::new(&lens) else {
            let found = format!(
                "camera counts as uncalibrated: {:?} leaves no usable view",
                lens.distortion
            );
            self.warn_once("calibration", &found);
            return plain(None);
        };
        Working {
            lens: key,
            source_size,
            size,
            intrinsics: Some(rectifier.pinhole),
            rectifier: Some(rectifier),
        }
    }

    fn scaled(&mut self, image: RgbImage, size: (u32, u32)) -> RgbImage {
        if (image.width_px, image.height_px) == size {
            return image;
        }
        let n_bytes = 3 * size.0 as usize * size.1 as usize;
        let mut out = self.pool.spare_of(n_bytes);
        resize(&mut out, size.0, size.1);
        // A box filter would move edges by up to half a pixel at ratios that are not whole.
        self.resampler.resize(&image, &mut out, Filter::Lanczos3);
        self.pool.take_back(image);
        out
    }
}

/// The size with its longer side at most `max_side`, same aspect, never enlarged.
fn size_within((width, height): (u32, u32), max_side: u32) -> (u32, u32) {
    let longest = width.max(height);
    if longest <= max_side {
        return (width, height);
    }
    let scaled = |side: u32| {
        ((f64::from(side) * f64::from(max_side) / f64::from(longest)).round() as u32).max(1)
    };
    (scaled(width), scaled(height))
}

/// Depth in the frame's view, no larger than its image. Values are picked, not mixed: the mean of two sides of an
/// edge lies on neither. Undistortion turns no ray, so z-depth stays what it was.
fn fit_depth(depth: &DepthMap, working: &Working) -> DepthMap {
    let (width, height) = working.size;
    let (width_px, height_px) = (depth.width_px.min(width), depth.height_px.min(height));
    if working.rectifier.is_none() && (width_px, height_px) == (depth.width_px, depth.height_px) {
        return depth.clone();
    }
    let cell = |at: f64, n: u32| (at.max(0.0) as u32).min(n - 1) as usize;
    let mut values = Vec::with_capacity(width_px as usize * height_px as usize);
    for y in 0..height_px {
        for x in 0..width_px {
            // Shares of the whole image are the same at every size.
            let u = (f64::from(x) + 0.5) / f64::from(width_px);
            let v = (f64::from(y) + 0.5) / f64::from(height_px);
            let (u, v) = working.rectifier.as_ref().map_or((u, v), |rectifier| {
                let at = rectifier.source_of(
                    cell(u * f64::from(width), width) as u32,
                    cell(v * f64::from(height), height) as u32,
                );
                (at.x / f64::from(width), at.y / f64::from(height))
            });
            let column = cell(u * f64::from(depth.width_px), depth.width_px);
            let row = cell(v * f64::from(depth.height_px), depth.height_px);
            values.push(row * depth.width_px as usize + column);
        }
    }
    DepthMap {
        width_px,
        height_px,
        depth: values.iter().map(|&ix| depth.depth[ix]).collect(),
        confidence: values.iter().map(|&ix| depth.confidence[ix]).collect(),
    }
}
