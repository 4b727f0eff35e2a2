//! A frame near where a guess puts it -> its pose by the points that keyframes show, each found to a fraction of a pixel.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::select::image_shift::{image_shift, small};
use crate::select::optical_flow::Pyramid;
use crate::track::map_points::PointKeyframe;
use crate::track::patches::{MapPoint, N_LEVELS};
use crate::track::pose_fit::{self, Correspondence, Fit};
use crate::working_camera::WorkingCamera;
use splat_geometry::pnp;
use splat_types::transform::Rigid;

/// Points that a frame is aligned with.
const MAX_POINTS: usize = 240;
/// Cells along the longer side of the frame, and points in each.
const N_CELLS: f64 = 20.0;
const MAX_IN_CELL: usize = 2;
/// Standard deviation of where a patch is found, and of its depth.
const PATCH_STD_PX: f64 = 0.4;
const DEPTH_STD: f64 = 0.005;
/// A search looks within this share of the longer side, for so many points at least, whose errors are at most this share.
const SEARCH_SHARE: f64 = 0.1;
const MIN_SEARCHED: usize = 12;
/// So many need no other keyframe.
const ENOUGH_SEARCHED: usize = 30;
const MAX_ERROR: f64 = 4.0 / 640.0;
/// Where the first pose has moved the points by more, they are looked for again from there.
const MOVED_PX: f64 = 1.0;

/// A point that agrees with the pose of a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AlignedPoint {
    pub(crate) id: u32,
    pub(crate) point_in_world: DVec3,
    /// Where a pinhole shows it.
    pub(crate) pixel: DVec2,
}

/// A pose by alignment.
#[derive(Debug, Clone)]
pub(crate) struct AlignedFrame {
    pub(crate) fit: Fit,
    /// Those that agree.
    pub(crate) points: Vec<AlignedPoint>,
    /// Points that were looked for.
    pub(crate) n_asked: usize,
    /// The keyframe that most of the inliers are of.
    pub(crate) reference: u32,
}

/// The frame, and its camera.
pub(crate) struct AlignmentFrame<'a> {
    pub(crate) pyramid: &'a Pyramid,
    pub(crate) camera: WorkingCamera,
}

impl AlignmentFrame<'_> {
    /// By the points of keyframes, of the first ones first. `None` where too few points are found to say.
    pub(crate) fn align(
        &self,
        keyframes: &[&PointKeyframe],
        guess: &Rigid,
    ) -> Option<AlignedFrame> {
        let first = self.fit(keyframes, guess, N_LEVELS - 1)?;
        if self.moved(&first, guess) < MOVED_PX {
            return Some(first);
        }
        self.fit(keyframes, &first.fit.cam_from_world, 1)
    }

    /// The pose of a frame whose camera stands near one of the keyframes, wherever that may be: by points that are looked for about
    /// where the keyframe has them, if all has moved as the image as a whole, or not at all.
    pub(crate) fn search(&self, keyframes: &[&PointKeyframe], seed: u64) -> Option<Rigid> {
        let pinhole = &self.camera.pinhole;
        let size = DVec2::new(f64::from(pinhole.width_px), f64::from(pinhole.height_px));
        let own = small(self.pyramid.coarsest());
        let mut best = None;
        for held in keyframes {
            let shift = image_shift(&held.small, &own);
            let shifts = shift.map(|shift| DVec2::from(shift) * size);
            for shift in shifts.into_iter().chain([DVec2::ZERO]) {
                let placement = self.place(held, shift, seed);
                let n = |placement: &pnp::Placement| placement.inliers.len();
                if placement
                    .as_ref()
                    .is_some_and(|placement| n(placement) >= ENOUGH_SEARCHED)
                {
                    return placement.map(|placement| placement.cam_from_world);
                }
                best = best.into_iter().chain(placement).max_by_key(n);
            }
        }
        best.map(|placement| placement.cam_from_world)
    }

    /// By the points of one keyframe, looked for about where that has them, plus a shift.
    fn place(&self, held: &PointKeyframe, shift: DVec2, seed: u64) -> Option<pnp::Placement> {
        let pinhole = &self.camera.pinhole;
        let longest = f64::from(pinhole.width_px.max(pinhole.height_px));
        let halved = f64::from(1_u32 << (self.pyramid.n_levels().min(N_LEVELS) - 1));
        let reach_px = (SEARCH_SHARE * longest / halved).ceil() as usize;
        let looked = held.points.par_iter().map(|point| {
            let pixel = point.look_for((self.pyramid, &self.camera), shift, reach_px)?;
            Some((held.point_in_world(point), pixel))
        });
        let looked: Vec<Option<(DVec3, DVec2)>> = looked.collect();
        let (points, pixels): (Vec<_>, Vec<_>) = looked.into_iter().flatten().unzip();
        let limits = (MAX_ERROR * longest, MIN_SEARCHED);
        pnp::place(&points, &pixels, pinhole, limits, seed)
    }

    fn fit(
        &self,
        keyframes: &[&PointKeyframe],
        guess: &Rigid,
        coarsest: usize,
    ) -> Option<AlignedFrame> {
        let chosen = self.chosen(keyframes, guess);
        let found = chosen.par_iter().map(|(held, point)| {
            let cam_from_key = *guess * held.world_from_cam;
            let warp = point.warp(&cam_from_key, [&held.camera.pinhole, &self.camera.pinhole])?;
            let pixel = point.align(&warp, (self.pyramid, &self.camera), coarsest)?;
            Some((*held, *point, pixel))
        });
        let found: Vec<Option<(&PointKeyframe, &MapPoint, DVec2)>> = found.collect();
        let found: Vec<(&PointKeyframe, &MapPoint, DVec2)> = found.into_iter().flatten().collect();
        let observation =
            |(held, point, pixel): &(&PointKeyframe, &MapPoint, DVec2)| Correspondence {
                point_in_world: held.point_in_world(point),
                depth_std_in_world: held.world_from_cam.rotation * point.point_in_key * DEPTH_STD,
                pixel: *pixel,
                std_px: PATCH_STD_PX,
            };
        let observations: Vec<Correspondence> = found.iter().map(observation).collect();
        let fit = pose_fit::fit(&observations, &self.camera.pinhole, guess)?;
        let mut counts = BTreeMap::new();
        for ix in &fit.inliers {
            *counts.entry(found[*ix].0.id).or_insert(0_usize) += 1;
        }
        let (reference, _) = counts.into_iter().max_by_key(|(id, n)| (*n, *id))?;
        let aligned = |ix: &usize| AlignedPoint {
            id: found[*ix].1.id,
            point_in_world: observations[*ix].point_in_world,
            pixel: observations[*ix].pixel,
        };
        Some(AlignedFrame {
            points: fit.inliers.iter().map(aligned).collect(),
            fit,
            n_asked: chosen.len(),
            reference,
        })
    }

    /// Points to look for, spread over the frame, each once.
    fn chosen<'m>(
        &self,
        keyframes: &[&'m PointKeyframe],
        guess: &Rigid,
    ) -> Vec<(&'m PointKeyframe, &'m MapPoint)> {
        let pinhole = &self.camera.pinhole;
        let cell_px = f64::from(pinhole.width_px.max(pinhole.height_px)) / N_CELLS;
        let mut known = BTreeSet::new();
        let mut cells: BTreeMap<[u32; 2], usize> = BTreeMap::new();
        let mut chosen = Vec::new();
        for held in keyframes {
            let cam_from_key = *guess * held.world_from_cam;
            for point in &held.points {
                if chosen.len() >= MAX_POINTS {
                    return chosen;
                }
                let Some(warp) = point.warp(&cam_from_key, [&held.camera.pinhole, pinhole]) else {
                    continue;
                };
                let cell = (warp.at / cell_px).as_uvec2().to_array();
                let n_in_cell = cells.entry(cell).or_default();
                if *n_in_cell < MAX_IN_CELL && known.insert(point.id) {
                    *n_in_cell += 1;
                    chosen.push((*held, point));
                }
            }
        }
        chosen
    }

    /// Median distance in the frame between where a guess and the pose put the points.
    fn moved(&self, aligned: &AlignedFrame, guess: &Rigid) -> f64 {
        let at = |pose: &Rigid, p: DVec3| self.camera.pinhole.project(pose.transform_point(p));
        let moved = aligned.points.iter().filter_map(|point| {
            let before = at(guess, point.point_in_world)?;
            let after = at(&aligned.fit.cam_from_world, point.point_in_world)?;
            Some(before.distance(after))
        });
        let mut moved: Vec<f64> = moved.collect();
        splat_geometry::stats::median(&mut moved).unwrap_or(f64::INFINITY)
    }
}
