//! Depth by a sensor, or the image of a second camera -> the distance of each feature of a view.

use glam::{DVec2, DVec3};

use crate::answer::MetricUnit;
use crate::features::descriptor::Features;
use crate::matching::{PreparedDescriptors, matches};
use crate::optim::bundle::problem::MeasuredDepth;
use crate::two_view::triangulate::{Observation, triangulate};
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::snapshot::ScaleSource;
use splat_types::transform::Rigid;

/// Standard deviation of a feature's place in the working image, which measured depth is weighed against.
const FEATURE_PX: f64 = 0.5;
/// Nothing is read where depth jumps by this share within a pixel: sensors smear depth over edges.
const MAX_JUMP: f32 = 0.04;
/// Features have no depth where it changes by such a share within a distance that is a share of the longer side.
const EDGE_JUMP: f32 = 0.1;
const EDGE_SHARE: f64 = 0.008;
/// Measured depth of such a standard deviation, as a share of itself, has full confidence.
const SURE: f64 = 0.01;
/// Standard deviation of the metre by either, as a share: kitchen7s_rgbd is 0.6 % off, kitti_vo1_stereo 0.8 %, euroc_mh01 0.6 %.
const UNIT_ERROR: f64 = 0.01;
/// What depth cameras are off by in common, as a share: errors of their calibration, and of where depth lies in the colour image.
/// It does not average out, so that it must not outweigh what parallax shows: kitchen7s_rgbd with 0 turns by 1.3 deg, with this
/// by 0.3.
const DEPTH_CAMERA_ERROR: f64 = 0.03;
/// The same of stereo pairs.
const PAIR_ERROR: f64 = 0.01;
/// Matches of a pair that are farther off the line on which the partner must lie are wrong, in pixels.
const MAX_OFF_LINE_PX: f64 = 1.5;
/// Disparities below say that a point is far, but not how far, in pixels.
const MIN_DISPARITY_PX: f64 = 1.0;

/// Measured distances of the features of a view.
#[derive(Debug, Clone)]
pub(crate) struct FeatureDepths {
    /// 1/m; 0: not measured.
    pub(crate) inverse: Vec<f32>,
    /// Standard deviation of all, 1/m.
    pub(crate) sigma_inverse: f64,
    /// Error that all distances may have in common, as a share of them.
    pub(crate) common_error: f64,
    pub(crate) source: ScaleSource,
}

/// The features of one camera of a pair.
pub(crate) struct OfCamera<'a> {
    pub(crate) features: &'a Features,
    /// Of the image that they were found in.
    pub(crate) lens: Intrinsics,
}

impl FeatureDepths {
    /// Of features at pixels of an image of `size`, by a map of the same view. `None` where nothing was measured.
    pub(crate) fn new(
        pixels: &[DVec2],
        size: (u32, u32),
        map: &DepthMap,
        sigma_inverse: f64,
    ) -> Option<Self> {
        let scale = DVec2::new(
            f64::from(map.width_px) / f64::from(size.0),
            f64::from(map.height_px) / f64::from(size.1),
        );
        let inverse = |pixel: &DVec2| {
            let place = *pixel * scale;
            let depth = smooth_depth(map, place).filter(|depth| !is_near_edge(map, place, *depth));
            depth.map_or(0.0, f32::recip)
        };
        let inverse: Vec<f32> = pixels.iter().map(inverse).collect();
        let is_any = inverse.iter().any(|value| *value > 0.0);
        (is_any && sigma_inverse > 0.0).then_some(Self {
            inverse,
            sigma_inverse,
            common_error: DEPTH_CAMERA_ERROR,
            source: ScaleSource::Depth,
        })
    }

    /// By matching the features of both cameras of a pair: those whose rays meet before both, along the line that the partner must
    /// lie on. `None` where no match has a distance.
    pub(crate) fn of_pair(
        first: &OfCamera<'_>,
        second: &OfCamera<'_>,
        second_from_first: &Rigid,
    ) -> Option<Self> {
        let prepared = [first, second].map(|of| PreparedDescriptors::new(&of.features.descriptors));
        let mut inverse = vec![0.0; first.features.len()];
        for (a, b) in matches(&prepared[0], &prepared[1]) {
            let rays = [(first, a), (second, b)].map(|(of, ix)| Observation {
                cam_from_world: if std::ptr::eq(of, first) {
                    &Rigid::IDENTITY
                } else {
                    second_from_first
                },
                intrinsics: &of.lens,
                pixel: of.features.pixels[ix as usize],
            });
            let fits = |point: &DVec3| {
                rays.iter()
                    .all(|ray| ray.error_px(*point) <= MAX_OFF_LINE_PX)
            };
            if let Some(point) = triangulate(&rays).filter(fits) {
                inverse[a as usize] = (1.0 / point.z) as f32;
            }
        }
        let baseline = second_from_first.translation.length();
        let px_per_inverse = baseline * first.lens.fx;
        let least = (MIN_DISPARITY_PX / px_per_inverse) as f32;
        inverse.iter_mut().for_each(|value| {
            if *value < least {
                *value = 0.0;
            }
        });
        let is_any = inverse.iter().any(|value| *value > 0.0);
        is_any.then_some(Self {
            inverse,
            sigma_inverse: 2.0_f64.sqrt() * FEATURE_PX / px_per_inverse,
            common_error: PAIR_ERROR,
            source: ScaleSource::Stereo,
        })
    }

    /// The unit of a submap by these.
    pub(crate) fn unit(&self) -> MetricUnit {
        MetricUnit {
            source: self.source,
            relative_std: UNIT_ERROR,
        }
    }

    pub(crate) fn of(&self, feature: usize) -> Option<MeasuredDepth> {
        let inverse = f64::from(*self.inverse.get(feature)?);
        let sigma = self.sigma_inverse.hypot(self.common_error * inverse);
        (inverse > 0.0).then_some(MeasuredDepth {
            inverse,
            px_per_inverse: FEATURE_PX / sigma,
        })
    }
}

/// Puts measured depth into a map of the same view where that has none, but not beside jumps, where sensors smear.
pub(crate) fn fill_measured(map: &mut DepthMap, measured: &DepthMap, sigma_inverse: f64) {
    let scale = DVec2::new(
        f64::from(measured.width_px) / f64::from(map.width_px.max(1)),
        f64::from(measured.height_px) / f64::from(map.height_px.max(1)),
    );
    let places = (0..map.height_px).flat_map(|y| (0..map.width_px).map(move |x| (x, y)));
    for (at, (x, y)) in places.enumerate() {
        let place = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * scale;
        if map.confidence[at] > 0.0 {
            continue;
        }
        if let Some(depth) = smooth_depth(measured, place) {
            let share = sigma_inverse * f64::from(depth);
            map.depth[at] = depth;
            map.confidence[at] = (SURE / share.max(SURE)) as f32;
        }
    }
}

/// Whether depth jumps, or ends, within some pixels: features like to lie on edges, where it is a matter of chance which side
/// depth is of.
fn is_near_edge(map: &DepthMap, place: DVec2, depth: f32) -> bool {
    let away = f64::from(map.width_px.max(map.height_px)) * EDGE_SHARE;
    let differs = |k: u32| {
        let turn = f64::from(k) * std::f64::consts::FRAC_PI_4;
        let at = map.pixel_at(place + away * DVec2::new(turn.cos(), turn.sin()));
        let other = at.and_then(|at| map.verified(at));
        other.is_none_or(|(other, _)| (other / depth).max(depth / other) > 1.0 + EDGE_JUMP)
    };
    (0..8).any(differs)
}

/// Median of the 3x3 pixels about a place of the map; `None` beside a jump and where less than half of them have depth.
fn smooth_depth(map: &DepthMap, place: DVec2) -> Option<f32> {
    let (width, height) = (map.width_px as usize, map.height_px as usize);
    let at = map.pixel_at(place)?;
    let (x, y) = (at % width, at / width);
    let mut near = [0.0_f32; 9];
    let mut n = 0;
    for v in y.saturating_sub(1)..(y + 2).min(height) {
        for u in x.saturating_sub(1)..(x + 2).min(width) {
            if let Some((depth, _)) = map.verified(v * width + u) {
                near[n] = depth;
                n += 1;
            }
        }
    }
    let near = &mut near[..n];
    near.sort_by(f32::total_cmp);
    let (least, most) = (*near.first()?, *near.last()?);
    (n >= 5 && most - least <= MAX_JUMP * least).then(|| near[n / 2])
}
