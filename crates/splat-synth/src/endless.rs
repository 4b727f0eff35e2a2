//! A straight corridor without end, each panel of its walls unlike the others: frames cost next to nothing, so that runs
//! of thousands of them can be tested.
//!
//! The camera walks along +x and looks half ahead at the left wall; after `turn` frames it walks back, still looking
//! there. `synthetic:endless?frames=2000&turn=1000&width=96&height=72&step=0.1&rate=30`. `step` is metres in a fifteenth of
//! a second, at any rate.

use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec2, DVec3, IVec2, Vec2, Vec3};
use rayon::prelude::*;

use crate::noise::{hash2, pick, value_noise};
use crate::paint::hue;
use crate::settings::RATES;
use splat_io::error::SourceError;
use splat_io::frame_source::{Source, SourceCounts};
use splat_io::pace::Pace;
use splat_io::params::SourceParams;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, extent};

const HALF_WIDTH: f64 = 1.2;
const HEIGHT: f64 = 2.4;
const PANEL: f64 = 0.6;
const FOV_DEG: f64 = 66.0;
/// Between the walk and where the camera looks.
const HEADING: f64 = PI / 3.0;
/// Frames per second where none are asked for.
const RATE: f64 = 15.0;

/// Films on demand; live, one with a rate of its own hands frames out at that rate.
#[derive(Debug, Clone)]
pub struct EndlessSource {
    n_frames: u64,
    /// Frames after which it walks back, and forth again.
    turn: u64,
    step: f64,
    /// Frames per second.
    rate: f64,
    lens: Intrinsics,
    next_ix: u64,
    pace: Pace,
}

impl EndlessSource {
    /// `scene` is what follows `synthetic:`.
    pub fn open(scene: &str, params: &SourceParams) -> Result<Self, SourceError> {
        let mut source = Self {
            n_frames: 2000,
            turn: u64::MAX,
            step: 0.1,
            rate: RATE,
            lens: lens(96, 72),
            next_ix: 0,
            pace: Pace::new(0.0),
        };
        let (_, options) = scene.split_once('?').unwrap_or((scene, ""));
        for option in options.split('&').filter(|option| !option.is_empty()) {
            source.set(option, params).ok_or_else(|| SourceError::Open {
                what: "the synthetic scene",
                reason: format!("option {option:?}"),
                way_out: "expected frames and turn in [1, 1000000], width and height in [16, 1024] px, step in [0.001, 1] m or rate in [1, 1000] Hz",
                path: PathBuf::from(scene),
            })?;
        }
        Ok(source)
    }

    fn set(&mut self, option: &str, params: &SourceParams) -> Option<()> {
        let (key, value) = option.split_once('=')?;
        let number: f64 = value.parse().ok()?;
        let within = |low: f64, high: f64| (low..=high).contains(&number).then_some(number);
        let k = self.lens;
        match key {
            "frames" => self.n_frames = within(1.0, 1e6)? as u64,
            "turn" => self.turn = within(1.0, 1e6)? as u64,
            "width" => self.lens = lens(within(16.0, 1024.0)? as u32, k.height_px),
            "height" => self.lens = lens(k.width_px, within(16.0, 1024.0)? as u32),
            "step" => self.step = within(0.001, 1.0)?,
            "rate" => {
                self.rate = within(RATES[0], RATES[1])?;
                self.pace = Pace::new(params.rate);
            }
            _ => return None,
        }
        Some(())
    }

    fn pose(&self, ix: u64) -> Rigid {
        let (round, rest) = (ix / self.turn, ix % self.turn);
        let forward = if round.is_multiple_of(2) {
            rest
        } else {
            self.turn - rest
        };
        // So the motion per second is the same at any rate.
        let t = forward as f64 * (RATE / self.rate);
        let at = DVec3::new(
            self.step * t,
            0.1 * (0.07 * t).sin(),
            0.5 * HEIGHT + 0.05 * (0.11 * t).sin(),
        );
        let ahead = DVec3::new(HEADING.cos(), HEADING.sin(), 0.0);
        let right = DVec3::new(ahead.y, -ahead.x, 0.0);
        let axes = DMat3::from_cols(right, -DVec3::Z, ahead);
        Rigid::new(DQuat::from_mat3(&axes), at)
    }

    fn look(&self, pose: &Rigid) -> (RgbImage, DepthMap) {
        let (w, h) = (self.lens.width_px as usize, self.lens.height_px as usize);
        let pixels: Vec<([u8; 3], f32)> = (0..w * h)
            .into_par_iter()
            .map(|p| {
                let pixel = DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5);
                let ray = pose.rotation * self.lens.ray_in_cam(pixel);
                let (z, colour) = hit(pose.translation, ray);
                let byte = |v: f32| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
                (colour.to_array().map(byte), z as f32)
            })
            .collect();
        let image = RgbImage {
            width_px: self.lens.width_px,
            height_px: self.lens.height_px,
            pixels: pixels.iter().flat_map(|(rgb, _)| *rgb).collect(),
        };
        let depth = DepthMap {
            width_px: self.lens.width_px,
            height_px: self.lens.height_px,
            depth: pixels.iter().map(|(_, z)| *z).collect(),
            confidence: vec![1.0; w * h],
        };
        (image, depth)
    }
}

impl Source for EndlessSource {
    fn next(&mut self) -> Option<Frame> {
        let ix = self.next_ix;
        if ix >= self.n_frames {
            return None;
        }
        self.next_ix += 1;
        let pose = self.pose(ix);
        let (image, depth) = self.look(&pose);
        let stamp = Stamp::from_secs(ix as f64 / self.rate);
        self.pace.wait_for(stamp);
        Some(Frame {
            seq: ix,
            stamp,
            image: Arc::new(image),
            intrinsics: Some(self.lens),
            truth: Some(pose),
            odometry: None,
            imu: None,
            sensor_depth: Some(Arc::new(depth)),
            second: None,
            is_held_out: false,
        })
    }

    fn counts(&self) -> SourceCounts {
        SourceCounts {
            received: self.next_ix,
            ..SourceCounts::default()
        }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.n_frames - self.next_ix)
    }

    fn truth_extent(&self) -> Option<f64> {
        let last = self.turn.min(self.n_frames - 1);
        Some(extent(&[
            self.pose(0).translation,
            self.pose(last).translation,
        ]))
    }
}

fn lens(width_px: u32, height_px: u32) -> Intrinsics {
    let f = 0.5 * f64::from(width_px) / (0.5 * FOV_DEG.to_radians()).tan();
    Intrinsics {
        width_px,
        height_px,
        fx: f,
        fy: f,
        cx: 0.5 * f64::from(width_px),
        cy: 0.5 * f64::from(height_px),
    }
}

/// How many times the ray, whose part along the camera's axis is 1, and the colour there.
fn hit(from: DVec3, ray: DVec3) -> (f64, Vec3) {
    let along = |start: f64, speed: f64, low: f64, high: f64| {
        let target = if speed > 0.0 { high } else { low };
        let t = (target - start) / speed;
        if t.is_finite() { t } else { f64::INFINITY }
    };
    let to_wall = along(from.y, ray.y, -HALF_WIDTH, HALF_WIDTH);
    let to_floor = along(from.z, ray.z, 0.0, HEIGHT);
    let z = to_wall.min(to_floor);
    let at = from + ray * z;
    // Each surface has panels of its own.
    let (across, surface) = if to_wall < to_floor {
        (at.z, u32::from(ray.y > 0.0))
    } else {
        (at.y, 2 + u32::from(ray.z > 0.0))
    };
    (z, paint(DVec2::new(at.x, across), surface))
}

fn paint(at: DVec2, surface: u32) -> Vec3 {
    let cell = (at / PANEL).floor();
    let id = hash2(IVec2::new(cell.x as i32, cell.y as i32), surface);
    let inside = (at / PANEL - cell).as_vec2();
    let base = hue(
        pick(id, 1),
        0.35 + 0.4 * pick(id, 2),
        0.35 + 0.4 * pick(id, 3),
    );
    // Repeats after 2 km, far beyond what anybody sees at once.
    let folded = Vec2::new((at.x % 2048.0) as f32, at.y as f32);
    let grain = value_noise(folded * 9.0, id) * 0.25 + value_noise(folded * 3.0, surface) * 0.2;
    let stripe =
        if (inside.x * (2.0 + 4.0 * pick(id, 4)) + inside.y * 3.0 * pick(id, 5)).fract() < 0.5 {
            0.85
        } else {
            1.15
        };
    base * stripe * (1.0 + grain)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(scene: &str) -> Result<EndlessSource, SourceError> {
        EndlessSource::open(scene, &SourceParams::default())
    }

    #[test]
    fn it_walks_on_turns_and_shows_the_same_again() {
        let mut source = open("endless?frames=9&turn=4&width=32&height=24").unwrap();
        let frames: Vec<Frame> = std::iter::from_fn(|| source.next()).collect();
        assert_eq!(frames.len(), 9);
        let place = |ix: usize| frames[ix].truth.unwrap().translation;
        assert!((place(4) - place(0)).length() > 0.35);
        assert_eq!(place(6), place(2));
        assert!(frames[6].image.pixels == frames[2].image.pixels);
        assert!(frames[4].image.pixels != frames[0].image.pixels);
        let depth = frames[0].sensor_depth.as_ref().unwrap();
        let median = depth.median().unwrap();
        assert!((0.8..3.0).contains(&median), "{median}");
        for wrong in [
            "endless?frames=0",
            "endless?fov=3",
            "endless?step",
            "endless?rate=0",
            "endless?rate=-1",
            "endless?rate=NaN",
            "endless?rate=1e9",
        ] {
            let message = open(wrong).unwrap_err().to_string();
            assert!(message.contains("rate in [1, 1000] Hz"), "{message}");
        }
    }

    #[test]
    fn it_walks_as_fast_at_any_rate() {
        let last = |scene: &str| {
            let mut source = open(&format!("{scene}&width=16&height=16")).unwrap();
            std::iter::from_fn(|| source.next()).last().unwrap()
        };
        let (slow, fast) = (last("endless?frames=9"), last("endless?frames=17&rate=30"));
        assert_eq!((slow.stamp, slow.truth), (fast.stamp, fast.truth));
    }

    #[test]
    fn depth_is_that_of_the_surface_that_is_seen() {
        let source = open("endless").unwrap();
        let pose = source.pose(7);
        let (_, depth) = source.look(&pose);
        for p in (0..depth.depth.len()).step_by(101) {
            let pixel = DVec2::new((p % 96) as f64 + 0.5, (p / 96) as f64 + 0.5);
            let at =
                pose.transform_point(source.lens.ray_in_cam(pixel) * f64::from(depth.depth[p]));
            let on_wall = (at.y.abs() - HALF_WIDTH).abs() < 1e-5;
            let on_floor = at.z.abs() < 1e-5 || (at.z - HEIGHT).abs() < 1e-5;
            assert!(on_wall || on_floor, "{at}");
        }
    }
}
