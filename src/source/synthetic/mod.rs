//! Made-up scenes: a camera walks through painted geometry, and every pose and depth is known exactly.
//!
//! `SynthSettings` says what to film, `take` films it frame by frame, `SyntheticSource` hands the frames to the mapper
//! and `record` writes them into a recording.

mod corridor;
mod facade;
mod geometry;
mod glyphs;
mod lens;
mod light;
mod noise;
mod ornaments;
mod pictures;
pub mod record;
mod room;
mod scene;
mod surfaces;
pub mod take;
mod textures;
mod trajectory;

use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;

use crate::camera::{Intrinsics, Lens};
use crate::config::SourceParams;
use crate::frame::Frame;

use super::{Source, SourceCounts, SourceError};
use take::Take;

#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    #[error("{found:?} is no synthetic scene, expected room, facade or corridor")]
    Scene { found: String },
    #[error("{found:?} is no lens, expected pinhole, radial or fisheye")]
    Lens { found: String },
    #[error(
        "unknown option {key:?} of a synthetic scene, expected one of frames, width, height, fov, lens, noise, exposure, blur, speed, seed, quality, depth"
    )]
    Option { key: String },
    #[error("option {key} of a synthetic scene = {found}, expected {expected}")]
    Value { key: &'static str, found: String, expected: &'static str },
    #[error("cannot {what} the recording: {reason}: {}", path.display())]
    Write { what: &'static str, reason: String, path: PathBuf },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneKind {
    /// A furnished living room, walked round its table.
    Room,
    /// A house front seen from the street, walking sideways.
    Facade,
    /// Four corridors that close to a loop.
    Corridor,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensKind {
    Pinhole,
    /// plumb_bob with the barrel of a cheap webcam.
    Radial,
    /// equidistant.
    Fisheye,
}

/// What to film, and how badly.
#[derive(Debug, Clone, PartialEq)]
pub struct SynthSettings {
    pub scene: SceneKind,
    pub n_frames: u32,
    pub width_px: u32,
    pub height_px: u32,
    /// Horizontal field of view; of the radial lens before its distortion.
    pub fov_deg: f64,
    pub lens: LensKind,
    /// Standard deviation of the sensor noise in 8-bit levels.
    pub noise: f64,
    /// Stops up and down that the automatic exposure drifts.
    pub exposure_drift: f64,
    /// Share of the time between frames that the shutter is open.
    pub blur: f64,
    /// 1 goes round once in 120 frames.
    pub speed: f64,
    /// Sensor noise and the trembling of the hand follow from it; the scene is always the same.
    pub seed: u64,
    pub jpeg_quality: u8,
    /// Whether recordings carry a depth topic.
    pub depth: bool,
}

impl FromStr for SceneKind {
    type Err = SynthError;

    fn from_str(text: &str) -> Result<Self, SynthError> {
        match text {
            "room" => Ok(Self::Room),
            "facade" => Ok(Self::Facade),
            "corridor" => Ok(Self::Corridor),
            _ => Err(SynthError::Scene { found: text.to_owned() }),
        }
    }
}

impl FromStr for LensKind {
    type Err = SynthError;

    fn from_str(text: &str) -> Result<Self, SynthError> {
        match text {
            "pinhole" => Ok(Self::Pinhole),
            "radial" => Ok(Self::Radial),
            "fisheye" => Ok(Self::Fisheye),
            _ => Err(SynthError::Lens { found: text.to_owned() }),
        }
    }
}

/// Field of view of an ordinary webcam, and of a wide fisheye.
const FOV_DEG: f64 = 66.0;
const FISHEYE_FOV_DEG: f64 = 110.0;

impl SynthSettings {
    /// A clean take of one round: 120 frames of 640x480.
    pub fn of(scene: SceneKind) -> Self {
        Self {
            scene,
            n_frames: 120,
            width_px: 640,
            height_px: 480,
            fov_deg: FOV_DEG,
            lens: LensKind::Pinhole,
            noise: 0.0,
            exposure_drift: 0.0,
            blur: 0.0,
            speed: 1.0,
            seed: 0,
            jpeg_quality: 85,
            depth: true,
        }
    }

    /// `room`, or with options `room?frames=60&lens=fisheye`.
    pub fn parse(text: &str) -> Result<Self, SynthError> {
        let (scene, options) = text.split_once('?').unwrap_or((text, ""));
        let mut settings = Self::of(scene.parse()?);
        for option in options.split('&').filter(|option| !option.is_empty()) {
            let (key, value) = option.split_once('=').unwrap_or((option, ""));
            settings.set(key, value)?;
        }
        Ok(settings)
    }

    /// Sets one option from text, as the query of a source URI and the command line name it.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), SynthError> {
        match key {
            "frames" => self.n_frames = number("frames", value, [1.0, 100_000.0], "a whole number in [1, 100000]")? as u32,
            "width" => self.width_px = number("width", value, [16.0, 4096.0], "a whole number in [16, 4096]")? as u32,
            "height" => self.height_px = number("height", value, [16.0, 4096.0], "a whole number in [16, 4096]")? as u32,
            "fov" => self.fov_deg = number("fov", value, [20.0, 150.0], "degrees in [20, 150]")?,
            "lens" => {
                self.lens = value.parse()?;
                if self.lens == LensKind::Fisheye && self.fov_deg == FOV_DEG {
                    self.fov_deg = FISHEYE_FOV_DEG;
                }
            }
            "noise" => self.noise = number("noise", value, [0.0, 64.0], "8-bit levels in [0, 64]")?,
            "exposure" => self.exposure_drift = number("exposure", value, [0.0, 4.0], "stops in [0, 4]")?,
            "blur" => self.blur = number("blur", value, [0.0, 1.0], "a share in [0, 1]")?,
            "speed" => self.speed = number("speed", value, [0.0, 100.0], "a number in [0, 100]")?,
            "seed" => {
                let expected = "a whole number in [0, 2^64)";
                let wrong = |_| SynthError::Value { key: "seed", found: value.to_owned(), expected };
                self.seed = value.parse().map_err(wrong)?;
            }
            "quality" => self.jpeg_quality = number("quality", value, [1.0, 100.0], "a whole number in [1, 100]")? as u8,
            "depth" => {
                self.depth = match value {
                    "true" | "1" => true,
                    "false" | "0" => false,
                    _ => {
                        let found = value.to_owned();
                        return Err(SynthError::Value { key: "depth", found, expected: "true or false" });
                    }
                }
            }
            _ => return Err(SynthError::Option { key: key.to_owned() }),
        }
        Ok(())
    }

    /// The camera that the pictures are taken with.
    pub fn lens(&self) -> Lens {
        lens::lens(self.lens, self.width_px, self.height_px, self.fov_deg)
    }

    /// Only the fields of the struct can be set past `set`, so whoever films checks them here.
    pub(crate) fn check(&self) -> Result<(), SynthError> {
        let mut copy = Self::of(self.scene);
        // A wide flat picture would need a focal length of almost nothing.
        if self.lens != LensKind::Fisheye && self.fov_deg > 110.0 {
            let expected = "degrees in [20, 110] unless the lens is fisheye";
            return Err(SynthError::Value { key: "fov", found: self.fov_deg.to_string(), expected });
        }
        for (key, value) in [
            ("frames", f64::from(self.n_frames)),
            ("width", f64::from(self.width_px)),
            ("height", f64::from(self.height_px)),
            ("fov", self.fov_deg),
            ("noise", self.noise),
            ("exposure", self.exposure_drift),
            ("blur", self.blur),
            ("speed", self.speed),
            ("quality", f64::from(self.jpeg_quality)),
        ] {
            copy.set(key, &value.to_string())?;
        }
        Ok(())
    }
}

fn number(key: &'static str, text: &str, [low, high]: [f64; 2], expected: &'static str) -> Result<f64, SynthError> {
    let fits = |value: &f64| (low..=high).contains(value) && (!expected.starts_with("a whole") || value.fract() == 0.0);
    let parsed = text.parse().ok().filter(fits);
    parsed.ok_or_else(|| SynthError::Value { key, found: text.to_owned(), expected })
}

/// Films on demand: each `next` renders one frame.
#[derive(Debug)]
pub struct SyntheticSource {
    take: Take,
    n_frames: u32,
    next_ix: u32,
    rectify: bool,
}

impl SyntheticSource {
    /// `scene` is what follows `synthetic:`, for example `room?frames=60`. Its own `seed` option goes before `seed`.
    pub fn open(scene: &str, params: &SourceParams, seed: u64) -> Result<Self, SourceError> {
        let open = || {
            let mut settings = SynthSettings::parse(scene)?;
            if !scene.contains("seed=") {
                settings.seed = seed;
            }
            let longest = settings.width_px.max(settings.height_px);
            if longest > params.max_side {
                let scaled = |side: u32| (side * params.max_side).div_ceil(longest).max(16);
                (settings.width_px, settings.height_px) = (scaled(settings.width_px), scaled(settings.height_px));
            }
            if params.max_frames > 0 {
                settings.n_frames = settings.n_frames.min(params.max_frames.try_into().unwrap_or(u32::MAX));
            }
            Take::new(settings)
        };
        let take = open().map_err(|error: SynthError| SourceError::Open {
            what: "the synthetic scene",
            reason: error.to_string(),
            way_out: "for example synthetic:room?frames=60&lens=radial",
            path: PathBuf::from(scene),
        })?;
        let n_frames = take.settings().n_frames;
        Ok(Self { take, n_frames, next_ix: 0, rectify: params.rectify })
    }
}

impl Source for SyntheticSource {
    fn next(&mut self) -> Option<Frame> {
        let ix = self.next_ix;
        if ix >= self.n_frames {
            return None;
        }
        self.next_ix += 1;
        let lens = self.take.settings().lens();
        let is_straight = self.take.settings().lens == LensKind::Pinhole;
        let (image, intrinsics) = match is_straight || !self.rectify {
            true => (self.take.picture(ix), is_straight.then_some(lens.intrinsics)),
            false => (take::rectified(&self.take.picture(ix), &lens), Some(lens.intrinsics)),
        };
        // Depth belongs to straight pictures; half their size is as fine as any model's.
        let halved = |i: Intrinsics| i.resized(i.width_px.div_ceil(2), i.height_px.div_ceil(2));
        Some(Frame {
            seq: u64::from(ix),
            stamp: self.take.stamp(ix),
            image: Arc::new(image),
            intrinsics,
            truth: Some(self.take.pose(ix)),
            truth_depth: intrinsics.map(|i| Arc::new(self.take.depth(ix, &halved(i)))),
        })
    }

    fn counts(&self) -> SourceCounts {
        SourceCounts { received: u64::from(self.next_ix), ..SourceCounts::default() }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(u64::from(self.n_frames - self.next_ix))
    }
}
