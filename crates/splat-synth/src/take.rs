//! One run of a camera through one scene: frame number -> image, pose, depth.
//!
//! Images are four or more samples per pixel, averaged as light and then exposed, blurred by motion and made noisy
//! like those of a real camera. Poses and stamps are those of the middle of the exposure.

use std::sync::{Arc, OnceLock};

use glam::{DVec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use rayon::prelude::*;

use crate::geometry::Ray;
use crate::movers::{self, Mover};
use crate::scene::Scene;
use crate::settings::{RATE, SceneKind, SynthError, SynthSettings};
use crate::{corridor, facade, hallway, house, noise, room, trajectory};
use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Header stamps start here.
const START_SECS: i64 = 1_700_000_000;

/// Samples of a still image: a square turned so that no two share a row or column.
const STILL: [[f64; 2]; 4] = [
    [0.125, 0.625],
    [0.375, 0.125],
    [0.625, 0.875],
    [0.875, 0.375],
];
/// Width of a sample, for what texture it can show.
const SAMPLE_PX: f64 = 1.0;
/// Side of the square that the samples of a pixel are spread over: what lens and demosaicing smear. Sharper images
/// are all grain, which neither JPEG nor splats can hold.
const SPREAD_PX: f64 = 1.5;
/// Samples along a motion streak; streaks are up to some 15 px long.
const N_BLURRED: usize = 12;

#[derive(Debug, Clone)]
pub struct Take {
    settings: SynthSettings,
    scene: Arc<Scene>,
}

impl Take {
    /// Builds the scene and its light on first use (about a second); later takes share it.
    pub fn new(settings: SynthSettings) -> Result<Self, SynthError> {
        static SCENES: [OnceLock<Arc<Scene>>; 5] = [const { OnceLock::new() }; 5];
        settings.check()?;
        let (slot, build): (usize, fn() -> Scene) = match settings.scene {
            SceneKind::Room => (0, room::scene),
            SceneKind::Facade => (1, facade::scene),
            SceneKind::Corridor => (2, corridor::scene),
            SceneKind::Hallway => (3, hallway::scene),
            SceneKind::House => (4, house::scene),
        };
        let scene = SCENES[slot].get_or_init(|| Arc::new(build())).clone();
        Ok(Self { settings, scene })
    }

    pub fn settings(&self) -> &SynthSettings {
        &self.settings
    }

    pub fn stamp(&self, ix: u32) -> Stamp {
        let nanos = f64::from(ix) * 1e9 / self.rate();
        Stamp::from_nanos(START_SECS * 1_000_000_000 + nanos.round() as i64)
    }

    fn rate(&self) -> f64 {
        self.settings.rate.unwrap_or(RATE)
    }

    /// Tenths of a second until so many frames have passed.
    fn tenths(&self, n_frames: f64) -> f64 {
        n_frames * (RATE / self.rate())
    }

    /// `world_from_cam` with OpenCV axes; the world's z points up.
    pub fn pose(&self, ix: u32) -> Rigid {
        self.pose_beside(ix, 0.0)
    }

    /// Pose a share of the frame interval before or after the middle of an exposure.
    fn pose_beside(&self, ix: u32, share: f64) -> Rigid {
        self.pose_at(self.tenths(f64::from(ix) + share) * 1e8 * 1e-9)
    }

    /// Pose so many seconds after the first frame, or before it.
    pub fn pose_at(&self, secs: f64) -> Rigid {
        let secs = secs * self.settings.speed;
        let hand = noise::hash((self.settings.seed ^ (self.settings.seed >> 32)) as u32);
        trajectory::gt_from_cam(self.settings.scene, secs, (hand, self.settings.shake))
    }

    pub fn image(&self, ix: u32) -> RgbImage {
        let lens = self.settings.lens();
        let (width, height) = (
            self.settings.width_px as usize,
            self.settings.height_px as usize,
        );
        let samples = self.samples(ix);
        let (gain, is_dark) = (self.gain(ix), self.is_dark(ix));
        let (at, n) = ((self.pose(ix), ix), self.settings.movers);
        let movers = movers::movers(&self.scene, &lens, at, (n, self.settings.seed));
        let mut pixels = vec![0u8; 3 * width * height];
        pixels
            .par_chunks_mut(3 * width)
            .enumerate()
            .for_each(|(y, row)| {
                let mut random = Pcg32::seed_from_u64(
                    self.settings.seed.wrapping_mul(0x9E37_79B9_7F4A_7C15)
                        ^ (u64::from(ix) << 20)
                        ^ y as u64,
                );
                for (x, pixel) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                    let light = if is_dark {
                        Vec3::ZERO
                    } else {
                        self.pixel_light(&lens, &samples, &movers, [x, y])
                    };
                    *pixel = expose(light * gain, self.settings.noise as f32, &mut random);
                }
            });
        RgbImage {
            width_px: self.settings.width_px,
            height_px: self.settings.height_px,
            pixels,
        }
    }

    /// Exact z-depth of the pixel centres of an undistorted camera, of what does not move; 0 where nothing is.
    pub fn depth(&self, ix: u32, intrinsics: &Intrinsics) -> DepthMap {
        let lens = CameraModel {
            intrinsics: *intrinsics,
            distortion: splat_types::camera::Distortion::None,
        };
        self.depth_through(ix, &lens)
    }

    /// The same for the pixels of a distorted image.
    pub(crate) fn depth_through(&self, ix: u32, lens: &CameraModel) -> DepthMap {
        let pose = self.pose(ix);
        let (width_px, height_px) = (lens.intrinsics.width_px, lens.intrinsics.height_px);
        let mut depth = vec![0f32; width_px as usize * height_px as usize];
        depth
            .par_chunks_mut(width_px.max(1) as usize)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, value) in row.iter_mut().enumerate() {
                    let Some(in_cam) = lens.ray_in_cam(DVec2::new(x as f64 + 0.5, y as f64 + 0.5))
                    else {
                        continue;
                    };
                    let direction = pose.rotation * in_cam;
                    let ray = Ray {
                        origin: pose.translation,
                        direction,
                    };
                    // The ray's third coordinate in the camera is 1, so its length counts depth.
                    *value = self
                        .scene
                        .meet(&ray, f64::MAX)
                        .map_or(0.0, |hit| hit.distance as f32);
                }
            });
        let confidence = depth
            .iter()
            .map(|d| f32::from(u8::from(*d > 0.0)))
            .collect();
        DepthMap {
            width_px,
            height_px,
            depth,
            confidence,
        }
    }

    /// Place within the pixel and camera of every sample.
    fn samples(&self, ix: u32) -> Vec<(DVec2, Rigid)> {
        if self.settings.blur <= 0.0 {
            let pose = self.pose(ix);
            return STILL
                .iter()
                .map(|place| (DVec2::from_array(*place), pose))
                .collect();
        }
        (0..N_BLURRED)
            .map(|n| {
                // Multiples of the plastic number's inverses fill the square evenly for any count.
                let n = n as f64 + 0.5;
                let place = DVec2::new((n * 0.754_877_666).fract(), (n * 0.569_840_291).fract());
                let open = (n / N_BLURRED as f64 - 0.5) * self.settings.blur;
                (place, self.pose_beside(ix, open))
            })
            .collect()
    }

    fn pixel_light(
        &self,
        lens: &CameraModel,
        samples: &[(DVec2, Rigid)],
        movers: &[Mover],
        [x, y]: [usize; 2],
    ) -> Vec3 {
        let pixel_angle = SAMPLE_PX / lens.intrinsics.fx;
        let corner = DVec2::new(x as f64, y as f64);
        let mut sum = Vec3::ZERO;
        for (place, pose) in samples {
            // Beyond the rim of a fisheye it is dark.
            let Some(in_cam) = lens.ray_in_cam(corner + 0.5 + (*place - 0.5) * SPREAD_PX) else {
                continue;
            };
            let direction = pose.rotation * in_cam.normalize();
            let ray = Ray {
                origin: pose.translation,
                direction,
            };
            let mover = movers::meet(movers, &ray);
            if let Some((_, light)) = mover.filter(|m| self.scene.meet(&ray, m.0).is_none()) {
                sum += light;
                continue;
            }
            // Sensors clip each sample's highlights before the eye would: bright lamps keep soft rims.
            sum += self.scene.radiance(&ray, pixel_angle).min(Vec3::splat(4.0));
        }
        sum / samples.len() as f32
    }

    /// Whether the camera sees nothing.
    fn is_dark(&self, ix: u32) -> bool {
        let middle = 0.5 * f64::from(self.settings.n_frames);
        let off = (f64::from(ix) - middle) / self.rate();
        2.0 * off.abs() < self.settings.blackout
    }

    /// Slow wave of the automatic exposure; one period in about eight seconds.
    fn gain(&self, ix: u32) -> f32 {
        let wave = (std::f64::consts::TAU * (self.tenths(f64::from(ix)) / 83.0 + 0.13)).sin();
        (self.settings.exposure_drift * wave).exp2() as f32
    }
}

/// Light -> 8-bit sRGB with a soft shoulder, plus noise of `noise` levels.
fn expose(light: Vec3, noise: f32, random: &mut Pcg32) -> [u8; 3] {
    /// Above it values bend over instead of clipping.
    const SHOULDER: f32 = 0.65;
    light.to_array().map(|value| {
        let room = 1.0 - SHOULDER;
        let distorted = if value < SHOULDER {
            value
        } else {
            SHOULDER + room * (1.0 - (-(value - SHOULDER) / room).exp())
        };
        let srgb = if distorted <= 0.003_130_8 {
            12.92 * distorted
        } else {
            1.055 * distorted.powf(1.0 / 2.4) - 0.055
        };
        let shift = if noise > 0.0 {
            noise * gaussian(random)
        } else {
            0.0
        };
        (255.0 * srgb + shift).round().clamp(0.0, 255.0) as u8
    })
}

/// Standard normal by Box and Muller.
pub(crate) fn gaussian(random: &mut Pcg32) -> f32 {
    let radius = (-2.0 * (1.0 - random.random::<f32>()).ln()).sqrt();
    radius * (std::f32::consts::TAU * random.random::<f32>()).cos()
}
