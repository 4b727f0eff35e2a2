//! All keyframes of a component -> poses that agree as a whole: what windows drift by is found where their pictures
//! see the same surface again.
//!
//! Windows are corrected with a few neighbours held, so that small errors add up along the way. This keeps of each
//! keyframe its features, their depth and its pose, and adjusts them all (`geometry::bundle`) now and then.

use std::collections::{BTreeMap, BTreeSet};

use super::agreeing::{Agreeing, agreeing};
use super::bundle_state::Depths;
use super::loops::{Kept, Loops};
use super::matches::Matcher;
use super::tracks::{Track, covering_tracks, points};
use super::{Given, MAX_POINT_ERROR_PX, Matched, longest_px, rescale, unit};
use crate::config::align::AlignParams;
use crate::frame::DepthMap;
use crate::geometry::bundle::{Camera, Observation, Problem, Settings, adjust};
use crate::geometry::{Revision, View};
use crate::pose::Rigid;

/// Side of the grid of depths that is kept of a view.
const GRID: usize = 24;
/// Points that each view should have.
pub(super) const TRACKS_PER_VIEW: usize = 200;
/// Sights below which a view moves as its neighbour does.
const MIN_SIGHTS: usize = 12;
/// Views below which windows say all there is.
const MIN_VIEWS: usize = 4;
/// Corrected again when a component has grown by this share, and by so many.
const GROWTH: f64 = 1.0 / 3.0;
const MIN_GROWTH: usize = 6;
/// From rough to fine: sights agree up to so many px (of a picture of 640), Cauchy's loss bends at this share of it, for so
/// many steps.
const ROUNDS: [(f64, usize); 3] = [(24.0, 12), (8.0, 12), (MAX_POINT_ERROR_PX, 20)];
const LOSS_SHARE: f64 = 0.25;
/// What holds a pose where nothing else does: standard deviations as a share of the median depth, and in radians.
/// Also the frame and unit of the whole.
const PLACE_PRIOR: f64 = 0.05;
const TURN_PRIOR: f64 = 0.035;
/// Where keyframes had to be forgotten, the oldest of those left are held, one in so many: the map behind stays.
const HELD_SHARE: usize = 8;

/// What is remembered of the keyframes of all components.
#[derive(Debug, Clone, Default)]
pub(super) struct Whole {
    /// With a grid of depths each, and the depth of each feature.
    pub(super) views: Kept,
    /// By component: keyframes that came so far, and those that had come before the last correction.
    pub(super) n_added: BTreeMap<u32, usize>,
    pub(super) n_corrected: BTreeMap<u32, usize>,
    pub(super) loops: Loops,
    /// Ends of links that hold.
    pub(super) closed: BTreeSet<(u32, u32)>,
    /// Component of which keyframes were forgotten.
    cut: Option<u32>,
    is_uncalibrated: bool,
}

/// What a correction of a whole component found.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Correction {
    /// Every keyframe of the component.
    pub(super) revised: Vec<Revision>,
    /// A component that is gone, and the one that its keyframes belong to since.
    pub(super) merged: Option<(u32, u32)>,
    /// A place was seen again.
    pub(super) is_loop: bool,
}

impl Whole {
    /// Remembers new keyframes in their running frame, at most `max` in all.
    pub(super) fn add(&mut self, views: &[View], matcher: &Matcher, given: Given, max: usize) {
        for view in views {
            let depths = matcher.depths(view);
            let thumbnail = View {
                depth: thumbnail(&view.depth),
                ..view.clone()
            };
            self.views.insert(view.keyframe_id, (thumbnail, depths));
            *self.n_added.entry(view.component).or_default() += 1;
        }
        self.is_uncalibrated |= !given.is_calibrated;
        while self.views.len() > max {
            self.cut = self.views.pop_first().map(|(_, (view, _))| view.component);
        }
        if let Some((oldest, _)) = self.views.first_key_value() {
            self.loops.forget_before(*oldest);
            self.closed.retain(|(older, _)| older >= oldest);
        }
    }

    /// Whether so much is new that a component should be corrected.
    pub(super) fn is_due(&self, component: u32) -> bool {
        let enough = (self.n_of(component) as f64 * GROWTH / (1.0 + GROWTH)) as usize;
        self.n_new(component) >= MIN_GROWTH.max(enough)
    }

    /// Components in which anything is new.
    pub(super) fn changed(&self) -> Vec<u32> {
        let mut components: Vec<u32> = self.views.values().map(|(v, _)| v.component).collect();
        components.sort_unstable();
        components.dedup();
        components.retain(|&c| self.n_new(c) > 0);
        components
    }

    /// Moves all keyframes of a component so that their matches fit; `None` where nothing better was found.
    pub(super) fn correct(
        &mut self,
        component: u32,
        matcher: &mut Matcher,
        params: &AlignParams,
    ) -> Option<Correction> {
        let (mut views, depths): (Vec<View>, Depths) = self
            .views
            .values()
            .filter(|(v, _)| v.component == component)
            .cloned()
            .unzip();
        let n_added = self.n_added.get(&component).copied().unwrap_or(0);
        self.n_corrected.insert(component, n_added);
        if views.len() < MIN_VIEWS {
            return None;
        }
        let given = Given {
            n_held: self.n_held(component, views.len()),
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
            component,
            n = views.len(),
            n_tracks = tracks.len(),
            before,
            after,
            "whole"
        );
        if after <= before {
            return None;
        }
        super::write_back(&mut views, &matched);
        let points = points(&matched, &tracks, limit);
        let factors = rescale::depth(&mut views, &matched, &points, given.n_held);
        let mut correction = Correction::default();
        for ((view, factor), mut depths) in views.into_iter().zip(factors).zip(depths) {
            correction.revised.push(revision(&view, factor));
            depths.iter_mut().flatten().for_each(|d| *d *= factor);
            self.views.insert(view.keyframe_id, (view, depths));
        }
        Some(correction)
    }

    /// Where keyframes had to be forgotten, the oldest of the `n` left stay where they are.
    pub(super) fn n_held(&self, component: u32, n: usize) -> usize {
        if self.cut == Some(component) {
            n / HELD_SHARE
        } else {
            0
        }
    }

    fn n_of(&self, component: u32) -> usize {
        let own = self
            .views
            .values()
            .filter(|(v, _)| v.component == component);
        own.count()
    }

    /// Keyframes that came since the last correction.
    fn n_new(&self, component: u32) -> usize {
        let count = |counts: &BTreeMap<u32, usize>| counts.get(&component).copied().unwrap_or(0);
        count(&self.n_added) - count(&self.n_corrected)
    }
}

pub(super) fn revision(view: &View, depth_factor: f64) -> Revision {
    Revision {
        keyframe_id: view.keyframe_id,
        component: view.component,
        intrinsics: view.intrinsics,
        batch_from_cam: view.batch_from_cam,
        depth_factor,
    }
}

/// How well the sights of all tracks agree.
pub(super) fn score(matched: &Matched, tracks: &[Track], depths: &Depths, depth_error: f64) -> f64 {
    let limit = MAX_POINT_ERROR_PX * longest_px(matched) / 640.0;
    let found = agreeing(matched, tracks, depths, (limit, depth_error));
    found.iter().map(|a| a.score).sum()
}

/// Bundle adjustment of all views over the sights that agree with the poses so far, again and again.
fn adjust_all(
    views: &[View],
    matched: &mut Matched,
    (tracks, depths): (&[Track], &Depths),
    depth_error: f64,
    given: Given,
) {
    let hold = hold(unit(views));
    for (limit, max_steps) in ROUNDS {
        let limit = limit * longest_px(matched) / 640.0;
        let agreeing = agreeing(matched, tracks, depths, (limit, depth_error));
        let settings = Settings {
            max_steps,
            loss_px: LOSS_SHARE * limit,
            refine_focal: !given.is_calibrated,
            refine_radial: false,
        };
        let mut problem = problem(matched, &agreeing, hold, given);
        adjust(&mut problem, &settings);
        let mut poses = problem.cameras.iter().map(|c| &c.cam_from_map);
        if !poses.all(Rigid::is_finite) {
            return;
        }
        let mut n_sights = vec![0; views.len()];
        for &(view, _) in agreeing.iter().flat_map(|a| &a.track) {
            n_sights[view] += 1;
        }
        take_over(matched, &problem.cameras, &n_sights);
    }
}

fn problem(matched: &Matched, agreeing: &[Agreeing], hold: [[f64; 6]; 6], given: Given) -> Problem {
    let mut problem = Problem::default();
    for (ix, shot) in matched.shots.iter().enumerate() {
        problem.cameras.push(Camera {
            cam_from_map: shot.cam_from_batch,
            intrinsics: shot.lens,
            radial: 0.0,
            is_fixed: ix < given.n_held,
            hold: Some(hold),
            shares_lens: !given.is_calibrated,
        });
    }
    for found in agreeing {
        let seen = found.track.iter().map(|&(view, feature)| Observation {
            camera_ix: view as u32,
            pixel: matched.shots[view].pixels[feature],
        });
        problem.add_point(found.point, seen);
    }
    problem
}

/// Poses as adjusted; those that hardly anything was known of go where their neighbour went.
fn take_over(matched: &mut Matched, cameras: &[Camera], n_sights: &[usize]) {
    let motions: Vec<Rigid> = cameras
        .iter()
        .zip(&matched.shots)
        .map(|(camera, shot)| camera.cam_from_map.inverse() * shot.cam_from_batch)
        .collect();
    for (ix, (shot, camera)) in matched.shots.iter_mut().zip(cameras).enumerate() {
        shot.is_held = camera.is_fixed;
        shot.lens = camera.intrinsics;
        let leader = leader(n_sights, ix);
        shot.cam_from_batch = if leader == ix || shot.is_held {
            camera.cam_from_map
        } else {
            (shot.cam_from_batch * motions[leader].inverse()).renormalized()
        };
    }
}

/// The view itself if it sees enough, else the nearest one that does.
fn leader(n_sights: &[usize], ix: usize) -> usize {
    let sees = |&i: &usize| n_sights[i] >= MIN_SIGHTS;
    (0..n_sights.len())
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
    depth.thinned(side(depth.width_px), side(depth.height_px))
}
