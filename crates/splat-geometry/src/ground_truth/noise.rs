//! True views -> what a foundation model might say of them: its own frame and unit for each window, poses that are off by noise and by
//! errors that grow along the window, a focal length that is off, depth that is warped over the whole image, smeared across edges, noisy and
//! now and then far off, and a confidence that half knows where.
//!
//! docs/ALIGNMENT.md states the model. For tests and for `ground_truth.windows`.

use std::collections::BTreeSet;

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::answer::View;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Cells of the smooth part of a depth map's error: networks err by surface, not by pixel.
const CELLS: (usize, usize) = (8, 6);
/// An outlier lies between this factor and its inverse.
const OUTLIER: f64 = 2.0;
/// Confidence falls by e for an error of so many standard deviations.
const TELLTALE: f64 = 2.0;
/// Standard deviation of the logarithm of confidence that has nothing to do with the error.
const GUESSWORK: f64 = 0.3;
const MIN_CONFIDENCE: f64 = 0.02;
/// The unit of a window that jumps is drawn between this factor and its inverse.
const JUMP: f64 = 2.0;
/// Depth is smeared where the farthest of the pixels around is so much farther than the nearest: a step, not a slope.
const EDGE_RATIO: f32 = 1.1;
/// What confidence loses on smeared pixels: networks know of edges, and do not know which side a pixel is on.
const EDGE_CONFIDENCE: f32 = 0.5;
/// Errors that earlier versions of this model did not have are drawn from a stream of their own, so that the others stay what they were.
const WALK_STREAM: u64 = 0x77a1_6b00_77a1_6b00;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// The unit of a window is drawn between this and its inverse, even in the logarithm.
    pub scale: f64,
    /// Standard deviation about each axis.
    pub rotation_deg: f64,
    /// Standard deviation along each axis, share of the median depth.
    pub translation: f64,
    /// Relative standard deviation, half of its variance smooth over the image.
    pub depth: f64,
    /// Share of the pixels.
    pub outliers: f64,
    /// Share of the windows whose unit is drawn between twice and half instead.
    pub jumps: f64,
    /// Standard deviation about each axis by which the error grows from one view of a window to the next.
    pub walk_deg: f64,
    /// The same of the place along each axis, share of the median depth.
    pub walk_translation: f64,
    /// Relative standard deviation of depth that is warped smoothly over the whole image, half of the variance common to the window.
    pub warp: f64,
    /// Pixels of the depth map, to either side of a step in depth, over which the depths of both sides are mixed.
    pub edge_px: u32,
    /// Relative standard deviation of the focal length, the same for all views of a window.
    pub focal: f64,
}

impl Noise {
    /// What the figures in docs/ALIGNMENT.md are measured with.
    pub const STATED: Self = Self {
        scale: 1.25,
        rotation_deg: 1.0,
        translation: 0.02,
        depth: 0.05,
        outliers: 0.05,
        jumps: 0.0,
        walk_deg: 0.0,
        walk_translation: 0.0,
        warp: 0.0,
        edge_px: 0,
        focal: 0.0,
    };
    /// Errors as networks make them, from published figures (docs/ALIGNMENT.md): most of the pose error is common to neighbouring views,
    /// most of the depth error to whole surfaces.
    pub const NETWORK: Self = Self {
        scale: 1.25,
        rotation_deg: 0.3,
        translation: 0.005,
        depth: 0.03,
        outliers: 0.02,
        jumps: 0.1,
        walk_deg: 0.5,
        walk_translation: 0.01,
        warp: 0.04,
        edge_px: 2,
        focal: 0.02,
    };
}

/// The views of one window in a frame of their own, that of the first one.
pub fn answer(truth: &[View], noise: &Noise, seed: u64) -> Vec<View> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut walk = Walk::new(noise, seed);
    let unit = 2.0 * rng.random::<f64>() - 1.0;
    let widest = if walk.jumps {
        JUMP
    } else {
        noise.scale.max(1.0)
    };
    let scale = (widest.ln() * unit).exp();
    let mut views: Vec<View> = truth.to_vec();
    for view in &mut views {
        let median = view.depth.median().map_or(1.0, f64::from);
        let theta = normal3(&mut rng) * noise.rotation_deg.to_radians();
        let rho = normal3(&mut rng) * noise.translation * median;
        view.submap_from_cam = view.submap_from_cam * Rigid::exp(rho, theta);
        let edges = walk.disturb(view, noise, median);
        disturb(&mut view.depth, noise, scale, &mut rng);
        for at in edges {
            view.depth.confidence[at] *= EDGE_CONFIDENCE;
        }
        view.submap = 0;
    }
    if let Some(first) = views.first().map(|view| view.submap_from_cam.inverse()) {
        for view in &mut views {
            let mut pose = (first * view.submap_from_cam).renormalized();
            pose.translation *= scale;
            view.submap_from_cam = pose;
        }
    }
    views
}

/// Errors that the views of a window have in common.
#[derive(Debug)]
struct Walk {
    rng: Pcg64Mcg,
    jumps: bool,
    focal: f64,
    /// Of the view before, as translation and rotation in the camera.
    error: (DVec3, DVec3),
    warp: Warp,
}

impl Walk {
    fn new(noise: &Noise, seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ WALK_STREAM);
        Self {
            jumps: rng.random::<f64>() < noise.jumps,
            focal: (noise.focal * normal(&mut rng)).exp(),
            error: (DVec3::ZERO, DVec3::ZERO),
            warp: Warp::draw(&mut rng),
            rng,
        }
    }

    /// Returns the pixels that are smeared.
    fn disturb(&mut self, view: &mut View, noise: &Noise, median: f64) -> BTreeSet<usize> {
        self.error.0 += normal3(&mut self.rng) * noise.walk_translation * median;
        self.error.1 += normal3(&mut self.rng) * noise.walk_deg.to_radians();
        view.submap_from_cam = view.submap_from_cam * Rigid::exp(self.error.0, self.error.1);
        view.intrinsics.fx *= self.focal;
        view.intrinsics.fy *= self.focal;
        let edges = smear_edges(&mut view.depth, noise.edge_px as usize);
        let own = Warp::draw(&mut self.rng);
        if noise.warp > 0.0 {
            let (common, width) = (self.warp, view.depth.width_px as usize);
            let size = [width as f64, f64::from(view.depth.height_px)];
            for (at, depth) in view.depth.depth.iter_mut().enumerate() {
                let u = ((at % width) as f64 + 0.5) / size[0] * 2.0 - 1.0;
                let v = ((at / width) as f64 + 0.5) / size[1] * 2.0 - 1.0;
                let both = (common.at(u, v) + own.at(u, v)) * std::f64::consts::FRAC_1_SQRT_2;
                *depth *= (noise.warp * both).exp() as f32;
            }
        }
        edges
    }
}

/// A slope and a bowl over the image, with a mean square of 1 over draws and pixels.
#[derive(Debug, Clone, Copy)]
struct Warp([f64; 3]);

impl Warp {
    fn draw(rng: &mut Pcg64Mcg) -> Self {
        Self(std::array::from_fn(|_| normal(rng)))
    }

    /// Image coordinates from -1 to 1. Legendre polynomials: their mean squares over the image are 1/3 for `u` and `v`; `u^2 + v^2` less its
    /// mean of 2/3 has 8/45.
    fn at(self, u: f64, v: f64) -> f64 {
        let [across, down, bowl] = self.0;
        let bowl = bowl * (u * u + v * v - 2.0 / 3.0) / (8.0_f64 / 45.0).sqrt();
        ((across * u + down * v) * 3.0_f64.sqrt() + bowl) / 3.0_f64.sqrt()
    }
}

/// Near a step in depth, the mean inverse depth of the pixels around: surfaces of networks bridge gaps. Two passes, along rows and along columns.
/// Returns the pixels that changed.
fn smear_edges(depth: &mut DepthMap, radius: usize) -> BTreeSet<usize> {
    let mut changed = BTreeSet::new();
    if radius == 0 {
        return changed;
    }
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    for (n_lines, length, across, along) in [(h, w, w, 1), (w, h, 1, w)] {
        let before = depth.clone();
        for line in 0..n_lines {
            for x in 0..length {
                let at = |x: usize| line * across + x * along;
                let around = x.saturating_sub(radius)..(x + radius + 1).min(length);
                let depths = around.filter_map(|x| Some(before.verified(at(x))?.0));
                let (mut sum, mut n, mut near, mut far) = (0.0_f32, 0.0_f32, f32::MAX, 0.0_f32);
                for d in depths {
                    (sum, n, near, far) = (sum + 1.0 / d, n + 1.0, near.min(d), far.max(d));
                }
                let at = at(x);
                if before.verified(at).is_some() && far > EDGE_RATIO * near {
                    depth.depth[at] = n / sum;
                    changed.insert(at);
                }
            }
        }
    }
    changed
}

fn disturb(depth: &mut DepthMap, noise: &Noise, scale: f64, rng: &mut Pcg64Mcg) {
    let (w, h) = (depth.width_px as usize, depth.height_px as usize);
    let cells: Vec<f64> = (0..(CELLS.0 + 1) * (CELLS.1 + 1))
        .map(|_| normal(rng))
        .collect();
    for at in 0..w * h {
        let (x, y) = (at % w, at / w);
        let u = (x as f64 + 0.5) / w as f64 * CELLS.0 as f64;
        let v = (y as f64 + 0.5) / h as f64 * CELLS.1 as f64;
        let common = smooth(&cells, u, v);
        let own = normal(rng);
        let is_outlier = rng.random::<f64>() < noise.outliers;
        let far = (OUTLIER.ln() * (2.0 * rng.random::<f64>() - 1.0)).exp();
        let guess = GUESSWORK * normal(rng);
        if depth.verified(at).is_none() {
            continue;
        }
        let error = noise.depth * std::f64::consts::FRAC_1_SQRT_2 * (common + own);
        let factor = if is_outlier {
            far
        } else {
            (1.0 + error).max(0.05)
        };
        depth.depth[at] = (f64::from(depth.depth[at]) * factor * scale) as f32;
        let off = (factor - 1.0).abs() / noise.depth.max(1e-3);
        let confidence = (guess - off / TELLTALE).exp().clamp(MIN_CONFIDENCE, 1.0);
        depth.confidence[at] = confidence as f32;
    }
}

/// Between four normal numbers, with variance 1 everywhere.
fn smooth(cells: &[f64], u: f64, v: f64) -> f64 {
    let (x, y) = ((u as usize).min(CELLS.0 - 1), (v as usize).min(CELLS.1 - 1));
    let (a, b) = (u - x as f64, v - y as f64);
    let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
    let at = y * (CELLS.0 + 1) + x;
    let corners = [at, at + 1, at + CELLS.0 + 1, at + CELLS.0 + 2];
    let sum: f64 = weights.iter().zip(corners).map(|(w, c)| w * cells[c]).sum();
    let variance: f64 = weights.iter().map(|w| w * w).sum();
    sum / variance.sqrt()
}

pub fn normal3(rng: &mut Pcg64Mcg) -> DVec3 {
    DVec3::new(normal(rng), normal(rng), normal(rng))
}

/// Standard normal (Box and Muller 1958).
pub fn normal(rng: &mut Pcg64Mcg) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    let v: f64 = rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::answer::PoseQuality;
    use splat_types::camera::Intrinsics;

    const NONE: Noise = Noise {
        scale: 1.0,
        rotation_deg: 0.0,
        translation: 0.0,
        depth: 0.0,
        outliers: 0.0,
        ..Noise::STATED
    };

    /// A wall at 4 beside one at 2, seen from cameras in a row.
    fn truth() -> Vec<View> {
        let (width_px, height_px) = (32, 24);
        let depth = DepthMap {
            width_px,
            height_px,
            depth: (0..width_px * height_px)
                .map(|at| if at % width_px < 16 { 4.0 } else { 2.0 })
                .collect(),
            confidence: vec![1.0; (width_px * height_px) as usize],
        };
        (0..8)
            .map(|k| View {
                keyframe_id: k,
                submap: 0,
                intrinsics: Intrinsics {
                    width_px,
                    height_px,
                    fx: 30.0,
                    fy: 30.0,
                    cx: 16.0,
                    cy: 12.0,
                },
                lens: None,
                submap_from_cam: Rigid::exp(DVec3::X * 0.1 * f64::from(k), DVec3::ZERO),
                depth: depth.clone(),
                health: PoseQuality::default(),
            })
            .collect()
    }

    /// Root mean square over draws.
    fn spread(noise: &Noise, error: impl Fn(&[View], &[View]) -> f64) -> f64 {
        let truth = truth();
        let squares = (0..400).map(|seed| error(&answer(&truth, noise, seed), &truth).powi(2));
        (squares.sum::<f64>() / 400.0).sqrt()
    }

    #[test]
    fn without_noise_an_answer_is_the_truth() {
        for (found, exact) in answer(&truth(), &NONE, 7).iter().zip(truth()) {
            let step = found.submap_from_cam.inverse() * exact.submap_from_cam;
            assert!(step.translation.length() < 1e-9);
            let same = found.depth.depth.iter().zip(&exact.depth.depth);
            assert!(same.into_iter().all(|(a, b)| (a - b).abs() < 1e-6));
        }
    }

    #[test]
    fn errors_of_poses_grow_with_the_root_of_the_distance_in_the_window() {
        let noise = Noise {
            walk_deg: 1.0,
            ..NONE
        };
        let angle = |k: usize| {
            move |found: &[View], _: &[View]| {
                let step = found[0].submap_from_cam.inverse() * found[k].submap_from_cam;
                step.angle_to(&Rigid::IDENTITY).to_degrees()
            }
        };
        // Three axes.
        let expected = 3.0_f64.sqrt();
        let (near, far) = (spread(&noise, angle(1)), spread(&noise, angle(4)));
        assert!((near / expected - 1.0).abs() < 0.1, "{near}");
        assert!((far / near - 2.0).abs() < 0.2, "{near} {far}");
    }

    #[test]
    fn warped_depth_is_as_far_off_as_is_said_and_smooth() {
        let noise = Noise { warp: 0.1, ..NONE };
        let log = |view: &View, exact: &View, at: usize| {
            f64::from(view.depth.depth[at] / exact.depth.depth[at]).ln()
        };
        let over_the_image = |found: &[View], truth: &[View]| {
            let all = (0..32 * 24).map(|at| log(&found[3], &truth[3], at).powi(2));
            (all.sum::<f64>() / f64::from(32 * 24)).sqrt()
        };
        let size = spread(&noise, over_the_image);
        assert!((size / 0.1 - 1.0).abs() < 0.1, "{size}");
        let next = |found: &[View], truth: &[View]| {
            log(&found[3], &truth[3], 401) - log(&found[3], &truth[3], 400)
        };
        assert!(spread(&noise, next) < 0.02);
        let of_two_views = |found: &[View], truth: &[View]| {
            log(&found[3], &truth[3], 400) - log(&found[4], &truth[4], 400)
        };
        let (own, centre) = (spread(&noise, of_two_views), |f: &[View], t: &[View]| {
            log(&f[3], &t[3], 400)
        });
        let ratio = own / spread(&noise, centre);
        assert!((0.8..1.2).contains(&ratio), "half is common: {ratio}");
    }

    #[test]
    fn edges_are_smeared_and_trusted_less_and_nothing_else_is() {
        let noise = Noise { edge_px: 2, ..NONE };
        let found = &answer(&truth(), &noise, 1)[0];
        let row: Vec<f32> = (12..20).map(|x| found.depth.depth[320 + x]).collect();
        assert!(row.is_sorted_by(|a, b| a >= b), "{row:?}");
        assert_eq!((row[0], row[7]), (4.0, 2.0));
        let mixed = row.iter().filter(|d| (2.01..3.99).contains(*d)).count();
        assert_eq!(mixed, 4, "two pixels on either side: {row:?}");
        let (on, off) = (found.depth.confidence[335], found.depth.confidence[322]);
        assert!(on < off, "{on} {off}");
    }

    #[test]
    fn units_jump_and_focal_lengths_are_off_as_often_and_as_far_as_is_said() {
        let noise = Noise {
            jumps: 0.25,
            focal: 0.05,
            ..NONE
        };
        let ratio = |found: &[View]| f64::from(found[0].depth.depth[0] / 4.0);
        let answers: Vec<Vec<View>> = (0..400).map(|s| answer(&truth(), &noise, s)).collect();
        let jumped = answers.iter().filter(|a| (ratio(a) - 1.0).abs() > 0.01);
        assert!((75..125).contains(&jumped.count()));
        assert!(answers.iter().all(|a| (0.5..2.0).contains(&ratio(a))));
        let focal =
            |found: &[View], truth: &[View]| (found[5].intrinsics.fx / truth[5].intrinsics.fx).ln();
        let off = spread(&noise, focal);
        assert!((off / 0.05 - 1.0).abs() < 0.1, "{off}");
        let same = |a: &Vec<View>| a.iter().all(|v| v.intrinsics.fx == a[0].intrinsics.fx);
        assert!(answers.iter().all(same));
    }
}
