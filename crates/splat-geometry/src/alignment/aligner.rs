//! Windows of a network, one after the other -> corrected, and laid into one frame.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec2;

use crate::alignment::depths::Depths;
use crate::alignment::global_ba::GlobalBa;
use crate::alignment::matched::{
    InitialPoses, MAX_POINT_ERROR_PX, Matched, Refined, WindowView, depth_at, longest_px, unit,
    write_back,
};
use crate::alignment::matches::Matcher;
use crate::alignment::params::{AlignMethod, AlignParams};
use crate::alignment::register_window::{self, Joined, Windows};
use crate::alignment::tracks::{points, tracks};
use crate::alignment::{depth_bundle, epipolar, rescale_depth};
use crate::answer::{PairMatches, PoseUpdate, View};
use crate::error::FeaturesError;
use crate::sfm::params::SfmParams;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;

/// A correction after which the matches fit worse than before by this factor is put back. Not 1: a window that fits
/// well within itself may give a hundredth of a pixel for its fit with the views that are held.
const MAX_WORSE: f64 = 1.5;

/// Corrects windows and lays them into one frame. One for a stream of keyframes.
#[derive(Debug)]
pub struct Aligner {
    params: AlignParams,
    matcher: Matcher,
    pub windows: Windows,
    whole: GlobalBa,
}

impl Aligner {
    /// An error where the parameters name a network for features that is not there.
    pub fn new(params: &AlignParams, sfm: &SfmParams, seed: u64) -> Result<Self, FeaturesError> {
        Ok(Self {
            params: params.clone(),
            matcher: Matcher::new(sfm, params.global_ba_keyframes, seed)?,
            windows: Windows::new(params),
            whole: GlobalBa::default(),
        })
    }

    /// When keyframes were taken: between submaps, that bounds how far the camera went.
    pub fn note_stamps(&mut self, stamps: impl Iterator<Item = (u32, Stamp)>) {
        if self.params.global_ba_keyframes > 0 {
            self.whole.loops.note_stamps(stamps);
        }
    }

    /// The views of one window, in the network's own frame and unit -> in the running frame of their submap.
    /// `images` by keyframe id, of every keyframe that is new.
    pub fn place(
        &mut self,
        mut window: Vec<View>,
        images: &BTreeMap<u32, Arc<RgbImage>>,
        is_calibrated: bool,
    ) -> Joined {
        let lost = register_window::drop_broken(&mut window);
        let given = InitialPoses {
            n_held: 0,
            is_calibrated,
        };
        let refined = self.refine(&mut window, images, given);
        let mut joined = self.windows.join(window);
        if self.params.method == AlignMethod::Off {
            joined.note = joined.note.or(lost);
            return joined;
        }
        let mut views = self.windows.before(&joined, self.params.fixed_keyframes);
        let n_held = views.len();
        let fresh = joined.views.iter().filter(|view| joined.is_new(view));
        views.extend(fresh.cloned());
        if n_held > 0 {
            let given = InitialPoses {
                n_held,
                is_calibrated,
            };
            self.refine(&mut views, images, given);
        }
        rescale_depth::confidence(&mut views, self.params.depth_error, n_held);
        views[n_held..].iter_mut().for_each(|view| {
            rescale_depth::mask(&mut view.depth, self.params.depth_error);
        });
        self.windows.correct(&views[n_held..], &mut joined);
        self.correct_whole(&views[n_held..], given, &mut joined);
        joined.note = joined.note.or(lost).or_else(|| refined.note.clone());
        joined.refined = refined;
        joined
    }

    /// Verified matches of pairs of keyframes that were found since they were last taken; none with method off.
    pub fn take_new_matches(&mut self) -> Vec<PairMatches> {
        self.matcher.take_new_matches()
    }

    /// What all keyframes say together, once no more will come.
    pub fn finish(&mut self) -> Vec<PoseUpdate> {
        let mut revised = Vec::new();
        for submap in self.whole.changed() {
            let found = self.whole.correct(submap, &mut self.matcher, &self.params);
            revised.extend(found.map_or_else(Vec::new, |c| c.revised));
        }
        revised
    }

    /// Remembers the new views of a window, and corrects their submap when it has grown by enough.
    fn correct_whole(&mut self, fresh: &[View], given: InitialPoses, joined: &mut Joined) {
        let Some(submap) = fresh.first().map(|v| v.submap) else {
            return;
        };
        if self.params.global_ba_keyframes == 0 {
            return;
        }
        self.whole
            .add(fresh, &self.matcher, given, self.params.global_ba_keyframes);
        let ids: Vec<u32> = fresh.iter().map(|v| v.keyframe_id).collect();
        let mut correction = None;
        if self.params.loops {
            let (whole, matcher) = (&mut self.whole, &mut self.matcher);
            correction = whole.close_loop(&ids, matcher, &self.params);
        }
        if correction.is_none() && self.whole.is_due(submap) {
            let (whole, matcher) = (&mut self.whole, &mut self.matcher);
            correction = whole.correct(submap, matcher, &self.params);
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
        images: &BTreeMap<u32, Arc<RgbImage>>,
        given: InitialPoses,
    ) -> Refined {
        if self.params.method == AlignMethod::Off {
            return Refined::default();
        }
        let mut matched = self.matcher.matched(views, images, &self.params);
        refine_matched(views, &mut matched, &self.params, given)
    }
}

/// Corrects views whose matches are known already; `matched.views` belong to `views` one by one.
pub fn refine_matched(
    views: &mut [View],
    matched: &mut Matched,
    params: &AlignParams,
    given: InitialPoses,
) -> Refined {
    assert_eq!(views.len(), matched.views.len(), "a view for each view");
    for (ix, view) in matched.views.iter_mut().enumerate() {
        view.is_held = ix < given.n_held;
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
    let original = matched.views.clone();
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
    // Epipolar lines say nothing of lengths along them, and depth that is scaled to places that slid along is worse than before: the places
    // are moved by lines and depth together.
    let turns = params.method != AlignMethod::Epipolar;
    let settings = depth_bundle::Settings {
        depth_error: params.depth_error,
        moves_focal: turns && !given.is_calibrated,
        turns,
    };
    let depths = depths(views, matched);
    depth_bundle::align(matched, &tracks, &depths, &settings);
    refined.after_px = epipolar::median_error_px(matched);
    let is_better = refined.after_px <= before_px.map(|b| b * MAX_WORSE);
    if refined.after_px.is_none() || !is_better {
        matched.views = original;
        refined.after_px = before_px;
        refined.note = Some(
            "the correction made the window's matches fit worse, so its poses stay".to_owned(),
        );
    }
    write_back(views, matched);
    let limit = MAX_POINT_ERROR_PX * longest_px(matched) / 640.0;
    let points = points(matched, &tracks, limit);
    refined.depth_factors = rescale_depth::depth(views, matched, &points, given.n_held);
    rescale_depth::health(views, &points);
    refined
}

/// The network's depth at each feature.
pub fn depths(views: &[View], matched: &Matched) -> Depths {
    let of_view = |(view, aligned_view): (&View, &WindowView)| {
        let at = |pixel: &DVec2| depth_at(&view.depth, &aligned_view.lens, *pixel);
        aligned_view.pixels.iter().map(at).collect()
    };
    views.iter().zip(&matched.views).map(of_view).collect()
}

#[cfg(test)]
pub(crate) mod tests;
