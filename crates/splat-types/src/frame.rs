//! Images with a time: frames, the keyframes kept of them, and batches of keyframes.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use crate::camera::Intrinsics;
use crate::depth::DepthMap;
use crate::image::RgbImage;
use crate::inertial::ImuSpan;
use crate::time::{Stamp, Stopwatch};
use crate::transform::Rigid;

/// One image from the world, already undistorted to the pinhole `intrinsics` when the calibration is known.
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
    /// What an IMU measured since the frame before; of a keyframe, since the keyframe before.
    pub imu: Option<ImuSpan>,
    /// Depth in metres by something that measures it (exact in synthetic scenes), at image size or smaller.
    pub sensor_depth: Option<Arc<DepthMap>>,
    /// What the second camera of a stereo pair saw at the same time.
    pub second: Option<Arc<SecondImage>>,
    /// The source keeps it for measuring quality: it gets a place in the map, but no optimiser step learns from it.
    pub is_held_out: bool,
}

/// The image of the second camera of a stereo pair, undistorted to a pinhole. It is decoded when it is looked at for the first
/// time, since only keyframes need it.
pub struct SecondImage {
    /// In metres, from the frame's own camera to the second one.
    pub second_from_first: Rigid,
    decoded: OnceLock<Option<DecodedImage>>,
    decode: Mutex<Option<Decode>>,
}

/// An image, and the camera that would have made it.
#[derive(Debug, Clone)]
pub struct DecodedImage {
    pub image: Arc<RgbImage>,
    pub intrinsics: Intrinsics,
}

type Decode = Box<dyn FnOnce() -> Option<DecodedImage> + Send>;

impl SecondImage {
    pub fn new(
        second_from_first: Rigid,
        decode: impl FnOnce() -> Option<DecodedImage> + Send + 'static,
    ) -> Self {
        Self {
            second_from_first,
            decoded: OnceLock::new(),
            decode: Mutex::new(Some(Box::new(decode))),
        }
    }

    /// `None` where it cannot be decoded.
    pub fn decoded(&self) -> Option<&DecodedImage> {
        let decoded = self.decoded.get_or_init(|| {
            let mut pending = self.decode.lock().unwrap_or_else(PoisonError::into_inner);
            let decode = pending.take();
            drop(pending);
            decode.and_then(|decode| decode())
        });
        decoded.as_ref()
    }
}

impl std::fmt::Debug for SecondImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SecondImage({:?})", self.second_from_first)
    }
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
    /// The same without what takes memory: the pixels of one or two cameras, and measured depth.
    pub fn unloaded(&self) -> Self {
        let image = &self.frame.image;
        let mut unloaded = self.clone();
        unloaded.frame.image = Arc::new(RgbImage::unloaded(image.width_px, image.height_px));
        unloaded.frame.sensor_depth = None;
        unloaded.frame.second = None;
        unloaded
    }
}

/// Keyframes for one inference; the first `n_shared` were in the batch before.
#[derive(Debug, Clone)]
pub struct Batch {
    pub id: u32,
    pub n_shared: usize,
    pub keyframes: Vec<Arc<Keyframe>>,
}
