//! All keyframes of a submap -> poses that agree as a whole: what windows drift by is found where their images
//! see the same surface again.
//!
//! Windows are corrected with a few neighbours held, so that small errors add up along the way. This keeps of each
//! keyframe its features, their depth and its pose, and adjusts them all (`geometry::bundle`) now and then.

use std::collections::{BTreeMap, BTreeSet};

use crate::alignment::depths::Depths;
use crate::alignment::inlier_tracks::{InlierTracks, find_inliers};
use crate::alignment::kept_views::KeptView;
use crate::alignment::loops::Loops;
use crate::alignment::matched::{
    InitialPoses, MAX_POINT_ERROR_PX, Matched, WindowView, longest_px, unit, write_back,
};
use crate::alignment::matches::Matcher;
use crate::alignment::params::AlignParams;
use crate::alignment::rescale_depth;
use crate::alignment::tracks::{Track, covering_tracks, points};
use crate::answer::{PoseUpdate, View};
use crate::optim::bundle::adjust;
use crate::optim::bundle::problem::{Camera, Observation, Problem, Settings};
use crate::stats::median;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::transform::Rigid;

/// Side of the grid of depths that is kept of a view.
const GRID: usize = 24;
/// Points that each view should have.
pub(crate) const TRACKS_PER_VIEW: usize = 200;
/// Observations below which a view moves as its neighbour does.
const MIN_OBSERVATIONS: usize = 12;
/// Views below which windows say all there is.
const MIN_VIEWS: usize = 4;
/// Corrected again when a submap has grown by this share, and by so many.
const GROWTH: f64 = 1.0 / 3.0;
const MIN_GROWTH: usize = 6;
/// From rough to fine: observations agree up to so many px (of an image of 640), Cauchy's loss bends at this share of it, for so
/// many steps.
const ROUNDS: [(f64, usize); 3] = [(24.0, 12), (8.0, 12), (MAX_POINT_ERROR_PX, 20)];
const LOSS_SHARE: f64 = 0.25;
/// What holds a pose where nothing else does: standard deviations as a share of the median depth, and in radians.
/// Also the frame and unit of the whole.
const PLACE_PRIOR: f64 = 0.05;
const TURN_PRIOR: f64 = 0.035;
/// Where keyframes had to be forgotten, the oldest of those left are held, one in so many: the map behind stays.
const HELD_SHARE: usize = 8;

/// What is remembered of the keyframes of all submaps.
#[derive(Debug, Clone, Default)]
pub(crate) struct GlobalBa {
    /// With a grid of depths each, and the depth of each feature.
    pub(crate) views: KeptView,
    /// By submap: keyframes that came so far, and those that had come before the last correction.
    pub(crate) n_added: BTreeMap<u32, usize>,
    pub(crate) n_corrected: BTreeMap<u32, usize>,
    pub(crate) loops: Loops,
    /// Ends of links that hold.
    pub(crate) closed: BTreeSet<(u32, u32)>,
    /// Submap of which keyframes were forgotten.
    cut: Option<u32>,
    is_uncalibrated: bool,
}

/// What a correction of a whole submap found.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct SubmapCorrection {
    /// Every keyframe of the submap.
    pub(crate) revised: Vec<PoseUpdate>,
    /// A submap that is gone, and the one that its keyframes belong to since.
    pub(crate) merged: Option<(u32, u32)>,
    /// A place was seen again.
    pub(crate) is_loop: bool,
}

impl GlobalBa {
    /// Remembers new keyframes in their running frame, at most `max` in all.
    pub(crate) fn add(
        &mut self,
        views: &[View],
        matcher: &Matcher,
        given: InitialPoses,
        max: usize,
    ) {
        for view in views {
            let depths = matcher.depths(view);
            let thumbnail = View {
                depth: thumbnail(&view.depth),
                ..view.clone()
            };
            self.views.insert(view.keyframe_id, (thumbnail, depths));
            *self.n_added.entry(view.submap).or_default() += 1;
        }
        self.is_uncalibrated |= !given.is_calibrated;
        while self.views.len() > max {
            self.cut = self.views.pop_first().map(|(_, (view, _))| view.submap);
        }
        if let Some((oldest, _)) = self.views.first_key_value() {
            self.loops.forget_before(*oldest);
            self.closed.retain(|(older, _)| older >= oldest);
        }
    }

    /// Whether so much is new that a submap should be corrected.
    pub(crate) fn is_due(&self, submap: u32) -> bool {
        let enough = (self.n_of(submap) as f64 * GROWTH / (1.0 + GROWTH)) as usize;
        self.n_new(submap) >= MIN_GROWTH.max(enough)
    }

    /// Submaps in which anything is new.
    pub(crate) fn changed(&self) -> Vec<u32> {
        let mut submaps: Vec<u32> = self.views.values().map(|(v, _)| v.submap).collect();
        submaps.sort_unstable();
        submaps.dedup();
        submaps.retain(|&c| self.n_new(c) > 0);
        submaps
    }

    /// Moves all keyframes of a submap so that their matches fit; `None` where nothing better was found.
    pub(crate) fn correct(
        &mut self,
        submap: u32,
        matcher: &mut Matcher,
        params: &AlignParams,
    ) -> Option<SubmapCorrection> {
        let (mut views, depths): (Vec<View>, Depths) = self
            .views
            .values()
            .filter(|(v, _)| v.submap == submap)
            .cloned()
            .unzip();
        let n_added = self.n_added.get(&submap).copied().unwrap_or(0);
        self.n_corrected.insert(submap, n_added);
        if views.len() < MIN_VIEWS {
            return None;
        }
        let given = InitialPoses {
            n_held: self.n_held(submap, views.len()),
            is_calibrated: !self.is_uncalibrated,
        };
        let mut matched = matcher.matched_anew(&views, params);
        let tracks = covering_tracks(&matched, TRACKS_PER_VIEW);
        let limit = MAX_POINT_ERROR_PX * longest_px(&matched) / 640.0;
        let before = score(&matched, &tracks, &depths, params.depth_error);
        adjust_all(
            &views,
            &mut matched,
            (&tracks, &depths),
            params.depth_error,
            given,
        );
        let after = score(&matched, &tracks, &depths, params.depth_error);
        tracing::debug!(
            submap,
            n = views.len(),
            n_tracks = tracks.len(),
            before,
            after,
            "whole"
        );
        if after <= before {
            return None;
        }
        write_back(&mut views, &matched);
        let points = points(&matched, &tracks, limit);
        let factors = rescale_depth::depth(&mut views, &matched, &points, given.n_held);
        let mut correction = SubmapCorrection::default();
        for ((view, factor), mut depths) in views.into_iter().zip(factors).zip(depths) {
            correction.revised.push(revision(&view, factor));
            depths.iter_mut().flatten().for_each(|d| *d *= factor);
            self.views.insert(view.keyframe_id, (view, depths));
        }
        Some(correction)
    }

    /// Where keyframes had to be forgotten, the oldest of the `n` left stay where they are.
    pub(crate) fn n_held(&self, submap: u32, n: usize) -> usize {
        if self.cut == Some(submap) {
            n / HELD_SHARE
        } else {
            0
        }
    }

    fn n_of(&self, submap: u32) -> usize {
        let own = self.views.values().filter(|(v, _)| v.submap == submap);
        own.count()
    }

    /// Keyframes that came since the last correction.
    fn n_new(&self, submap: u32) -> usize {
        let count = |counts: &BTreeMap<u32, usize>| counts.get(&submap).copied().unwrap_or(0);
        count(&self.n_added) - count(&self.n_corrected)
    }
}

pub(crate) fn revision(view: &View, depth_factor: f64) -> PoseUpdate {
    PoseUpdate {
        keyframe_id: view.keyframe_id,
        submap: view.submap,
        intrinsics: view.intrinsics,
        submap_from_cam: view.submap_from_cam,
        depth_factor,
    }
}

/// How well the observations of all tracks agree.
pub(crate) fn score(matched: &Matched, tracks: &[Track], depths: &Depths, depth_error: f64) -> f64 {
    let limit = MAX_POINT_ERROR_PX * longest_px(matched) / 640.0;
    let found = find_inliers(matched, tracks, depths, (limit, depth_error));
    found.iter().map(|a| a.score).sum()
}

/// Bundle adjustment of all views over the observations that agree with the poses so far, again and again.
fn adjust_all(
    views: &[View],
    matched: &mut Matched,
    (tracks, depths): (&[Track], &Depths),
    depth_error: f64,
    given: InitialPoses,
) {
    let hold = hold(unit(views));
    if !given.is_calibrated {
        share_focal(matched);
    }
    for (limit, max_steps) in ROUNDS {
        let limit = limit * longest_px(matched) / 640.0;
        let inliers = find_inliers(matched, tracks, depths, (limit, depth_error));
        let settings = Settings {
            max_steps,
            loss_px: LOSS_SHARE * limit,
            refine_focal: !given.is_calibrated,
            refine_radial: false,
        };
        let mut problem = problem(matched, &inliers, hold, given);
        adjust(&mut problem, &settings);
        let mut poses = problem.cameras.iter().map(|c| &c.cam_from_world);
        if !poses.all(Rigid::is_finite) {
            return;
        }
        let mut n_observations = vec![0; views.len()];
        for &(view, _) in inliers.iter().flat_map(|a| &a.track) {
            n_observations[view] += 1;
        }
        take_over(matched, &problem.cameras, &n_observations);
    }
}

/// Each window has estimated the focal length of the one camera anew: all get the median, and adjustment moves it for all.
fn share_focal(matched: &mut Matched) {
    let focal = |axis: fn(&Intrinsics) -> f64| {
        let mut all: Vec<f64> = matched.views.iter().map(|view| axis(&view.lens)).collect();
        median(&mut all)
    };
    let (Some(fx), Some(fy)) = (focal(|lens| lens.fx), focal(|lens| lens.fy)) else {
        return;
    };
    let size = |view: &WindowView| (view.lens.width_px, view.lens.height_px);
    let sizes: BTreeSet<(u32, u32)> = matched.views.iter().map(size).collect();
    if sizes.len() == 1 {
        for view in &mut matched.views {
            (view.lens.fx, view.lens.fy) = (fx, fy);
        }
    }
}

fn problem(
    matched: &Matched,
    inliers: &[InlierTracks],
    hold: [[f64; 6]; 6],
    given: InitialPoses,
) -> Problem {
    let mut problem = Problem::default();
    for (ix, aligned_view) in matched.views.iter().enumerate() {
        problem.cameras.push(Camera {
            cam_from_world: aligned_view.cam_from_submap,
            intrinsics: aligned_view.lens,
            radial: 0.0,
            is_fixed: ix < given.n_held,
            hold: Some(hold),
            shares_lens: !given.is_calibrated,
        });
    }
    for found in inliers {
        let seen = found.track.iter().map(|&(view, feature)| Observation {
            camera_ix: view as u32,
            pixel: matched.views[view].pixels[feature],
            depth: None,
        });
        problem.add_point(found.point, seen);
    }
    problem
}

/// Poses as adjusted; those that hardly anything was known of go where their neighbour went.
fn take_over(matched: &mut Matched, cameras: &[Camera], n_observations: &[usize]) {
    let motions: Vec<Rigid> = cameras
        .iter()
        .zip(&matched.views)
        .map(|(camera, view)| camera.cam_from_world.inverse() * view.cam_from_submap)
        .collect();
    for (ix, (view, camera)) in matched.views.iter_mut().zip(cameras).enumerate() {
        view.is_held = camera.is_fixed;
        view.lens = camera.intrinsics;
        let leader = leader(n_observations, ix);
        view.cam_from_submap = if leader == ix || view.is_held {
            camera.cam_from_world
        } else {
            (view.cam_from_submap * motions[leader].inverse()).renormalized()
        };
    }
}

/// The view itself if it sees enough, else the nearest one that does.
fn leader(n_observations: &[usize], ix: usize) -> usize {
    let sees = |&i: &usize| n_observations[i] >= MIN_OBSERVATIONS;
    (0..n_observations.len())
        .filter(sees)
        .min_by_key(|i| i.abs_diff(ix))
        .unwrap_or(ix)
}

fn hold(unit: f64) -> [[f64; 6]; 6] {
    let mut hold = [[0.0; 6]; 6];
    for (i, row) in hold.iter_mut().enumerate() {
        let std = if i < 3 {
            PLACE_PRIOR * unit
        } else {
            TURN_PRIOR
        };
        row[i] = std.powi(-2);
    }
    hold
}

fn thumbnail(depth: &DepthMap) -> DepthMap {
    let side = |n: u32| n.min(GRID as u32);
    depth.subsampled(side(depth.width_px), side(depth.height_px))
}
