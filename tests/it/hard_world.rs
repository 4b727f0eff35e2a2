//! A small world for images that a camera had better not be registered by: textured boxes, seen by rows at their own time.

use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::sfm::Shown;
use splat_types::camera::Intrinsics;
use splat_types::frame::{Frame, Keyframe};
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

pub(crate) const LENS: Intrinsics = Intrinsics {
    width_px: 400,
    height_px: 300,
    fx: 330.0,
    fy: 330.0,
    cx: 200.0,
    cy: 150.0,
};

#[derive(Clone, Copy)]
pub(crate) enum Paint {
    /// Squares of many sizes in random greys.
    Varied,
    /// The same motif on every tile.
    Repeated,
    Blank,
}

/// A box with axes along the world's.
#[derive(Clone, Copy)]
pub(crate) struct Solid {
    pub(crate) low: DVec3,
    pub(crate) high: DVec3,
    pub(crate) paint: Paint,
    /// In its size per frame.
    pub(crate) velocity: DVec3,
}

impl Solid {
    pub(crate) fn new(low: [f64; 3], high: [f64; 3], paint: Paint) -> Self {
        Self {
            low: DVec3::from_array(low),
            high: DVec3::from_array(high),
            paint,
            velocity: DVec3::ZERO,
        }
    }

    pub(crate) fn moving(self, velocity: [f64; 3]) -> Self {
        Self {
            velocity: DVec3::from_array(velocity),
            ..self
        }
    }

    /// Distance along the ray and luma there. A ray that starts within sees the inside.
    fn meet(&self, origin: DVec3, direction: DVec3, frame: f64, ix: u32) -> Option<(f64, f64)> {
        let origin = origin - self.velocity * frame;
        let (a, b) = (
            (self.low - origin) / direction,
            (self.high - origin) / direction,
        );
        let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
        let at = if near > 1e-6 { near } else { far };
        if near > far || at <= 1e-6 {
            return None;
        }
        let p = origin + direction * at;
        let off = ((p - self.low).abs().min((p - self.high).abs())).to_array();
        let axis = (0..3).min_by(|i, j| off[*i].total_cmp(&off[*j]))?;
        let is_low = (p - self.low).to_array()[axis].abs() < 1e-6;
        let on_face = match axis {
            0 => DVec2::new(p.y, p.z),
            1 => DVec2::new(p.x, p.z),
            _ => DVec2::new(p.x, p.y),
        };
        let seed = ix * 6 + axis as u32 * 2 + u32::from(is_low);
        Some((at, luma(self.paint, on_face, seed)))
    }
}

/// How the camera spoils what it sees.
#[derive(Clone, Copy, Default)]
pub(crate) struct Flaws {
    /// Gaussian blur in pixels.
    pub(crate) blur_px: f64,
    /// Share of the way to the next pose that passes from the first row to the last.
    pub(crate) rolling: f64,
    /// Stops up and down that the exposure swings.
    pub(crate) stops: f64,
    /// 8-bit levels.
    pub(crate) noise: f64,
}

/// The images that a camera takes at these poses (`world_from_cam`).
pub(crate) fn film(solids: &[Solid], poses: &[Rigid], flaws: Flaws, lens: Intrinsics) -> Shown {
    let keyframe = |(ix, pose): (usize, &Rigid)| {
        let next = poses.get(ix + 1).unwrap_or(pose);
        let image = Arc::new(test_image(solids, (pose, next), flaws, ix));
        let frame = Frame {
            seq: ix as u64,
            stamp: Stamp::from_secs(ix as f64),
            image,
            intrinsics: Some(lens),
            truth: None,
            odometry: None,
            imu: None,
            sensor_depth: None,
            second: None,
            is_held_out: false,
        };
        Arc::new(Keyframe {
            id: ix as u32,
            frame,
            age: Stopwatch::start(),
        })
    };
    Shown {
        keyframes: poses.par_iter().enumerate().map(keyframe).collect(),
        truth: poses.to_vec(),
    }
}

/// Exact z-depth at the pixel centres of an image with this lens.
pub(crate) fn depth(solids: &[Solid], pose: &Rigid, lens: &Intrinsics) -> Vec<f64> {
    let rows = 0..lens.height_px;
    let pixels = rows.flat_map(|y| (0..lens.width_px).map(move |x| (x, y)));
    let one = |(x, y)| {
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let direction = pose.rotation * lens.ray_in_cam(pixel);
        let hits = solids
            .iter()
            .filter_map(|solid| Some(solid.meet(pose.translation, direction, 0.0, 0)?.0));
        hits.fold(f64::INFINITY, f64::min)
    };
    pixels.map(one).collect()
}

/// Share of the image that the solids from the `first` on take.
pub(crate) fn share_in_observation(solids: &[Solid], first: usize, pose: &Rigid, ix: usize) -> f64 {
    let pixels = (0..LENS.height_px)
        .step_by(8)
        .flat_map(|y| (0..LENS.width_px).step_by(8).map(move |x| (x, y)));
    let (mut taken, mut all) = (0, 0);
    for (x, y) in pixels {
        let pixel = DVec2::new(f64::from(x), f64::from(y));
        let hit = nearest(
            solids,
            pose.translation,
            pose.rotation * LENS.ray_in_cam(pixel),
            ix,
        );
        taken += usize::from(hit.is_some_and(|hit| hit.0 >= first));
        all += 1;
    }
    taken as f64 / f64::from(all)
}

/// (number of the solid, luma).
fn nearest(solids: &[Solid], origin: DVec3, direction: DVec3, ix: usize) -> Option<(usize, f64)> {
    let hits = solids.iter().enumerate().filter_map(|(k, solid)| {
        let (at, luma) = solid.meet(origin, direction, ix as f64, k as u32)?;
        Some((at, (k, luma)))
    });
    hits.min_by(|a, b| a.0.total_cmp(&b.0)).map(|hit| hit.1)
}

fn test_image(
    solids: &[Solid],
    (pose, next): (&Rigid, &Rigid),
    flaws: Flaws,
    ix: usize,
) -> RgbImage {
    let (w, h) = (LENS.width_px as usize, LENS.height_px as usize);
    let mut light = Vec::with_capacity(w * h);
    for y in 0..h {
        // Poses are those of the middle row.
        let late = flaws.rolling * (y as f64 / h as f64 - 0.5);
        let centre = pose.translation.lerp(next.translation, late);
        let turn = pose.rotation.slerp(next.rotation, late);
        for x in 0..w {
            let mut sum = 0.0;
            for (dx, dy) in [(0.25, 0.3), (0.75, 0.2), (0.3, 0.8), (0.7, 0.7)] {
                let pixel = DVec2::new(x as f64 + dx, y as f64 + dy);
                let direction = turn * LENS.ray_in_cam(pixel);
                sum += nearest(solids, centre, direction, ix).map_or(0.5, |hit| hit.1);
            }
            light.push(0.25 * sum);
        }
    }
    if flaws.blur_px > 0.0 {
        light = blurred(&light, w, flaws.blur_px);
    }
    let gain = (flaws.stops * (ix as f64 * 0.9).sin()).exp2();
    let level = |(i, v): (usize, &f64)| {
        let noise = flaws.noise
            * (0..4)
                .map(|k| unit(i as u32 * 4 + k + 77, ix as u32) - 0.5)
                .sum::<f64>()
            * 1.7;
        (255.0 * (v * gain).min(1.0) + noise)
            .round()
            .clamp(0.0, 255.0) as u8
    };
    RgbImage {
        width_px: w as u32,
        height_px: h as u32,
        pixels: light
            .iter()
            .enumerate()
            .flat_map(|p| [level(p); 3])
            .collect(),
    }
}

fn blurred(light: &[f64], w: usize, sigma: f64) -> Vec<f64> {
    let radius = (2.5 * sigma).ceil() as isize;
    let weights: Vec<f64> = (-radius..=radius)
        .map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    let h = light.len() / w;
    let pass = |from: &[f64], step: isize, n: usize, place: &dyn Fn(usize) -> usize| {
        let at = |i: usize| {
            let here = place(i) as isize;
            let sum: f64 = weights
                .iter()
                .enumerate()
                .map(|(k, weight)| {
                    let by = (here + k as isize - radius).clamp(0, n as isize - 1) - here;
                    weight * from[(i as isize + by * step) as usize]
                })
                .sum();
            sum / total
        };
        (0..from.len()).map(at).collect::<Vec<f64>>()
    };
    let across = pass(light, 1, w, &|i| i % w);
    pass(&across, w as isize, h, &|i| i / w)
}

fn luma(paint: Paint, p: DVec2, seed: u32) -> f64 {
    match paint {
        Paint::Blank => 0.55,
        Paint::Varied => varied(p, seed),
        Paint::Repeated => varied(p - (p / 0.4).floor() * 0.4, 5),
    }
}

fn varied(p: DVec2, seed: u32) -> f64 {
    let cells = [(0.83, 0.3), (0.31, 0.3), (0.13, 0.25), (0.055, 0.15)];
    let square = |(k, (size, weight)): (usize, &(f64, f64))| {
        let turned = DVec2::from_angle(0.5 * k as f64).rotate(p) / size;
        let cell = turned.floor();
        let id = (cell.x as i32 as u32).wrapping_mul(0x9E37_79B1)
            ^ (cell.y as i32 as u32).wrapping_mul(0x85EB_CA77);
        weight * unit(id, seed * 7 + k as u32)
    };
    cells.iter().enumerate().map(square).sum::<f64>()
}

/// [0, 1) of two numbers.
fn unit(a: u32, b: u32) -> f64 {
    let mut x = a ^ b.wrapping_mul(0x27D4_EB2F) ^ 0x1656_67B1;
    x = (x ^ (x >> 15)).wrapping_mul(0x2C1B_3C6D);
    x = (x ^ (x >> 12)).wrapping_mul(0x297A_2D39);
    f64::from(x ^ (x >> 15)) / 4_294_967_296.0
}

/// Looks from `eye` at `target`, horizon level (y points down).
pub(crate) fn looking(eye: DVec3, target: DVec3) -> Rigid {
    let forward = (target - eye).normalize();
    let right = DVec3::Y.cross(forward).normalize();
    let axes = glam::DMat3::from_cols(right, forward.cross(right), forward);
    Rigid::new(DQuat::from_mat3(&axes), eye)
}
