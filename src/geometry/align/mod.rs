//! What comes after a network's answer: its poses corrected by matches, its depth brought to their unit, its
//! confidence checked across views, and its windows laid one after the other into one frame.
//!
//! docs/ALIGNMENT.md has the procedures, the noise that they are measured with and the figures.

mod agreeing;
pub mod bundle_state;
mod closing;
pub mod depth_bundle;
pub mod epipolar;
mod line_distance;
mod link;
mod loops;
pub mod matches;
pub mod noise;
mod overlap;
pub mod rescale;
#[cfg(test)]
mod tests;
pub mod tracks;
mod whole;
pub mod window;

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};

use self::bundle_state::Depths;
use self::matches::Matcher;
use self::tracks::{points, tracks};
use self::whole::Whole;
use self::window::{Joined, Windows};
use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::config::SfmParams;
use crate::config::align::{AlignMethod, AlignParams};
use crate::frame::{DepthMap, RgbImage};
use crate::geometry::features::FeaturesError;
use crate::geometry::two_view::median;
use crate::geometry::{Revision, View};
use crate::pose::Rigid;

/// A correction after which the matches fit worse than before by this factor is put back. Not 1: a window that fits
/// well within itself may give a hundredth of a pixel for its fit with the views that are held.
const MAX_WORSE: f64 = 1.5;
/// Reprojection error up to which a triangulated point is one, in pixels of a picture of 640.
const MAX_POINT_ERROR_PX: f64 = 3.0;

/// A view as the methods see it: pixels and lens of the working picture.
#[derive(Debug, Clone)]
pub struct Shot {
    pub cam_from_batch: Rigid,
    pub lens: Intrinsics,
    /// Its pose is given.
    pub is_held: bool,
    pub pixels: Vec<DVec2>,
}

/// Matches between two views, `first < second`, as (feature of first, feature of second).
#[derive(Debug, Clone)]
pub struct Pair {
    pub first: usize,
    pub second: usize,
    pub features: Vec<(u32, u32)>,
}

/// Views with all that was matched between them.
#[derive(Debug, Clone, Default)]
pub struct Matched {
    pub shots: Vec<Shot>,
    pub pairs: Vec<Pair>,
}

/// What is known beforehand of a window.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Given {
    /// So many of the first views are held where they are.
    pub n_held: usize,
    /// The focal length is measured and stays.
    pub is_calibrated: bool,
}

/// What a correction did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Refined {
    pub n_pairs: usize,
    pub n_matches: usize,
    /// Median symmetric epipolar distance in pixels of the working picture; `None` without matches.
    pub before_px: Option<f64>,
    pub after_px: Option<f64>,
    /// Factor on each view's depth; 1 where nothing was learnt.
    pub depth_factors: Vec<f64>,
    /// Why something was left as it was, one plain sentence.
    pub note: Option<String>,
}

/// Corrects windows and lays them into one frame. One for a stream of keyframes.
#[derive(Debug)]
pub struct Aligner {
    params: AlignParams,
    matcher: Matcher,
    pub windows: Windows,
    whole: Whole,
}

impl Aligner {
    /// An error where the parameters name a network for features that is not there.
    pub fn new(params: &AlignParams, sfm: &SfmParams, seed: u64) -> Result<Self, FeaturesError> {
        Ok(Self {
            params: params.clone(),
            matcher: Matcher::new(sfm, params.whole, seed)?,
            windows: Windows::new(params),
            whole: Whole::default(),
        })
    }

    /// When keyframes were taken: between components, that bounds how far the camera went.
    pub fn note_stamps(&mut self, stamps: impl Iterator<Item = (u32, Stamp)>) {
        if self.params.whole > 0 {
            self.whole.loops.note_stamps(stamps);
        }
    }

    /// The views of one window, in the network's own frame and unit -> in the running frame of their component.
    /// `pictures` by keyframe id, of every keyframe that is new.
    pub fn place(
        &mut self,
        mut window: Vec<View>,
        pictures: &BTreeMap<u32, Arc<RgbImage>>,
        is_calibrated: bool,
    ) -> Joined {
        let lost = window::drop_broken(&mut window);
        let given = Given {
            n_held: 0,
            is_calibrated,
        };
        let refined = self.refine(&mut window, pictures, given);
        let mut joined = self.windows.join(window);
        if self.params.method == AlignMethod::Off {
            joined.note = joined.note.or(lost);
            return joined;
        }
        let mut views = self.windows.before(&joined, self.params.history);
        let n_held = views.len();
        let fresh = joined.views.iter().filter(|view| joined.is_new(view));
        views.extend(fresh.cloned());
        if n_held > 0 {
            let given = Given {
                n_held,
                is_calibrated,
            };
            self.refine(&mut views, pictures, given);
        }
        rescale::confidence(&mut views, self.params.depth_error, n_held);
        views[n_held..].iter_mut().for_each(|view| {
            rescale::mask(&mut view.depth, self.params.depth_error);
        });
        self.windows.correct(&views[n_held..], &mut joined);
        self.correct_whole(&views[n_held..], given, &mut joined);
        joined.note = joined.note.or(lost).or_else(|| refined.note.clone());
        joined.refined = refined;
        joined
    }

    /// What all keyframes say together, once no more will come.
    pub fn finish(&mut self) -> Vec<Revision> {
        let mut revised = Vec::new();
        for component in self.whole.changed() {
            let found = self
                .whole
                .correct(component, &mut self.matcher, &self.params);
            revised.extend(found.map_or_else(Vec::new, |c| c.revised));
        }
        revised
    }

    /// Remembers the new views of a window, and corrects their component when it has grown by enough.
    fn correct_whole(&mut self, fresh: &[View], given: Given, joined: &mut Joined) {
        let Some(component) = fresh.first().map(|v| v.component) else {
            return;
        };
        if self.params.whole == 0 {
            return;
        }
        self.whole
            .add(fresh, &self.matcher, given, self.params.whole);
        let ids: Vec<u32> = fresh.iter().map(|v| v.keyframe_id).collect();
        let mut correction = None;
        if self.params.loops {
            let (whole, matcher) = (&mut self.whole, &mut self.matcher);
            correction = whole.close_loop(&ids, matcher, &self.params);
        }
        if correction.is_none() && self.whole.is_due(component) {
            let (whole, matcher) = (&mut self.whole, &mut self.matcher);
            correction = whole.correct(component, matcher, &self.params);
        }
        if let Some(correction) = correction {
            self.windows.revise(&correction, joined);
            joined.is_loop = correction.is_loop;
            joined.revised = correction.revised;
        }
    }

    /// Corrects poses of one window in place, in whatever frame they share, and scales depth to fit them.
    pub fn refine(
        &mut self,
        views: &mut [View],
        pictures: &BTreeMap<u32, Arc<RgbImage>>,
        given: Given,
    ) -> Refined {
        if self.params.method == AlignMethod::Off {
            return Refined::default();
        }
        let mut matched = self.matcher.matched(views, pictures, &self.params);
        refine_matched(views, &mut matched, &self.params, given)
    }
}

/// Corrects views whose matches are known already; `matched.shots` belong to `views` one by one.
pub fn refine_matched(
    views: &mut [View],
    matched: &mut Matched,
    params: &AlignParams,
    given: Given,
) -> Refined {
    assert_eq!(views.len(), matched.shots.len(), "a shot for each view");
    for (ix, shot) in matched.shots.iter_mut().enumerate() {
        shot.is_held = ix < given.n_held;
    }
    let before_px = epipolar::median_error_px(matched);
    let mut refined = Refined {
        n_pairs: matched.pairs.len(),
        n_matches: matched.pairs.iter().map(|p| p.features.len()).sum(),
        before_px,
        after_px: before_px,
        depth_factors: vec![1.0; views.len()],
        note: None,
    };
    if before_px.is_none() || params.method == AlignMethod::Off {
        refined.note = Some("no two views of the window match, so its poses stay".to_owned());
        return refined;
    }
    let original = matched.shots.clone();
    let tracks = tracks(matched);
    if params.method != AlignMethod::Bundle {
        let settings = epipolar::Settings {
            steps: params.steps,
            moves_focal: !given.is_calibrated,
            moves_centre: params.principal_point && !given.is_calibrated,
            unit: unit(views),
        };
        epipolar::align(matched, &settings);
    }
    if params.method != AlignMethod::Epipolar {
        let settings = depth_bundle::Settings {
            depth_error: params.depth_error,
            moves_focal: !given.is_calibrated,
        };
        let depths = depths(views, matched);
        depth_bundle::align(matched, &tracks, &depths, &settings);
    }
    refined.after_px = epipolar::median_error_px(matched);
    let is_better = refined.after_px <= before_px.map(|b| b * MAX_WORSE);
    if refined.after_px.is_none() || !is_better {
        matched.shots = original;
        refined.after_px = before_px;
        refined.note = Some(
            "the correction made the window's matches fit worse, so its poses stay".to_owned(),
        );
    }
    write_back(views, matched);
    let limit = MAX_POINT_ERROR_PX * longest_px(matched) / 640.0;
    let points = points(matched, &tracks, limit);
    refined.depth_factors = rescale::depth(views, matched, &points, given.n_held);
    rescale::health(views, &points);
    refined
}

fn write_back(views: &mut [View], matched: &Matched) {
    for (view, shot) in views.iter_mut().zip(&matched.shots) {
        if shot.is_held {
            continue;
        }
        view.batch_from_cam = shot.cam_from_batch.inverse();
        let (w, h) = (view.intrinsics.width_px, view.intrinsics.height_px);
        let lens = shot.lens.resized(w, h);
        if lens.is_plausible() {
            view.intrinsics = lens;
        }
    }
}

/// The length that counts as 1: the median depth.
fn unit(views: &[View]) -> f64 {
    let medians = views.iter().filter_map(|v| v.depth.median().map(f64::from));
    median(&mut medians.collect::<Vec<_>>()).unwrap_or(1.0)
}

fn longest_px(matched: &Matched) -> f64 {
    let sides = matched
        .shots
        .iter()
        .map(|s| s.lens.width_px.max(s.lens.height_px));
    f64::from(sides.max().unwrap_or(1))
}

/// The network's depth at each feature.
pub fn depths(views: &[View], matched: &Matched) -> Depths {
    let of_view = |(view, shot): (&View, &Shot)| {
        let at = |pixel: &DVec2| depth_at(&view.depth, &shot.lens, *pixel);
        shot.pixels.iter().map(at).collect()
    };
    views.iter().zip(&matched.shots).map(of_view).collect()
}

fn depth_at(depth: &DepthMap, lens: &Intrinsics, pixel: DVec2) -> Option<f64> {
    let (w, h) = (f64::from(lens.width_px), f64::from(lens.height_px));
    let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h;
    if !is_inside {
        return None;
    }
    let x = (pixel.x / w * f64::from(depth.width_px)) as usize;
    let y = (pixel.y / h * f64::from(depth.height_px)) as usize;
    let found = depth.verified(y * depth.width_px as usize + x)?;
    Some(f64::from(found.0))
}

/// Mean distance of the cameras from their mean.
fn camera_spread(cam_from_batch: &[Rigid]) -> f64 {
    let centres: Vec<DVec3> = cam_from_batch
        .iter()
        .map(|pose| pose.inverse().translation)
        .collect();
    let n = centres.len().max(1) as f64;
    let mean = centres.iter().sum::<DVec3>() / n;
    centres.iter().map(|c| c.distance(mean)).sum::<f64>() / n
}
