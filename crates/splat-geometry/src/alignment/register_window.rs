//! Windows of views, each in its own frame and unit -> one running frame, as long as they overlap and agree.
//!
//! A window that does not fit where it overlaps begins a submap of its own: it is never welded on. Keeps the last
//! few views with their depth and nothing else.

use std::collections::VecDeque;

use glam::DVec3;

use crate::alignment::global_ba::SubmapCorrection;
use crate::alignment::matched::Refined;
use crate::alignment::overlap::{Shared, by_points, by_poses, inlier_share};
use crate::alignment::params::{AlignParams, Registration};
use crate::answer::{PoseUpdate, View};
use splat_types::transform::{Rigid, Similarity};

/// Views kept besides those of `align.fixed_keyframes`: what the next window may share.
const MAX_SHARED: usize = 32;

/// Lays windows one after the other into the frame of the first.
#[derive(Debug, Clone)]
pub struct Windows {
    params: AlignParams,
    submap: u32,
    n_submaps: u32,
    /// Scale of the newest window of the submap.
    last_scale: f64,
    /// Unit of a submap's first window, in that of the running frame.
    metres_per_unit: f64,
    /// The newest views of the submap, in the running frame, the oldest first.
    kept: VecDeque<View>,
}

/// How a window was aligned to the views before it.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    pub submap_from_window: Similarity,
    /// Share of the shared surface that falls on the map's.
    pub inliers: f64,
    /// Largest angle between the orientations of a shared keyframe.
    pub turn_deg: f64,
    /// Keyframes that it rests on.
    pub keyframe_ids: Vec<u32>,
    /// Rotation and place are those of the poses, only the scale was fitted.
    pub is_scale_only: bool,
}

/// A window in the running frame of its submap.
#[derive(Debug, Clone, Default)]
pub struct Joined {
    /// New ones, and the shared ones again as they were before.
    pub views: Vec<View>,
    /// Ids of the shared ones.
    pub shared: Vec<u32>,
    /// `None` for the first window of a submap.
    pub fit: Option<Fit>,
    /// Why a submap had to begin, one plain sentence.
    pub note: Option<String>,
    /// What the correction of the window in its own frame did.
    pub refined: Refined,
    /// Every keyframe of the submap, where all of it was corrected.
    pub revised: Vec<PoseUpdate>,
    /// A place was seen again, and `revised` closes the loop.
    pub is_loop: bool,
}

impl Joined {
    pub fn is_new(&self, view: &View) -> bool {
        !self.shared.contains(&view.keyframe_id)
    }
}

impl Windows {
    pub fn new(params: &AlignParams) -> Self {
        Self {
            params: params.clone(),
            submap: 0,
            n_submaps: 0,
            last_scale: 1.0,
            metres_per_unit: 1.0,
            kept: VecDeque::new(),
        }
    }

    /// Metres that one unit of a submap's first window stands for, where something outside knows: a network that
    /// answers in metres, wheels, a second camera. Holds for submaps that begin afterwards; later windows take
    /// their scale from the ones before.
    pub fn set_metres_per_unit(&mut self, metres: f64) {
        if metres.is_finite() && metres > 0.0 {
            self.metres_per_unit = metres;
        }
    }

    /// A window's views in its own frame -> in the running frame. Views that share a keyframe id with the ones before
    /// report how.
    pub fn join(&mut self, mut window: Vec<View>) -> Joined {
        let lost = drop_broken(&mut window);
        if window.is_empty() {
            return Joined {
                note: lost,
                ..Joined::default()
            };
        }
        let mut joined = match self.fit(&window) {
            Ok(fit) => self.extend(window, fit),
            Err(reason) => self.begin(window, reason),
        };
        joined.note = joined.note.or(lost);
        joined
    }

    /// The newest `n` views that were there before a window was joined; none where it began a submap.
    pub fn before(&self, joined: &Joined, n: usize) -> Vec<View> {
        if joined.fit.is_none() {
            return Vec::new();
        }
        let is_new = |view: &View| {
            let same = |v: &View| v.keyframe_id == view.keyframe_id;
            joined.views.iter().any(|v| same(v) && joined.is_new(v))
        };
        let old: Vec<View> = self.kept.iter().filter(|v| !is_new(v)).cloned().collect();
        old[old.len().saturating_sub(n)..].to_vec()
    }

    /// Takes over better views of keyframes that a window has just brought.
    pub fn correct(&mut self, views: &[View], joined: &mut Joined) {
        for better in views {
            let all = self.kept.iter_mut().chain(&mut joined.views);
            for view in all.filter(|v| v.keyframe_id == better.keyframe_id) {
                *view = better.clone();
            }
        }
    }

    /// Takes over what the correction of the whole submap found.
    pub(crate) fn revise(&mut self, correction: &SubmapCorrection, joined: &mut Joined) {
        for revision in &correction.revised {
            let id = revision.keyframe_id;
            let all = self.kept.iter_mut().chain(&mut joined.views);
            for view in all.filter(|v| v.keyframe_id == id) {
                view.submap_from_cam = revision.submap_from_cam;
                view.intrinsics = revision.intrinsics;
                view.submap = revision.submap;
                view.depth.scale(revision.depth_factor);
            }
        }
        if let Some((gone, stays)) = correction.merged
            && gone == self.submap
        {
            self.submap = stays;
            let newest = correction.revised.last();
            self.last_scale *= newest.map_or(1.0, |r| r.depth_factor);
        }
    }

    fn begin(&mut self, mut window: Vec<View>, reason: Option<String>) -> Joined {
        self.submap = self.n_submaps;
        self.n_submaps += 1;
        self.last_scale = self.metres_per_unit;
        self.kept.clear();
        let unit = Similarity {
            scale: self.metres_per_unit,
            ..Similarity::IDENTITY
        };
        for view in &mut window {
            transform(view, &unit, self.submap);
        }
        self.keep(&window);
        Joined {
            views: window,
            note: reason,
            ..Joined::default()
        }
    }

    fn extend(&mut self, window: Vec<View>, fit: Fit) -> Joined {
        self.last_scale = fit.submap_from_window.scale;
        let (mut views, mut shared) = (Vec::new(), Vec::new());
        for mut view in window {
            if let Some(old) = self.known(view.keyframe_id) {
                shared.push(view.keyframe_id);
                views.push(old.clone());
                continue;
            }
            transform(&mut view, &fit.submap_from_window, self.submap);
            views.push(view);
        }
        let fresh: Vec<View> = views
            .iter()
            .filter(|v| !shared.contains(&v.keyframe_id))
            .cloned()
            .collect();
        self.keep(&fresh);
        Joined {
            views,
            shared,
            fit: Some(fit),
            ..Joined::default()
        }
    }

    fn keep(&mut self, views: &[View]) {
        self.kept.extend(views.iter().cloned());
        while self.kept.len() > self.params.fixed_keyframes + MAX_SHARED {
            self.kept.pop_front();
        }
    }

    fn known(&self, keyframe_id: u32) -> Option<&View> {
        self.kept
            .iter()
            .rev()
            .find(|v| v.keyframe_id == keyframe_id)
    }

    /// The first way of joining that passes all gates; an error says why there is none, and holds nothing for the
    /// very first window.
    fn fit(&self, window: &[View]) -> Result<Fit, Option<String>> {
        if self.kept.is_empty() {
            return Err(None);
        }
        let shared: Vec<Shared<'_>> = window
            .iter()
            .filter_map(|new| Some(Shared::new(self.known(new.keyframe_id)?, new)))
            .collect();
        if shared.is_empty() {
            let sentence =
                "a window shares no keyframe with the ones before, so it is a submap of its own";
            return Err(Some(sentence.to_owned()));
        }
        let all: Vec<&Shared<'_>> = shared.iter().collect();
        let mut sets = vec![all.clone()];
        sets.extend(self.majority(&all));
        let mut faults = Vec::new();
        for set in sets {
            let can_use_points = self.params.registration == Registration::Points && set.len() > 1;
            let ways: &[bool] = if can_use_points {
                &[false, true]
            } else {
                &[true]
            };
            for is_scale_only in ways {
                match self.gated(&set, *is_scale_only) {
                    Ok(fit) => return Ok(fit),
                    Err(fault) => faults.push(fault),
                }
            }
        }
        let first = faults.into_iter().next().unwrap_or_default();
        Err(Some(format!(
            "a window does not fit the ones before ({first}), so it is a submap of its own"
        )))
    }

    /// The shared keyframes that agree with one of them, if they are more than half: a network may have lost the
    /// others. One alone always agrees with itself, which says nothing.
    fn majority<'a, 'b>(&self, all: &[&'a Shared<'b>]) -> Option<Vec<&'a Shared<'b>>> {
        let with = |one: &&'a Shared<'b>| {
            let similarity = by_poses(&[*one])?;
            let agrees = |s: &&'a Shared<'b>| {
                s.turn_deg(&similarity) <= self.params.max_rotation_deg
                    && inlier_share(&[*s], &similarity) >= self.params.min_inliers
            };
            Some(all.iter().copied().filter(agrees).collect::<Vec<_>>())
        };
        let sets = all.iter().filter_map(with);
        let largest = sets.max_by_key(Vec::len)?;
        (largest.len() < all.len() && 2 * largest.len() > all.len()).then_some(largest)
    }

    fn gated(&self, shared: &[&Shared<'_>], is_scale_only: bool) -> Result<Fit, String> {
        let found = if is_scale_only {
            by_poses(shared)
        } else {
            by_points(shared)
        };
        let Some(similarity) = found else {
            return Err("its shared keyframes have no depth in common".to_owned());
        };
        let turns = shared.iter().map(|s| s.turn_deg(&similarity));
        let turn_deg = turns.fold(0.0, f64::max);
        let inliers = inlier_share(shared, &similarity);
        let (jump, params) = (similarity.scale / self.last_scale, &self.params);
        let is_near =
            |ratio: f64| ratio <= params.max_scale_jump && ratio >= 1.0 / params.max_scale_jump;
        if !is_near(jump) {
            return Err(format!(
                "its scale is {jump:.2} times that of the window before"
            ));
        }
        if turn_deg.is_nan() || turn_deg > params.max_rotation_deg {
            return Err(format!("a shared keyframe is turned by {turn_deg:.1} deg"));
        }
        if inliers.is_nan() || inliers < params.min_inliers {
            let percent = 100.0 * inliers;
            return Err(format!("{percent:.0} % of the shared surface agree"));
        }
        Ok(Fit {
            submap_from_window: similarity,
            inliers,
            turn_deg,
            keyframe_ids: shared.iter().map(|s| s.new.keyframe_id).collect(),
            is_scale_only,
        })
    }
}

/// Removes views that are no views; the map must never see NaN. Returns a sentence if any went.
pub fn drop_broken(window: &mut Vec<View>) -> Option<String> {
    let before = window.len();
    window.retain(|view| {
        let is_unit = (view.submap_from_cam.rotation.length_squared() - 1.0).abs() < 1e-3;
        let d = &view.depth;
        let n = d.width_px as usize * d.height_px as usize;
        let is_whole = d.depth.len() == n && d.confidence.len() == n;
        view.submap_from_cam.is_finite() && is_unit && view.intrinsics.is_plausible() && is_whole
    });
    let n = before - window.len();
    (n > 0).then(|| format!("{n} of {before} views of a window have no usable camera"))
}

/// The view in another frame and unit.
fn transform(view: &mut View, target_from_submap: &Similarity, submap: u32) {
    view.submap = submap;
    view.submap_from_cam = target_from_submap
        .transform_pose(&view.submap_from_cam)
        .renormalized();
    view.health = view.health.rescaled(target_from_submap.scale);
    view.depth.scale(target_from_submap.scale);
}

/// The same view with all its lengths times `factor`.
pub fn rescaled(view: &View, factor: f64) -> View {
    let mut out = view.clone();
    let unit = Similarity {
        scale: factor,
        rotation: Rigid::IDENTITY.rotation,
        translation: DVec3::ZERO,
    };
    transform(&mut out, &unit, view.submap);
    out
}
