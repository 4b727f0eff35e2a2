//! A copy of the map that never changes: what publishers, files and reports see.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::splats::splats::Splats;
use crate::time::Stamp;
use crate::transform::Rigid;

/// Where metres come from, if anywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ScaleSource {
    /// Lengths are relative: the map is right up to one unknown factor.
    #[default]
    UpToScale,
    /// Poses given in metres by the recording (`--geometry ground_truth`).
    Given,
    /// Steps of the wheels, or of whatever else counts them.
    Odometry,
    /// Images of a depth camera.
    Depth,
    /// How high the camera stands over the floor.
    Height,
    /// A distance between two places of the camera that somebody measured.
    Baseline,
    /// How far the cameras of a stereo pair are apart.
    Stereo,
    /// What an IMU measured of the camera's way.
    Imu,
}

impl ScaleSource {
    const ALL: [Self; 8] = [
        Self::UpToScale,
        Self::Given,
        Self::Odometry,
        Self::Depth,
        Self::Height,
        Self::Baseline,
        Self::Stereo,
        Self::Imu,
    ];

    /// As reports have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::UpToScale => "up_to_scale",
            Self::Given => "given",
            Self::Odometry => "odometry",
            Self::Depth => "depth",
            Self::Height => "camera_height",
            Self::Baseline => "baseline",
            Self::Stereo => "stereo",
            Self::Imu => "imu",
        }
    }

    /// Number in files and messages.
    pub fn code(self) -> u8 {
        match self {
            Self::UpToScale => 0,
            Self::Given => 1,
            Self::Odometry => 2,
            Self::Depth => 3,
            Self::Height => 4,
            Self::Baseline => 5,
            Self::Stereo => 6,
            Self::Imu => 7,
        }
    }

    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|source| source.code() == code)
    }
}

/// Metres of one unit of the map.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scale {
    pub source: ScaleSource,
    /// `None` while only ratios are known.
    pub metres_per_unit: Option<f64>,
    /// Standard deviation of `metres_per_unit`, where known.
    pub std: Option<f64>,
}

impl Scale {
    pub const UP_TO_SCALE: Self = Self {
        source: ScaleSource::UpToScale,
        metres_per_unit: None,
        std: None,
    };
    pub const GIVEN: Self = Self {
        source: ScaleSource::Given,
        metres_per_unit: Some(1.0),
        std: None,
    };

    /// Standard deviation as a share of the scale; `None` where no metres are known.
    pub fn relative_std(self) -> Option<f64> {
        let metres = self.metres_per_unit?;
        Some(self.std.map_or(0.0, |std| std / metres))
    }

    /// As messages and files have it: code, metres and standard deviation, 0 where unknown.
    pub fn to_numbers(self) -> (u8, f64, f64) {
        let known = |value: Option<f64>| value.unwrap_or(0.0);
        (
            self.source.code(),
            known(self.metres_per_unit),
            known(self.std),
        )
    }

    /// `None` where the code is unknown or a number is none.
    pub fn of_numbers((code, metres, std): (u8, f64, f64)) -> Option<Self> {
        let source = ScaleSource::from_code(code)?;
        let known = |value: f64| (value > 0.0).then_some(value);
        let is_sound = metres.is_finite() && std.is_finite() && metres >= 0.0 && std >= 0.0;
        is_sound.then_some(Self {
            source,
            metres_per_unit: known(metres),
            std: known(std),
        })
    }
}

/// A keyframe's refined pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    pub keyframe_id: u32,
    pub stamp: Stamp,
    pub world_from_cam: Rigid,
    pub intrinsics: Intrinsics,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Random-looking but derived from seed and first stamp, so that replays agree.
    pub map_id: [u8; 16],
    /// Increases when old splats moved as a whole (a pose correction); clients drop what they have.
    pub epoch: u32,
    /// Increases with every snapshot.
    pub revision: u32,
    /// Stamp of the newest keyframe in the map.
    pub stamp: Stamp,
    pub scale: Scale,
    /// In order of keyframe id.
    pub poses: Vec<KeyframePose>,
    pub splats: Arc<Splats>,
    /// One per splat, ascending; a splat keeps its number as long as the map has it.
    pub splat_ids: Arc<Vec<u32>>,
}
