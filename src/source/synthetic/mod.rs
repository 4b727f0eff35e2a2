//! Made-up scenes: a camera walks through painted geometry, and every pose and depth is known exactly.
//!
//! `SynthSettings` says what to film, `take` films it frame by frame, `SyntheticSource` hands the frames to the mapper
//! and `record` writes them into a recording.

mod clutter;
mod corridor;
pub mod endless;
mod facade;
mod furniture;
mod geometry;
mod glyphs;
mod hallway;
mod joinery;
mod lens;
mod light;
mod noise;
mod odometry;
mod options;
mod ornaments;
mod pictures;
mod prints;
mod props;
pub mod record;
mod room;
mod scene;
mod street;
mod surfaces;
pub mod take;
mod textures;
mod trajectory;

use std::path::PathBuf;
use std::sync::Arc;

use crate::camera::{Intrinsics, Lens};
use crate::config::SourceParams;
use crate::frame::Frame;
use crate::pose::{Rigid, extent};

use super::rectify::Rectifier;
use super::{Source, SourceCounts, SourceError};
use take::Take;

#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    #[error("{found:?} is no synthetic scene, expected room, facade, corridor or hallway")]
    Scene { found: String },
    #[error("{found:?} is no lens, expected pinhole, radial or fisheye")]
    Lens { found: String },
    #[error(
        "unknown option {key:?} of a synthetic scene, expected one of frames, width, height, fov, lens, noise, exposure, blur, speed, seed, quality, depth, odometry"
    )]
    Option { key: String },
    #[error("option {key} of a synthetic scene = {found}, expected {expected}")]
    Value {
        key: &'static str,
        found: String,
        expected: &'static str,
    },
    #[error("cannot {what} the recording: {reason}: {}", path.display())]
    Write {
        what: &'static str,
        reason: String,
        path: PathBuf,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneKind {
    /// A furnished living room, walked round its table.
    Room,
    /// A house front seen from the street, walking sideways.
    Facade,
    /// Four corridors that close to a loop.
    Corridor,
    /// A straight hallway of bays that are all alike; no place is seen twice.
    Hallway,
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
    /// Share by which each step of the odometry is wrong (a standard deviation); `None`: there is none.
    pub odometry: Option<f64>,
}

impl SynthSettings {
    /// A clean take of one round: 120 frames of 640x480.
    pub fn of(scene: SceneKind) -> Self {
        Self {
            scene,
            n_frames: 120,
            width_px: 640,
            height_px: 480,
            fov_deg: options::FOV_DEG,
            lens: LensKind::Pinhole,
            noise: 0.0,
            exposure_drift: 0.0,
            blur: 0.0,
            speed: 1.0,
            seed: 0,
            jpeg_quality: 85,
            depth: true,
            odometry: None,
        }
    }

    /// The camera that the pictures are taken with.
    pub fn lens(&self) -> Lens {
        lens::lens(self.lens, self.width_px, self.height_px, self.fov_deg)
    }
}

/// Films on demand: each `next` renders one frame.
#[derive(Debug)]
pub struct SyntheticSource {
    take: Take,
    n_frames: u32,
    next_ix: u32,
    /// `odom_from_cam` of every frame, if there is odometry.
    odometry: Vec<Rigid>,
    /// Straightens the pictures of bent lenses.
    rectifier: Option<Rectifier>,
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
                (settings.width_px, settings.height_px) =
                    (scaled(settings.width_px), scaled(settings.height_px));
            }
            if params.max_frames > 0 {
                settings.n_frames = settings
                    .n_frames
                    .min(params.max_frames.try_into().unwrap_or(u32::MAX));
            }
            Take::new(settings)
        };
        let take = open().map_err(|error: SynthError| SourceError::Open {
            what: "the synthetic scene",
            reason: error.to_string(),
            way_out: "for example synthetic:room?frames=60&lens=radial",
            path: PathBuf::from(scene),
        })?;
        let lens = take.settings().lens();
        let is_bent = !lens.distortion.is_none();
        let rectifier = if is_bent && params.rectify {
            Rectifier::new(&lens)
        } else {
            None
        };
        let n_frames = take.settings().n_frames;
        let noise = take.settings().odometry;
        let track = noise.map_or_else(Vec::new, |noise| odometry::track(&take, noise));
        let mounted = odometry::base_from_cam();
        Ok(Self {
            odometry: track.into_iter().map(|base| base * mounted).collect(),
            take,
            n_frames,
            next_ix: 0,
            rectifier,
        })
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
        let picture = self.take.picture(ix);
        let (image, intrinsics) = match &self.rectifier {
            Some(rectifier) => (rectifier.rectify(picture), Some(rectifier.pinhole)),
            // A bent picture fits no pinhole: whoever turned rectification off gets it uncalibrated.
            None => (
                picture,
                lens.distortion.is_none().then_some(lens.intrinsics),
            ),
        };
        // Depth belongs to straight pictures; half their size is as fine as any model's.
        let halved = |i: Intrinsics| i.resized(i.width_px.div_ceil(2), i.height_px.div_ceil(2));
        Some(Frame {
            seq: u64::from(ix),
            stamp: self.take.stamp(ix),
            image: Arc::new(image),
            intrinsics,
            truth: Some(self.take.pose(ix)),
            odometry: self.odometry.get(ix as usize).copied(),
            truth_depth: intrinsics.map(|i| Arc::new(self.take.depth(ix, &halved(i)))),
            is_held_out: false,
        })
    }

    fn counts(&self) -> SourceCounts {
        SourceCounts {
            received: u64::from(self.next_ix),
            ..SourceCounts::default()
        }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(u64::from(self.n_frames - self.next_ix))
    }

    fn truth_extent(&self) -> Option<f64> {
        let centres: Vec<_> = (0..self.n_frames)
            .map(|ix| self.take.pose(ix).translation)
            .collect();
        Some(extent(&centres))
    }
}
