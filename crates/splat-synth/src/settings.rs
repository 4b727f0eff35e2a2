//! What to film, and how badly.

use std::path::PathBuf;

/// Field of view of an ordinary webcam, and of a wide fisheye.
pub(crate) const FOV_DEG: f64 = 66.0;
/// Frames per second where none are asked for.
pub(crate) const RATE: f64 = 10.0;
/// What may be asked for, of all synthetic sources. A slower one would wait longer than any paced source does.
pub(crate) const RATES: [f64; 2] = [1.0, 1000.0];

#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    #[error("{found:?} is no synthetic scene, expected room, facade, corridor, hallway or house")]
    Scene { found: String },
    #[error("{found:?} is no lens, expected pinhole, radial or fisheye")]
    Lens { found: String },
    #[error(
        "unknown option {key:?} of a synthetic scene, expected one of frames, width, height, fov, lens, noise, exposure, blur, movers, rate, speed, seed, quality, depth, odometry, imu, slip, blackout, shake"
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
    /// Two rooms and the door between them, walked in a figure of eight.
    House,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensKind {
    Pinhole,
    /// plumb_bob with the barrel of a cheap webcam.
    Radial,
    /// equidistant.
    Fisheye,
}

/// What to film, and how badly. Many fields: the options of a `synthetic:` input.
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
    /// Things that are somewhere else in each image; every tenth image has none, from the sixth on.
    pub movers: u32,
    /// Frames per second, at which the source also hands them out live; `None`: 10, as soon as they are drawn.
    pub rate: Option<f64>,
    /// 1 goes round once in 12 s, whatever the rate.
    pub speed: f64,
    /// Sensor noise and the trembling of the hand follow from it; the scene is always the same.
    pub seed: u64,
    pub jpeg_quality: u8,
    /// Whether recordings carry a depth topic.
    pub depth: bool,
    /// Share by which each step of the odometry is wrong (a standard deviation); `None`: there is none.
    pub odometry: Option<f64>,
    /// Noise of an IMU at 200 Hz, as a multiple of that of a MEMS sensor (`imu`); `None`: there is none.
    pub imu: Option<f64>,
    /// Wheels that slip for two seconds, a third of the way in: their steps are too long by that share.
    pub slip: f64,
    /// Seconds in the middle in which the camera sees nothing.
    pub blackout: f64,
    /// How much more than usual the hand trembles.
    pub shake: f64,
}

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
            movers: 0,
            rate: None,
            speed: 1.0,
            seed: 0,
            jpeg_quality: 85,
            depth: true,
            odometry: None,
            imu: None,
            slip: 0.0,
            blackout: 0.0,
            shake: 1.0,
        }
    }
}
