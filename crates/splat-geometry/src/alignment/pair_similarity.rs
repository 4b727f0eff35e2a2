//! Matches of two views, and the depth of both -> the similarity between them, if pixels and depth agree on one.

use glam::{DVec2, DVec3};
use rand::SeedableRng;
use rand_pcg::Pcg32;

use crate::answer::View;
use crate::ransac::{self, Tries};
use crate::similarity;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Similarity;

/// RANSAC draws three matches so often.
const TRIES: usize = 400;
const ROUNDS: usize = 4;
/// Matches that must agree, and their share of those that have depth.
const MIN_INLIERS: usize = 20;
const MIN_SHARE: f64 = 0.5;
/// A point lands so near in both images, in pixels of an image of 640; depth off by 5 % moves it as much where the
/// two views stand apart by a third of the depth.
const MAX_ERROR_PX: f64 = 12.0;
const ERROR_SIDE_PX: f64 = 640.0;
/// Its depth is off by less than so many expected errors.
const MAX_DEPTH_ERRORS: f64 = 4.0;
/// Matches in one corner say little: standard deviation of their pixels as a share of the longer side.
const MIN_SPREAD: f64 = 0.06;
/// Share of one view's surface that the other must see, and of that what must lie where the other has its surface.
const MIN_SEEN: f64 = 0.15;
const MIN_FITTING: f64 = 0.6;

/// Two keyframes that see the same place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PairSimilarity {
    pub(crate) older: u32,
    pub(crate) newer: u32,
    pub(crate) older_from_newer: Similarity,
    /// Matches that agree.
    pub(crate) n: usize,
}

impl PairSimilarity {
    pub(crate) fn ends(&self) -> (u32, u32) {
        (self.older, self.newer)
    }
}

/// A view with its features, and the depth of each.
pub(crate) struct ViewFeatures<'a> {
    pub(crate) view: &'a View,
    pub(crate) lens: Intrinsics,
    pub(crate) pixels: Vec<DVec2>,
    pub(crate) depths: Vec<Option<f64>>,
}

/// One match with depth on both sides.
struct Pair {
    a: DVec3,
    b: DVec3,
    pixel_a: DVec2,
    pixel_b: DVec2,
}

/// `a` is the older one; matches as (feature of a, feature of b).
pub(crate) fn verified(
    a: &ViewFeatures<'_>,
    b: &ViewFeatures<'_>,
    matches: &[(u32, u32)],
    depth_error: f64,
) -> Option<PairSimilarity> {
    let point = |seen: &ViewFeatures<'_>, i: u32| {
        let depth = seen.depths.get(i as usize).copied().flatten()?;
        let pixel = *seen.pixels.get(i as usize)?;
        Some((seen.lens.ray_in_cam(pixel) * depth, pixel))
    };
    let pair = |&(i, j): &(u32, u32)| {
        let ((a, pixel_a), (b, pixel_b)) = (point(a, i)?, point(b, j)?);
        Some(Pair {
            a,
            b,
            pixel_a,
            pixel_b,
        })
    };
    let pairs: Vec<Pair> = matches.iter().filter_map(pair).collect();
    if pairs.len() < MIN_INLIERS {
        return None;
    }
    let (older, newer) = (a.view.keyframe_id, b.view.keyframe_id);
    let gate = Gate {
        lenses: [&a.lens, &b.lens],
        max_log: MAX_DEPTH_ERRORS * depth_error,
    };
    let seed = u64::from(older) << 32 | u64::from(newer);
    let (a_from_b, inliers) = gate.similarity(&pairs, seed)?;
    let spread = |pixel: &dyn Fn(&Pair) -> DVec2, lens: &Intrinsics| {
        let longest = f64::from(lens.width_px.max(lens.height_px));
        spread(inliers.iter().map(|&i| pixel(&pairs[i]))) / longest
    };
    let least = spread(&|p| p.pixel_a, &a.lens).min(spread(&|p| p.pixel_b, &b.lens));
    let is_good = inliers.len() >= MIN_INLIERS
        && inliers.len() as f64 >= MIN_SHARE * pairs.len() as f64
        && least >= MIN_SPREAD
        && surface_fits(b.view, a.view, &a_from_b, gate.max_log)
        && surface_fits(a.view, b.view, &a_from_b.inverse(), gate.max_log);
    is_good.then_some(PairSimilarity {
        older,
        newer,
        older_from_newer: a_from_b,
        n: inliers.len(),
    })
}

struct Gate<'a> {
    lenses: [&'a Intrinsics; 2],
    max_log: f64,
}

impl Gate<'_> {
    fn similarity(&self, pairs: &[Pair], seed: u64) -> Option<(Similarity, Vec<usize>)> {
        let points = |i: usize| (pairs[i].a, pairs[i].b);
        let models = |sample: [usize; 3]| similarity::of_points(&sample.map(points));
        let loss = |found: &Similarity, _| {
            Some((pairs.len() - self.find_inliers(pairs, found).len()) as f64)
        };
        let mut rng = Pcg32::seed_from_u64(seed);
        let tries = Tries::fixed(TRIES);
        let (found, _) = ransac::search(&mut rng, pairs.len(), &tries, models, loss)?;
        let inliers = self.find_inliers(pairs, &found);
        let fit = |inliers: &[usize]| {
            let picked: Vec<_> = inliers.iter().map(|&i| points(i)).collect();
            similarity::of_points(&picked)
        };
        let agree = |found: &Similarity| self.find_inliers(pairs, found);
        let best = ransac::refit((found, inliers), ROUNDS, fit, agree);
        (best.1.len() >= MIN_INLIERS).then_some(best)
    }

    fn find_inliers(&self, pairs: &[Pair], a_from_b: &Similarity) -> Vec<usize> {
        let b_from_a = a_from_b.inverse();
        let fits = |point: DVec3, wanted: DVec3, pixel: DVec2, lens: &Intrinsics| {
            let longest = f64::from(lens.width_px.max(lens.height_px));
            let limit = MAX_ERROR_PX * longest / ERROR_SIDE_PX;
            let landed = lens.project(point);
            let is_near = landed.is_some_and(|p| p.distance(pixel) <= limit);
            is_near && (point.z / wanted.z).ln().abs() <= self.max_log
        };
        let agrees = |p: &Pair| {
            fits(
                a_from_b.transform_point(p.b),
                p.a,
                p.pixel_a,
                self.lenses[0],
            ) && fits(
                b_from_a.transform_point(p.a),
                p.b,
                p.pixel_b,
                self.lenses[1],
            )
        };
        (0..pairs.len()).filter(|&i| agrees(&pairs[i])).collect()
    }
}

/// Standard deviation along the two axes of the image together.
fn spread(pixels: impl Iterator<Item = DVec2> + Clone) -> f64 {
    let n = pixels.clone().count().max(1) as f64;
    let mean = pixels.clone().sum::<DVec2>() / n;
    (pixels.map(|p| p.distance_squared(mean)).sum::<f64>() / n).sqrt()
}

/// Whether enough of the surface of `from` lies in the image of `to`, and there on its surface.
fn surface_fits(from: &View, to: &View, to_from_from: &Similarity, max_log: f64) -> bool {
    let (width, height) = (from.depth.width_px as usize, from.depth.height_px as usize);
    let lens = from
        .intrinsics
        .resized(from.depth.width_px, from.depth.height_px);
    let to_lens = to.intrinsics.resized(to.depth.width_px, to.depth.height_px);
    let (mut n_all, mut n_seen, mut n_fitting) = (0.0, 0.0, 0.0);
    for at in 0..width * height {
        let Some((depth, _)) = from.depth.verified(at) else {
            continue;
        };
        n_all += 1.0;
        let pixel = DVec2::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5);
        let point = to_from_from.transform_point(lens.ray_in_cam(pixel) * f64::from(depth));
        let Some(theirs) = to_lens
            .project(point)
            .and_then(|p| depth_near(&to.depth, p))
        else {
            continue;
        };
        n_seen += 1.0;
        if (point.z / theirs).ln().abs() <= max_log {
            n_fitting += 1.0;
        }
    }
    n_seen >= MIN_SEEN * n_all && n_seen > 0.0 && n_fitting >= MIN_FITTING * n_seen
}

fn depth_near(depth: &DepthMap, pixel: DVec2) -> Option<f64> {
    let (w, h) = (f64::from(depth.width_px), f64::from(depth.height_px));
    let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h;
    if !is_inside {
        return None;
    }
    let at = pixel.y as usize * depth.width_px as usize + pixel.x as usize;
    Some(f64::from(depth.verified(at)?.0))
}
