//! Options of a synthetic scene as text, and the ranges that all its settings keep to.

use std::str::FromStr;

use crate::settings::{FOV_DEG, LensKind, RATE, RATES, SceneKind, SynthError, SynthSettings};

const FISHEYE_FOV_DEG: f64 = 110.0;

impl SynthSettings {
    /// `room`, or with options `room?frames=60&lens=fisheye`.
    pub fn parse(text: &str) -> Result<Self, SynthError> {
        let (scene, options) = text.split_once('?').unwrap_or((text, ""));
        let mut settings = Self::of(scene.parse()?);
        let options = options.split('&').filter(|option| !option.is_empty());
        let mut options: Vec<(&str, &str)> = options
            .map(|option| option.split_once('=').unwrap_or((option, "")))
            .collect();
        // A lens brings its own field of view, which an option may then change, in whatever order they stand.
        options.sort_by_key(|(key, _)| *key != "lens");
        options
            .into_iter()
            .try_for_each(|(key, value)| settings.set(key, value))?;
        Ok(settings)
    }

    /// Sets one option from text, as the query of a source URI and the command line name it.
    /// `lens` also sets the field of view usual for it.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), SynthError> {
        let wrong = |key: &'static str, expected: &'static str| SynthError::Value {
            key,
            found: value.to_owned(),
            expected,
        };
        if let Some(range) = RANGES.iter().find(|range| range.key == key) {
            let number: Option<f64> = value.parse().ok().filter(|number| range.allows(*number));
            let number = number.ok_or_else(|| wrong(range.key, range.expected))?;
            match range.key {
                "frames" => self.n_frames = number as u32,
                "width" => self.width_px = number as u32,
                "height" => self.height_px = number as u32,
                "fov" => self.fov_deg = number,
                "noise" => self.noise = number,
                "exposure" => self.exposure_drift = number,
                "blur" => self.blur = number,
                "movers" => self.movers = number as u32,
                "rate" => self.rate = Some(number),
                "speed" => self.speed = number,
                "odometry" => self.odometry = Some(number),
                "imu" => self.imu = Some(number),
                "slip" => self.slip = number,
                "blackout" => self.blackout = number,
                "shake" => self.shake = number,
                _ => self.jpeg_quality = number as u8,
            }
            return Ok(());
        }
        match (key, value) {
            ("lens", _) => {
                self.lens = value.parse()?;
                // A field of view that somebody chose stays.
                if [FOV_DEG, FISHEYE_FOV_DEG].contains(&self.fov_deg) {
                    self.fov_deg = if self.lens == LensKind::Fisheye {
                        FISHEYE_FOV_DEG
                    } else {
                        FOV_DEG
                    };
                }
            }
            ("seed", _) => {
                let seed = value.parse().ok();
                self.seed = seed.ok_or_else(|| wrong("seed", "a whole number in [0, 2^64)"))?;
            }
            ("depth", "true" | "1") => self.depth = true,
            ("depth", "false" | "0") => self.depth = false,
            ("depth", _) => return Err(wrong("depth", "true or false")),
            _ => {
                return Err(SynthError::Option {
                    key: key.to_owned(),
                });
            }
        }
        Ok(())
    }

    /// The fields are public and may hold anything: whoever films asks here first.
    pub(crate) fn check(&self) -> Result<(), SynthError> {
        for range in &RANGES {
            let value = match range.key {
                "frames" => f64::from(self.n_frames),
                "width" => f64::from(self.width_px),
                "height" => f64::from(self.height_px),
                "fov" => self.fov_deg,
                "noise" => self.noise,
                "exposure" => self.exposure_drift,
                "blur" => self.blur,
                "movers" => f64::from(self.movers),
                "rate" => self.rate.unwrap_or(RATE),
                "speed" => self.speed,
                "odometry" => self.odometry.unwrap_or(0.0),
                "imu" => self.imu.unwrap_or(0.0),
                "slip" => self.slip,
                "blackout" => self.blackout,
                "shake" => self.shake,
                _ => f64::from(self.jpeg_quality),
            };
            if !range.allows(value) {
                let found = value.to_string();
                return Err(SynthError::Value {
                    key: range.key,
                    found,
                    expected: range.expected,
                });
            }
        }
        // A wider flat image would be all corner and no middle.
        if self.lens != LensKind::Fisheye && self.fov_deg > 110.0 {
            let expected = "degrees in [20, 110] unless the lens is fisheye";
            return Err(SynthError::Value {
                key: "fov",
                found: self.fov_deg.to_string(),
                expected,
            });
        }
        Ok(())
    }
}

/// What a numeric option may be.
struct Range {
    key: &'static str,
    low: f64,
    high: f64,
    whole: bool,
    expected: &'static str,
}

impl Range {
    const fn new(
        key: &'static str,
        [low, high]: [f64; 2],
        whole: bool,
        expected: &'static str,
    ) -> Self {
        Self {
            key,
            low,
            high,
            whole,
            expected,
        }
    }

    fn allows(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value) && (!self.whole || value.fract() == 0.0)
    }
}

const RANGES: [Range; 16] = [
    Range::new(
        "frames",
        [1.0, 100_000.0],
        true,
        "a whole number in [1, 100000]",
    ),
    Range::new(
        "width",
        [16.0, 4096.0],
        true,
        "a whole number in [16, 4096]",
    ),
    Range::new(
        "height",
        [16.0, 4096.0],
        true,
        "a whole number in [16, 4096]",
    ),
    Range::new("fov", [20.0, 170.0], false, "degrees in [20, 170]"),
    Range::new("noise", [0.0, 64.0], false, "8-bit levels in [0, 64]"),
    Range::new("exposure", [0.0, 4.0], false, "stops in [0, 4]"),
    Range::new("blur", [0.0, 1.0], false, "a share in [0, 1]"),
    Range::new("movers", [0.0, 100.0], true, "a whole number in [0, 100]"),
    Range::new("odometry", [0.0, 1.0], false, "a share in [0, 1]"),
    Range::new("imu", [0.0, 100.0], false, "a number in [0, 100]"),
    Range::new("slip", [-1.0, 1.0], false, "a share in [-1, 1]"),
    Range::new("blackout", [0.0, 600.0], false, "seconds in [0, 600]"),
    Range::new("shake", [0.0, 20.0], false, "a number in [0, 20]"),
    Range::new("rate", RATES, false, "frames per second in [1, 1000]"),
    Range::new("speed", [0.0, 100.0], false, "a number in [0, 100]"),
    Range::new("quality", [1.0, 100.0], true, "a whole number in [1, 100]"),
];

impl FromStr for SceneKind {
    type Err = SynthError;

    fn from_str(text: &str) -> Result<Self, SynthError> {
        match text {
            "room" => Ok(Self::Room),
            "facade" => Ok(Self::Facade),
            "corridor" => Ok(Self::Corridor),
            "hallway" => Ok(Self::Hallway),
            "house" => Ok(Self::House),
            _ => Err(SynthError::Scene {
                found: text.to_owned(),
            }),
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
            _ => Err(SynthError::Lens {
                found: text.to_owned(),
            }),
        }
    }
}
