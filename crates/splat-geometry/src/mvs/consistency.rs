//! Raw depth of several views -> depth that the views agree on.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::mvs::guided_filter::is_near_rim;
use crate::mvs::params::MvsParams;
use crate::mvs::view::RawDepth;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// How close two views must come to agree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// There and back again must land this close to the start, in pixels of the depth map.
    pub return_px: f64,
    /// And at this depth, relative.
    pub depth: f64,
}

/// Of matched depth.
const STEREO: Tolerance = Tolerance {
    return_px: 1.5,
    depth: 0.02,
};
/// Four depths this far apart (relative) lie on different surfaces: no value between them.
const SURFACE_GAP: f32 = 0.03;
/// Views from nearly the same place agree on any depth.
const MIN_ANGLE_RAD: f64 = 0.008;

pub(crate) fn verify(
    reference: (Rigid, &RawDepth),
    others: &[(Rigid, &RawDepth)],
    params: &MvsParams,
) -> DepthMap {
    let (submap_from_cam, raw) = reference;
    let (width, height) = (
        raw.intrinsics.width_px as usize,
        raw.intrinsics.height_px as usize,
    );
    let n_pixels = width * height;
    let mut map = DepthMap {
        width_px: raw.intrinsics.width_px,
        height_px: raw.intrinsics.height_px,
        depth: raw.depth.clone(),
        confidence: vec![0.0; n_pixels],
    };
    let others: Vec<Other<'_>> = others
        .iter()
        .filter_map(|(pose, other)| Other::new(&submap_from_cam, pose, other))
        .collect();
    if !submap_from_cam.is_finite()
        || !raw.intrinsics.is_plausible()
        || others.len() < params.min_views
    {
        return map;
    }
    let rows = map
        .depth
        .par_chunks_mut(width)
        .zip(map.confidence.par_chunks_mut(width));
    rows.enumerate().for_each(|(y, (depths, confidences))| {
        for x in 0..width {
            if depths[x] <= 0.0 || is_near_rim(&raw.depth, (width, height), x, y) {
                continue;
            }
            let pixel = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let agreement = agreement(&raw.intrinsics, pixel, f64::from(depths[x]), &others);
            if agreement.n >= params.min_views {
                depths[x] = agreement.depth as f32;
                confidences[x] = confidence(
                    agreement.n,
                    raw.score[y * width + x],
                    raw.margin[y * width + x],
                );
            }
        }
    });
    map
}

/// More views, a better match and a clearer minimum all count; never 0 for a verified depth.
fn confidence(n_views: usize, score: f32, margin: f32) -> f32 {
    let views = n_views as f32 / (n_views as f32 + 1.0);
    (views * score.clamp(0.05, 1.0) * (0.5 + 0.5 * margin.clamp(0.0, 1.0).sqrt())).clamp(1e-3, 1.0)
}

/// Another view's depth and the way there and back.
struct Other<'a> {
    raw: &'a RawDepth,
    rotation: DMat3,
    translation: DVec3,
    /// Of the other camera, in this one.
    centre: DVec3,
}

impl<'a> Other<'a> {
    fn new(submap_from_cam: &Rigid, submap_from_other: &Rigid, raw: &'a RawDepth) -> Option<Self> {
        let other_from_cam = submap_from_other.inverse() * *submap_from_cam;
        let usable = other_from_cam.is_finite() && raw.intrinsics.is_plausible();
        usable.then(|| Self {
            raw,
            rotation: other_from_cam.rotation_matrix(),
            translation: other_from_cam.translation,
            centre: other_from_cam.inverse().translation,
        })
    }
}

struct Agreement {
    n: usize,
    /// Mean of the view's own depth and of those that agree with it.
    depth: f64,
}

fn agreement(
    intrinsics: &Intrinsics,
    pixel: glam::DVec2,
    depth: f64,
    others: &[Other<'_>],
) -> Agreement {
    let (mut n, mut sum) = (0, depth);
    let point = intrinsics.ray_in_cam(pixel) * depth;
    for other in others {
        if let Verdict::Agrees(back) = other.verdict(intrinsics, pixel, point, STEREO) {
            n += 1;
            sum += back;
        }
    }
    Agreement {
        n,
        depth: sum / (n + 1) as f64,
    }
}

/// What another view says of a depth.
enum Verdict {
    /// And has it at this depth itself.
    Agrees(f64),
    /// It sees through the point.
    Contradicts,
    /// The point is hidden from it, or outside its image.
    Silent,
}

impl Other<'_> {
    /// Of the point in the camera of `intrinsics` that `pixel` shows.
    fn verdict(
        &self,
        intrinsics: &Intrinsics,
        pixel: glam::DVec2,
        point: DVec3,
        tolerance: Tolerance,
    ) -> Verdict {
        if self.translation.length_squared() < (MIN_ANGLE_RAD * point.z).powi(2) {
            return Verdict::Silent;
        }
        let in_other = self.rotation * point + self.translation;
        let Some(at) = self.raw.intrinsics.project(in_other) else {
            return Verdict::Silent;
        };
        let Some(found) = depth_at(self.raw, at) else {
            return Verdict::Silent;
        };
        // What the other sees lies on its ray through the point.
        let found = f64::from(found);
        let back = point + (point - self.centre) * (found / in_other.z - 1.0);
        let lands_near = || {
            intrinsics.project(back).is_some_and(|landed| {
                (landed - pixel).length_squared() < tolerance.return_px.powi(2)
            })
        };
        if (back.z - point.z).abs() < tolerance.depth * point.z && lands_near() {
            return Verdict::Agrees(back.z);
        }
        if found > in_other.z * (1.0 + tolerance.depth) {
            return Verdict::Contradicts;
        }
        Verdict::Silent
    }
}

/// For each pixel how many of the others agree with its depth, and how many see through it.
pub(crate) fn votes(
    reference: (Rigid, &RawDepth),
    others: &[(Rigid, &RawDepth)],
    tolerance: Tolerance,
) -> Vec<[u8; 2]> {
    let (submap_from_cam, raw) = reference;
    let width = raw.intrinsics.width_px as usize;
    let others: Vec<Other<'_>> = others
        .iter()
        .filter_map(|(pose, other)| Other::new(&submap_from_cam, pose, other))
        .collect();
    let vote = |(at, depth): (usize, &f32)| {
        let mut counts = [0_u8; 2];
        if *depth > 0.0 && depth.is_finite() {
            let pixel = glam::DVec2::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5);
            let point = raw.intrinsics.ray_in_cam(pixel) * f64::from(*depth);
            for other in &others {
                match other.verdict(&raw.intrinsics, pixel, point, tolerance) {
                    Verdict::Agrees(_) => counts[0] = counts[0].saturating_add(1),
                    Verdict::Contradicts => counts[1] = counts[1].saturating_add(1),
                    Verdict::Silent => {}
                }
            }
        }
        counts
    };
    raw.depth.par_iter().enumerate().map(vote).collect()
}

/// Depth between the four nearest pixels where they lie on one surface, else of the nearest pixel.
fn depth_at(raw: &RawDepth, pixel: glam::DVec2) -> Option<f32> {
    let (width, height) = (
        raw.intrinsics.width_px as usize,
        raw.intrinsics.height_px as usize,
    );
    if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width as f64 && pixel.y < height as f64) {
        return None;
    }
    let nearest = raw.depth[pixel.y as usize * width + pixel.x as usize];
    let (u, v) = ((pixel.x - 0.5).max(0.0), (pixel.y - 0.5).max(0.0));
    let (x, y) = ((u as usize).min(width - 2), (v as usize).min(height - 2));
    let (share_x, share_y) = (
        (u - x as f64).min(1.0) as f32,
        (v - y as f64).min(1.0) as f32,
    );
    let at = y * width + x;
    let four = [
        raw.depth[at],
        raw.depth[at + 1],
        raw.depth[at + width],
        raw.depth[at + width + 1],
    ];
    let lowest = four.iter().copied().fold(f32::INFINITY, f32::min);
    let highest = four.iter().copied().fold(0.0, f32::max);
    if lowest <= 0.0 || highest > lowest * (1.0 + SURFACE_GAP) {
        return (nearest > 0.0).then_some(nearest);
    }
    // A plane in space is linear in inverse depth over the image, not in depth.
    let [a, b, c, d] = four.map(f32::recip);
    let above = a + (b - a) * share_x;
    let below = c + (d - c) * share_x;
    Some((above + (below - above) * share_y).recip())
}
