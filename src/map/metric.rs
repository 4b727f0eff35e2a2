//! What is known in metres beside the map -> metres of one map unit, with its standard deviation.
//!
//! A camera alone shows no lengths. Wheels, a depth camera, the height at which the camera is mounted or one measured
//! distance do; each gives many ratios, of which some are wrong: the median of their logarithms, then Huber's mean.

#[cfg(test)]
mod tests;

use glam::DVec3;
use rand::{RngExt as _, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::config::scale::{Known, ScaleParams};
use crate::frame::DepthMap;
use crate::map::SplatMap;
use crate::map::keyframes::Placed;
use crate::map::snapshot::{KeyframePose, Scale, ScaleSource};
use crate::pose::Rigid;

/// Ratios below which nothing is said.
const MIN_RATIOS: usize = 5;
/// A relative standard deviation above is no knowledge.
const MAX_STD: f64 = 0.1;
/// The path is cut into so many segments: long ones drown the noise of single poses, many tell how well they agree.
const N_SEGMENTS: f64 = 24.0;
/// Huber's loss bends at so many standard deviations, for so many rounds.
const HUBER: f64 = 1.5;
const ROUNDS: usize = 5;
/// Standard deviation of a normal distribution over its median absolute deviation.
const NORMAL_MAD: f64 = 1.4826;
/// What depth cameras and measured heights are off by in common, which no number of ratios shows.
const DEPTH_ERROR: f64 = 0.005;
const HEIGHT_ERROR: f64 = 0.02;
/// Pixels of a keyframe that depth is compared at, and the least.
const MAX_PIXELS: usize = 4000;
const MIN_PIXELS: usize = 100;
/// The floor: points of the lower half of the picture on a plane seen from above within this angle of upright, as the
/// camera is held; off by less than this share of its distance; at least this share of the points.
const MAX_TILT: f64 = 0.7;
const FLOOR_ERROR: f64 = 0.02;
const MIN_FLOOR: f64 = 0.3;
const FLOOR_TRIALS: usize = 60;
/// Places that one measured distance rests on are known to such a share of it.
const BASELINE_ERROR: f64 = 0.01;

/// The logarithm of metres per unit.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Estimate {
    log: f64,
    std: f64,
}

/// Of independent ratios; `common` is what all of them may be off by together. `None` where they are few or disagree.
fn robust(mut logs: Vec<f64>, common: f64) -> Option<Estimate> {
    logs.retain(|l| l.is_finite());
    if logs.len() < MIN_RATIOS {
        return None;
    }
    logs.sort_by(f64::total_cmp);
    let mut mean = logs[logs.len() / 2];
    let mut off: Vec<f64> = logs.iter().map(|l| (l - mean).abs()).collect();
    off.sort_by(f64::total_cmp);
    let spread = (NORMAL_MAD * off[off.len() / 2]).max(1e-6);
    let bend = HUBER * spread;
    let mut n_effective = 0.0;
    for _ in 0..ROUNDS {
        let weight = |l: &f64| (bend / (l - mean).abs()).min(1.0);
        n_effective = logs.iter().map(weight).sum::<f64>();
        mean = logs.iter().map(|l| weight(l) * l).sum::<f64>() / n_effective;
    }
    let std = (spread * spread / n_effective + common * common).sqrt();
    (std <= MAX_STD).then_some(Estimate { log: mean, std })
}

/// (map_from_cam, odom_from_cam in metres) of keyframes in order. Odometry drifts, so only its steps count.
fn of_odometry(track: &[(Rigid, Rigid)], common: f64) -> Option<Estimate> {
    let step = |a: &Rigid, b: &Rigid| (a.translation - b.translation).length();
    let path: f64 = track.windows(2).map(|two| step(&two[0].0, &two[1].0)).sum();
    let length = path / N_SEGMENTS;
    let (mut logs, mut start) = (Vec::new(), track.first()?);
    for end in track {
        let in_map = step(&start.0, &end.0);
        if in_map >= length && in_map > 0.0 {
            // Where wheels say that nothing moved, the logarithm is no number and goes.
            logs.push((step(&start.1, &end.1) / in_map).ln());
            start = end;
        }
    }
    robust(logs, common)
}

/// Median logarithm of metres over map units of one keyframe.
fn depth_ratio(metres: &DepthMap, units: &DepthMap) -> Option<f64> {
    let n = units.depth.len();
    let (w, h) = (units.width_px as usize, units.height_px as usize);
    let (in_w, in_h) = (metres.width_px as usize, metres.height_px as usize);
    let mut logs: Vec<f64> = (0..n)
        .step_by((n / MAX_PIXELS).max(1))
        .filter_map(|at| {
            let (x, y) = (at % w, at / w);
            let (unit, _) = units.verified(at)?;
            let (metre, _) = metres.verified(y * in_h / h * in_w + x * in_w / w)?;
            Some(f64::from(metre / unit).ln())
        })
        .collect();
    if logs.len() < MIN_PIXELS {
        return None;
    }
    let middle = logs.len() / 2;
    Some(*logs.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Distance of the camera from the plane that it stands above, in map units.
fn height_above_floor(depth: &DepthMap, lens: &Intrinsics, seed: u64) -> Option<f64> {
    let lens = lens.resized(depth.width_px, depth.height_px);
    let w = depth.width_px as usize;
    let lower = depth.depth.len() / 2..depth.depth.len();
    let points: Vec<DVec3> = lower
        .step_by((depth.depth.len() / MAX_PIXELS).max(1))
        .filter_map(|at| {
            let pixel = glam::DVec2::new((at % w) as f64 + 0.5, (at / w) as f64 + 0.5);
            Some(lens.ray_in_cam(pixel) * f64::from(depth.verified(at)?.0))
        })
        .collect();
    if points.len() < MIN_PIXELS {
        return None;
    }
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut best: Option<(usize, f64)> = None;
    for _ in 0..FLOOR_TRIALS {
        let mut pick = || points[rng.random_range(0..points.len())];
        let (a, b, c) = (pick(), pick(), pick());
        let Some(normal) = (b - a).cross(c - a).try_normalize() else {
            continue;
        };
        // OpenCV: y points down, so the floor's distance along it is positive.
        let normal = if normal.y < 0.0 { -normal } else { normal };
        let height = normal.dot(a);
        if normal.y < MAX_TILT.cos() || height <= 0.0 {
            continue;
        }
        let is_on = |p: &&DVec3| (normal.dot(**p) - height).abs() < FLOOR_ERROR * height;
        let on: Vec<f64> = points
            .iter()
            .filter(is_on)
            .map(|p| normal.dot(*p))
            .collect();
        if best.is_none_or(|(n, _)| on.len() > n) {
            best = Some((on.len(), on.iter().sum::<f64>() / on.len().max(1) as f64));
        }
    }
    let (n, height) = best?;
    (n as f64 >= MIN_FLOOR * points.len() as f64).then_some(height)
}

/// A distance that somebody measured between the camera's places at two times.
fn of_baseline(poses: &[KeyframePose], (from, to, metres): (f64, f64, f64)) -> Option<Estimate> {
    let first = poses.first()?.stamp;
    let nearest = |secs: f64| {
        let off = |p: &&KeyframePose| (p.stamp.secs_since(first) - secs).abs();
        poses.iter().min_by(|a, b| off(a).total_cmp(&off(b)))
    };
    let (a, b) = (nearest(from)?, nearest(to)?);
    let units = (a.map_from_cam.translation - b.map_from_cam.translation).length();
    let log = (metres / units).ln();
    log.is_finite().then_some(Estimate {
        log,
        std: BASELINE_ERROR,
    })
}

impl Placed {
    /// Logarithms of metres per map unit by this keyframe's own depth: as a depth camera has it, and over the floor.
    pub(super) fn measure(&mut self, params: &ScaleParams) {
        let units = &self.depth;
        if self.ratios.is_some() || units.width_px == 0 {
            return;
        }
        let by_depth = self.keyframe.frame.truth_depth.as_ref();
        let by_depth = by_depth.and_then(|metres| depth_ratio(metres, units));
        let by_height = (params.camera_height > 0.0)
            .then(|| height_above_floor(units, &self.intrinsics, u64::from(self.keyframe.id)))
            .flatten()
            .map(|units| (params.camera_height / units).ln());
        let unscaled = self.depth_factor.ln();
        self.ratios = Some([by_depth, by_height].map(|log| log.map(|l| l + unscaled)));
    }

    fn ratio(&self, which: usize) -> Option<f64> {
        Some(self.ratios?[which]? - self.depth_factor.ln())
    }
}

impl SplatMap {
    /// From now on looks for metres by these parameters, unless the geometry has them.
    #[must_use]
    pub fn measuring_scale(mut self, params: &ScaleParams) -> Self {
        self.scale_params = Some(params.clone());
        self
    }

    /// Metres per unit as far as anything tells; `poses` as a snapshot has them.
    pub(super) fn measure_scale(&mut self, poses: &[KeyframePose]) -> Scale {
        let Some(params) = self.scale_params.clone() else {
            return self.scale;
        };
        if self.scale.source == ScaleSource::Given || params.known == Known::Off {
            return self.scale;
        }
        for placed in self.keyframes.placed.values_mut() {
            placed.measure(&params);
        }
        let found = estimates(&params, self.keyframes.placed.values(), poses);
        let best = found
            .into_iter()
            .filter_map(|(source, estimate)| Some((source, estimate?)))
            .min_by(|a, b| a.1.std.total_cmp(&b.1.std));
        // What a saved map knows better stays.
        let known = self
            .past
            .as_ref()
            .and_then(|past| past.scale.relative_std());
        if let Some(known) = known
            && best.is_none_or(|(_, estimate)| known <= estimate.std)
        {
            return self.past.as_ref().map_or(self.scale, |past| past.scale);
        }
        let scale = best.map_or(Scale::UP_TO_SCALE, |(source, estimate)| {
            let metres = estimate.log.exp();
            Scale {
                source,
                metres_per_unit: Some(metres),
                std: Some(metres * estimate.std),
            }
        });
        if scale.source != self.scale.source {
            tracing::info!(
                source = scale.source.name(),
                metres_per_unit = scale.metres_per_unit,
                std = scale.std,
                "scale of the map"
            );
        }
        scale
    }
}

/// What each source that is allowed says.
fn estimates<'a>(
    params: &ScaleParams,
    placed: impl Iterator<Item = &'a Placed>,
    poses: &[KeyframePose],
) -> Vec<(ScaleSource, Option<Estimate>)> {
    let may = |known: Known| params.known == Known::Auto || params.known == known;
    let placed: Vec<&Placed> = placed.collect();
    let all = |which: usize| {
        placed
            .iter()
            .filter_map(|p| p.ratio(which))
            .collect::<Vec<_>>()
    };
    let mut found = Vec::new();
    if may(Known::Odometry) {
        let track: Vec<(Rigid, Rigid)> = placed
            .iter()
            .filter_map(|p| {
                let pose = pose_at(poses, p.keyframe.frame.stamp)?;
                Some((pose, p.keyframe.frame.odometry?))
            })
            .collect();
        let estimate = of_odometry(&track, params.odometry_error);
        found.push((ScaleSource::Odometry, estimate));
    }
    if may(Known::Depth) {
        found.push((ScaleSource::Depth, robust(all(0), DEPTH_ERROR)));
    }
    if may(Known::Height) {
        found.push((ScaleSource::Height, robust(all(1), HEIGHT_ERROR)));
    }
    if let Some(baseline) = params.baseline_secs().filter(|_| may(Known::Baseline)) {
        found.push((ScaleSource::Baseline, of_baseline(poses, baseline)));
    }
    found
}

fn pose_at(poses: &[KeyframePose], stamp: Stamp) -> Option<Rigid> {
    let ix = poses.binary_search_by_key(&stamp, |p| p.stamp).ok()?;
    Some(poses[ix].map_from_cam)
}
