//! Matched views with rough poses -> poses of least epipolar error (VGGT-X, global alignment).
//!
//! Adam over unit quaternions, translations, one focal length and one principal point. The base rate follows the
//! error at the start, so that good poses are not shaken. Knows nothing of depth.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::alignment::epipolar_distance::{
    by_quaternion, distance, distance_and_gradient, fundamental, inner, inverse_of, outer,
};
use crate::alignment::matched::{Matched, camera_spread};
use crate::stats::median;
use splat_types::camera::Intrinsics;
use splat_types::transform::{Rigid, skew};

/// Errors are judged at the image size that the procedure was written for.
const JUDGED_SIDE_PX: f64 = 518.0;
const N_BINS: usize = 100;
/// Beyond this a match says nothing.
const MAX_ERROR_PX: f64 = 20.0;
/// (median error at the start up to which it holds, base rate of Adam).
const RATES: [(f64, f64); 3] = [(2.5, 5e-4), (7.5, 1e-3), (f64::INFINITY, 1e-2)];
const BETAS: (f64, f64) = (0.9, 0.9);
const EPSILON: f64 = 1e-8;
/// Numbers of a camera: quaternion w x y z, translation.
const PER_CAMERA: usize = 7;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    pub steps: usize,
    pub moves_focal: bool,
    pub moves_centre: bool,
    /// Length that counts as 1 in the rates, for example the median depth.
    pub unit: f64,
}

/// Median symmetric epipolar distance in pixels of the working image; `None` without matches.
pub fn median_error_px(matched: &Matched) -> Option<f64> {
    let mut errors: Vec<f64> = Vec::new();
    for pair in &matched.pairs {
        let [a, b] = [&matched.views[pair.first], &matched.views[pair.second]];
        let f = fundamental(
            [a.cam_from_submap, b.cam_from_submap],
            [inverse_of(&a.lens), inverse_of(&b.lens)],
        );
        let ends = pair.features.iter();
        errors.extend(ends.map(|&(i, j)| distance(&f, a.pixels[i as usize], b.pixels[j as usize])));
    }
    errors.retain(|e| e.is_finite());
    median(&mut errors)
}

/// Moves the poses that are not held, and the focal length if asked.
pub fn align(matched: &mut Matched, settings: &Settings) {
    let Some(terms) = Terms::new(matched) else {
        return;
    };
    let unit = if settings.unit > 0.0 && settings.unit.is_finite() {
        settings.unit
    } else {
        1.0
    };
    let mut x = flattened(matched, unit);
    let free = free_numbers(matched, settings);
    let spread = Spread::new(matched, unit);
    let (mut first, mut second) = (vec![0.0; x.len()], vec![0.0; x.len()]);
    for step in 0..settings.steps {
        let (_, gradient) = terms.loss(&x);
        let rate = terms.base_rate * cosine(step as f64 / settings.steps as f64);
        let n = step as i32 + 1;
        let correction = (1.0 - BETAS.0.powi(n), 1.0 - BETAS.1.powi(n));
        for k in (0..x.len()).filter(|&k| free[k]) {
            first[k] = BETAS.0 * first[k] + (1.0 - BETAS.0) * gradient[k];
            second[k] = BETAS.1 * second[k] + (1.0 - BETAS.1) * gradient[k] * gradient[k];
            let mean = first[k] / correction.0;
            x[k] -= rate * mean / ((second[k] / correction.1).sqrt() + EPSILON);
        }
        spread.restore(&mut x);
    }
    if x.iter().all(|v| v.is_finite()) {
        unflatten(matched, &x, unit);
    }
}

/// From 1 down to a tenth.
fn cosine(share: f64) -> f64 {
    0.1 + 0.45 * (1.0 + (std::f64::consts::PI * share).cos())
}

/// Quaternion and translation of each camera, then log-focal, then the shift of the principal point as a share of
/// the image's sides.
fn flattened(matched: &Matched, unit: f64) -> Vec<f64> {
    let mut x = Vec::new();
    for view in &matched.views {
        let (q, t) = (
            view.cam_from_submap.rotation,
            view.cam_from_submap.translation / unit,
        );
        x.extend([q.w, q.x, q.y, q.z, t.x, t.y, t.z]);
    }
    x.extend([0.0; 3]);
    x
}

fn pose_at(x: &[f64], camera: usize) -> Rigid {
    let c = &x[PER_CAMERA * camera..][..PER_CAMERA];
    Rigid::new(
        DQuat::from_xyzw(c[1], c[2], c[3], c[0]).normalize(),
        DVec3::new(c[4], c[5], c[6]),
    )
}

fn lens_at(x: &[f64], lens: &Intrinsics) -> Intrinsics {
    let [focal, cx, cy] = [x[x.len() - 3], x[x.len() - 2], x[x.len() - 1]];
    let mut lens = lens.refocused(focal.exp());
    lens.cx += cx * f64::from(lens.width_px);
    lens.cy += cy * f64::from(lens.height_px);
    lens
}

fn unflatten(matched: &mut Matched, x: &[f64], unit: f64) {
    for (ix, view) in matched.views.iter_mut().enumerate() {
        let mut pose = pose_at(x, ix);
        pose.translation *= unit;
        let lens = lens_at(x, &view.lens);
        if !view.is_held {
            view.cam_from_submap = pose;
        }
        if lens.is_plausible() {
            view.lens = lens;
        }
    }
}

/// The first camera holds the frame where no other is held, and cameras without matches have nowhere to go.
fn free_numbers(matched: &Matched, settings: &Settings) -> Vec<bool> {
    let n = matched.views.len();
    let mut free = vec![false; PER_CAMERA * n + 3];
    let is_anchored = matched.views.iter().any(|s| s.is_held);
    for pair in &matched.pairs {
        for camera in [pair.first, pair.second] {
            let is_free = !matched.views[camera].is_held && (is_anchored || camera > 0);
            free[PER_CAMERA * camera..][..PER_CAMERA].fill(is_free);
        }
    }
    free[PER_CAMERA * n] = settings.moves_focal;
    free[PER_CAMERA * n + 1..].fill(settings.moves_centre);
    free
}

/// The error does not change with the scale of all translations, so that steps let it drift.
struct Spread {
    n: usize,
    anchor: usize,
    wanted: f64,
}

impl Spread {
    fn new(matched: &Matched, unit: f64) -> Self {
        let n_held = matched.views.iter().filter(|s| s.is_held).count();
        let anchor = matched.views.iter().position(|s| s.is_held).unwrap_or(0);
        let poses: Vec<Rigid> = matched.views.iter().map(|s| s.cam_from_submap).collect();
        Self {
            n: matched.views.len(),
            anchor,
            // Two held cameras hold the scale themselves.
            wanted: if n_held >= 2 {
                0.0
            } else {
                camera_spread(&poses) / unit
            },
        }
    }

    fn restore(&self, x: &mut [f64]) {
        if self.wanted <= 0.0 {
            return;
        }
        let poses: Vec<Rigid> = (0..self.n).map(|i| pose_at(x, i)).collect();
        let found = camera_spread(&poses);
        if found.is_nan() || found <= 1e-9 {
            return;
        }
        let factor = self.wanted / found;
        let centre = poses[self.anchor].inverse().translation;
        for (i, pose) in poses.iter().enumerate() {
            let at = centre + (pose.inverse().translation - centre) * factor;
            let t = -(pose.rotation * at);
            x[PER_CAMERA * i + 4..][..3].copy_from_slice(&t.to_array());
        }
    }
}

struct Term {
    cameras: [usize; 2],
    /// Pixels of both ends, and the weight.
    matches: Vec<(DVec2, DVec2, f64)>,
}

struct Terms {
    lenses: Vec<Intrinsics>,
    terms: Vec<Term>,
    n: f64,
    base_rate: f64,
}

impl Terms {
    /// `None` without a match that counts.
    fn new(matched: &Matched) -> Option<Self> {
        let longest = matched.views.iter().map(|s| {
            let (w, h) = (s.lens.width_px, s.lens.height_px);
            f64::from(w.max(h))
        });
        let to_judged = JUDGED_SIDE_PX / longest.fold(1.0, f64::max);
        let mut terms = Vec::new();
        let mut errors = Vec::new();
        for pair in &matched.pairs {
            let [a, b] = [&matched.views[pair.first], &matched.views[pair.second]];
            let f = fundamental(
                [a.cam_from_submap, b.cam_from_submap],
                [inverse_of(&a.lens), inverse_of(&b.lens)],
            );
            let ends = |&(i, j): &(u32, u32)| (a.pixels[i as usize], b.pixels[j as usize], 0.0);
            let matches: Vec<_> = pair.features.iter().map(ends).collect();
            errors.extend(matches.iter().map(|(p, q, _)| {
                let is_inside = is_inside(&a.lens, *p) && is_inside(&b.lens, *q);
                let error = distance(&f, *p, *q) * to_judged;
                if is_inside { error } else { f64::INFINITY }
            }));
            terms.push(Term {
                cameras: [pair.first, pair.second],
                matches,
            });
        }
        let weights = weights(&errors)?;
        let slots = terms.iter_mut().flat_map(|t| t.matches.iter_mut());
        slots.zip(&weights).for_each(|(slot, w)| slot.2 = *w);
        errors.retain(|e| e.is_finite());
        let start = median(&mut errors)?;
        let rate = RATES.iter().find(|(limit, _)| start < *limit)?;
        Some(Self {
            lenses: matched.views.iter().map(|s| s.lens).collect(),
            terms,
            n: weights.len() as f64,
            base_rate: rate.1,
        })
    }

    /// Weighted mean distance and its gradient by every number of `x`.
    fn loss(&self, x: &[f64]) -> (f64, Vec<f64>) {
        let n_cameras = self.lenses.len();
        let poses: Vec<Rigid> = (0..n_cameras).map(|i| pose_at(x, i)).collect();
        let inverses: Vec<DMat3> = self
            .lenses
            .iter()
            .map(|lens| inverse_of(&lens_at(x, lens)))
            .collect();
        let one = |term: &Term| {
            let [i, j] = term.cameras;
            let f = fundamental([poses[i], poses[j]], [inverses[i], inverses[j]]);
            let (mut loss, mut by_f) = (0.0, DMat3::ZERO);
            for (p, q, weight) in term.matches.iter().filter(|m| m.2 > 0.0) {
                let (error, gradient) = distance_and_gradient(&f, *p, *q);
                if error.is_finite() && gradient.is_finite() {
                    loss += weight * error;
                    by_f += gradient * *weight;
                }
            }
            (loss / self.n, by_f * (1.0 / self.n))
        };
        let parts: Vec<(f64, DMat3)> = self.terms.par_iter().map(one).collect();
        let mut gradient = vec![0.0; x.len()];
        let mut loss = 0.0;
        for (term, (part, by_f)) in self.terms.iter().zip(&parts) {
            loss += part;
            self.chain(x, (&poses, &inverses), term.cameras, by_f, &mut gradient);
        }
        (loss, gradient)
    }

    /// Adds one pair's gradient by the fundamental matrix to those of the numbers that it is made of.
    fn chain(
        &self,
        x: &[f64],
        (poses, inverses): (&[Rigid], &[DMat3]),
        [i, j]: [usize; 2],
        by_f: &DMat3,
        gradient: &mut [f64],
    ) {
        let [r1, r2] = [poses[i].rotation_matrix(), poses[j].rotation_matrix()];
        let [t1, t2] = [poses[i].translation, poses[j].translation];
        let [k1, k2] = [inverses[i], inverses[j]];
        let r = r2 * r1.transpose();
        let t = t2 - r * t1;
        let e = skew(t) * r;
        // F = K2^-T E K1^-1.
        let by_e = k2 * *by_f * k1.transpose();
        let by_k1 = (k2.transpose() * e).transpose() * *by_f;
        let by_k2 = e * k1 * by_f.transpose();
        let by_t = DVec3::new(
            inner(&by_e, &(skew(DVec3::X) * r)),
            inner(&by_e, &(skew(DVec3::Y) * r)),
            inner(&by_e, &(skew(DVec3::Z) * r)),
        );
        let by_r = skew(t).transpose() * by_e - outer(by_t, t1);
        let by_r1 = by_r.transpose() * r2;
        let by_r2 = by_r * r1;
        for (camera, by_r, by_t) in [(i, by_r1, -(r.transpose() * by_t)), (j, by_r2, by_t)] {
            let at = PER_CAMERA * camera;
            let by_q = by_quaternion(&x[at..at + 4], &by_r);
            for (k, g) in by_q.into_iter().chain(by_t.to_array()).enumerate() {
                gradient[at + k] += g;
            }
        }
        let tail = x.len() - 3;
        for (camera, by_k, k) in [(i, by_k1, k1), (j, by_k2, k2)] {
            let lens = &self.lenses[camera];
            // The first two rows of K^-1 go with 1 / f.
            for column in 0..3 {
                for row in 0..2 {
                    gradient[tail] -= by_k.col(column)[row] * k.col(column)[row];
                }
            }
            gradient[tail + 1] -= by_k.z_axis.x * k.x_axis.x * f64::from(lens.width_px);
            gradient[tail + 2] -= by_k.z_axis.y * k.y_axis.y * f64::from(lens.height_px);
        }
    }
}

/// How common an error like it is, square root, mean 1 (VGGT-X weighs so); 0 outside the image or far off.
fn weights(errors: &[f64]) -> Option<Vec<f64>> {
    let bin = |error: &f64| {
        let is_near = *error >= 0.0 && *error < MAX_ERROR_PX;
        is_near.then(|| ((error / MAX_ERROR_PX * N_BINS as f64) as usize).min(N_BINS - 1))
    };
    let mut counts = [0.0_f64; N_BINS];
    for error in errors {
        if let Some(bin) = bin(error) {
            counts[bin] += 1.0;
        }
    }
    let mass = |error: &f64| bin(error).map_or(0.0, |bin| counts[bin].sqrt());
    let raw: Vec<f64> = errors.iter().map(mass).collect();
    let mean = raw.iter().sum::<f64>() / raw.len().max(1) as f64;
    (mean > 0.0).then(|| raw.iter().map(|w| w / mean).collect())
}

fn is_inside(lens: &Intrinsics, pixel: DVec2) -> bool {
    let (w, h) = (f64::from(lens.width_px), f64::from(lens.height_px));
    pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= w && pixel.y <= h
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::aligner::tests::toy;

    /// Central differences at this step agree with an exact gradient to about its square.
    const STEP: f64 = 1e-6;
    const MAX_DIFFERENCE: f64 = 1e-5;

    #[test]
    fn the_gradient_is_that_of_central_differences() {
        let matched = toy(4, 1.0, 0.02).0;
        let terms = Terms::new(&matched).unwrap();
        let mut x = flattened(&matched, 1.0);
        let n = x.len();
        // Off the unit length, and off the centre: both must be chained through.
        x[8] *= 1.1;
        x[n - 3] = 0.02;
        x[n - 1] = 0.01;
        let (_, gradient) = terms.loss(&x);
        let largest = gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
        for k in 0..n {
            let moved = |by: f64| {
                let mut x = x.clone();
                x[k] += by;
                terms.loss(&x).0
            };
            let numeric = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            let difference = (numeric - gradient[k]).abs() / largest;
            assert!(
                difference <= MAX_DIFFERENCE,
                "number {k}: {numeric} by differences, {}",
                gradient[k]
            );
        }
    }

    #[test]
    fn common_errors_count_and_far_ones_do_not() {
        let found = weights(&[1.01, 1.05, 1.1, 1.12, 7.0, 25.0, f64::INFINITY]).unwrap();
        assert!((found[0] / found[4] - 2.0).abs() < 1e-12, "root of 4 to 1");
        assert_eq!(found[5..], [0.0, 0.0]);
        assert!((found.iter().sum::<f64>() / 7.0 - 1.0).abs() < 1e-12);
        assert!(weights(&[30.0]).is_none());
    }
}
