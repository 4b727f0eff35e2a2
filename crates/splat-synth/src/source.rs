//! A take, filmed frame by frame, as a source.

use std::path::PathBuf;
use std::sync::Arc;

use crate::imu;
use crate::odometry;
use crate::settings::{SynthError, SynthSettings};
use crate::take::Take;
use splat_image::undistort::Undistorter;
use splat_io::error::SourceError;
use splat_io::frame_source::{Source, SourceCounts};
use splat_io::pace::Pace;
use splat_io::params::SourceParams;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::inertial::ImuSpan;
use splat_types::transform::{Rigid, extent};

/// Films on demand: each `next` renders one frame. Live, one with a rate of its own hands them out at that rate.
#[derive(Debug)]
pub struct SyntheticSource {
    take: Take,
    n_frames: u32,
    next_ix: u32,
    /// `odom_from_cam` of every frame, if there is odometry.
    odometry: Vec<Rigid>,
    /// Of every frame, if there is an IMU.
    imu: Vec<ImuSpan>,
    /// Undistorts the images of distorted lenses.
    rectifier: Option<Undistorter>,
    pace: Pace,
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
        let is_distorted = !lens.distortion.is_none();
        let rectifier = if is_distorted && params.rectify {
            Undistorter::new(&lens)
        } else {
            None
        };
        let n_frames = take.settings().n_frames;
        let pace = Pace::new(take.settings().rate.map_or(0.0, |_| params.rate));
        let noise = take.settings().odometry;
        let track = noise.map_or_else(Vec::new, |noise| odometry::track(&take, noise));
        let mounted = odometry::base_from_cam();
        Ok(Self {
            imu: imu::spans(&take),
            odometry: track.into_iter().map(|base| base * mounted).collect(),
            take,
            n_frames,
            next_ix: 0,
            rectifier,
            pace,
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
        let rgb_image = self.take.image(ix);
        let (image, intrinsics) = match &self.rectifier {
            Some(rectifier) => (rectifier.rectify(rgb_image), Some(rectifier.pinhole)),
            // A distorted image fits no pinhole: whoever turned rectification off gets it uncalibrated.
            None => (
                rgb_image,
                lens.distortion.is_none().then_some(lens.intrinsics),
            ),
        };
        // Depth belongs to straight images; half their size is as fine as any model's.
        let halved = |i: Intrinsics| i.resized(i.width_px.div_ceil(2), i.height_px.div_ceil(2));
        let sensor_depth = intrinsics.map(|i| Arc::new(self.take.depth(ix, &halved(i))));
        let stamp = self.take.stamp(ix);
        self.pace.wait_for(stamp);
        Some(Frame {
            seq: u64::from(ix),
            stamp,
            image: Arc::new(image),
            intrinsics,
            truth: Some(self.take.pose(ix)),
            odometry: self.odometry.get(ix as usize).copied(),
            imu: self.imu.get(ix as usize).cloned(),
            sensor_depth,
            second: None,
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
