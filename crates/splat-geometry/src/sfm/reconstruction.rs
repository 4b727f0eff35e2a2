//! What structure from motion holds: views with features, the matches between them, landmarks and submaps.
//!
//! Only bookkeeping: every function here keeps `SfmView::landmark_of` and `Landmark::seen` in step.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::features::descriptor::Features;
use crate::inertial::turns::MeasuredTurn;
use crate::matching::PreparedDescriptors;
use crate::optim::bundle::problem::MeasuredDepth;
use crate::sfm::feature_depths::FeatureDepths;
use crate::sfm::params::SfmParams;
use crate::sfm::undistorted::Undistorted;
use crate::two_view::triangulate::Observation;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::depth::DepthMap;
use splat_types::frame::{Frame, Keyframe, SecondImage};
use splat_types::image::RgbImage;
use splat_types::transform::{Rigid, Similarity};

pub(crate) const NONE: u32 = u32::MAX;
/// Keyframes whose images are held, more than stereo reaches back; and twice as many that have no place.
const MAX_IMAGES: usize = 128;

/// A keyframe with what was found in it. Pixels and `lens` are of the working image, as a pinhole has them.
#[derive(Debug)]
pub(crate) struct SfmView {
    pub(crate) keyframe: Arc<Keyframe>,
    pub(crate) features: Features,
    /// The coarsest features, for finding images of the same place.
    pub(crate) signature: PreparedDescriptors,
    pub(crate) lens: Intrinsics,
    pub(crate) is_calibrated: bool,
    /// Where the features lie in the image of an uncalibrated camera, whose lens may bend; empty for others.
    pub(crate) distorted_pixels: Vec<DVec2>,
    pub(crate) registered: Option<RegisteredView>,
    /// What a sensor measured at the features; `None` where none did, or what it says is not believed.
    pub(crate) measured: Option<FeatureDepths>,
    /// How a gyroscope turned since the view before.
    pub(crate) gyro: Option<MeasuredTurn>,
    /// Landmark of each feature, or `NONE`.
    pub(crate) landmark_of: Vec<u32>,
    /// For each feature its verified matches: (view, feature).
    pub(crate) matched: Vec<Vec<(u32, u32)>>,
    /// Inlier landmarks when placing was last tried without success: trying again needs more.
    pub(crate) failed_with: usize,
}

impl SfmView {
    /// Pixels that no ray reaches stay: they fit no landmark.
    pub(crate) fn undistort(&mut self, radial: f64) {
        let lens = distorted(&self.lens, radial);
        for (pixel, distorted) in self.features.pixels.iter_mut().zip(&self.distorted_pixels) {
            let ray = lens.ray_in_cam(*distorted).filter(|_| radial != 0.0);
            let undistorted = ray.and_then(|ray| self.lens.project(ray));
            *pixel = undistorted.unwrap_or(*distorted);
        }
    }
}

/// A pinhole with a radial coefficient.
pub(crate) fn distorted(pinhole: &Intrinsics, radial: f64) -> CameraModel {
    CameraModel {
        intrinsics: *pinhole,
        distortion: Distortion::PlumbBob([radial, 0.0, 0.0, 0.0, 0.0]),
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct RegisteredView {
    pub(crate) submap: u32,
    pub(crate) cam_from_world: Rigid,
}

/// Verified matches between views `a < b`, as (feature of a, feature of b).
#[derive(Debug, Clone)]
pub(crate) struct PairMatches {
    pub(crate) matches: Vec<(u32, u32)>,
    /// Motion b from a and its parallax; `None` while the focal length is unknown.
    pub(crate) motion: Option<(Rigid, f64)>,
}

#[derive(Debug, Clone)]
pub(crate) struct Landmark {
    pub(crate) point: DVec3,
    pub(crate) submap: u32,
    /// (view, feature), at most one of each view; empty = gone.
    pub(crate) seen: Vec<(u32, u32)>,
}

/// Views that share one frame; `views` in the order of placing, the first one holds the frame. Empty = merged away.
#[derive(Debug, Clone, Default)]
pub(crate) struct Submap {
    pub(crate) views: Vec<usize>,
    /// Views when all were last adjusted together.
    pub(crate) n_adjusted: usize,
    /// Its unit is the metre, by measured depth.
    pub(crate) is_metric: bool,
}

/// How far off odometry may be.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct OdometryNoise {
    /// Standard deviations: of the length, as a share of it, and of the heading in radians per metre. 0: odometry is not used.
    pub(crate) length: f64,
    pub(crate) turn_per_metre: f64,
}

impl OdometryNoise {
    pub(crate) fn new(params: &SfmParams) -> Self {
        Self {
            length: params.odometry_noise,
            turn_per_metre: params.odometry_turn_noise.to_radians(),
        }
    }
}

/// All that is known. Many fields: every step of structure from motion looks at several of them.
#[derive(Debug, Default)]
pub(crate) struct Reconstruction {
    pub(crate) views: Vec<SfmView>,
    pub(crate) links: BTreeMap<(usize, usize), PairMatches>,
    /// To views long before, which may only look alike: not used until they fit or close a loop (`looping`).
    pub(crate) held: BTreeMap<(usize, usize), PairMatches>,
    /// Ends of links that closed loops.
    pub(crate) closed: Vec<(usize, usize)>,
    pub(crate) landmarks: Vec<Landmark>,
    pub(crate) submaps: Vec<Submap>,
    /// Of the lens of all uncalibrated views, as in `bundle::Camera`.
    pub(crate) radial: f64,
    /// The same when the matches were verified.
    pub(crate) linked_with: f64,
    pub(crate) undistorted: Undistorted,
    /// Views that have got matches or landmarks since submaps were last merged.
    pub(crate) unmerged: BTreeSet<usize>,
    /// Views whose measured depth was not believed.
    pub(crate) n_wrong_depths: u64,
    pub(crate) odometry_noise: OdometryNoise,
    /// Grows when a submap is adjusted as a whole, merged or dissolved, or a loop is closed.
    pub(crate) n_rebuilt: u64,
}

impl Reconstruction {
    pub(crate) fn pixel(&self, (view, feature): (u32, u32)) -> DVec2 {
        self.views[view as usize].features.pixels[feature as usize]
    }

    /// Images that stereo has no use for any more leave memory; features and sizes stay.
    pub(crate) fn let_go(&mut self) {
        let n = self.views.len();
        for (ix, view) in self.views.iter_mut().enumerate() {
            let is_old = view.registered.is_some() && ix + MAX_IMAGES < n;
            let is_hopeless = ix + 2 * MAX_IMAGES < n;
            if (is_old || is_hopeless) && !view.keyframe.frame.image.is_unloaded() {
                view.keyframe = Arc::new(view.keyframe.unloaded());
            }
        }
    }

    /// Where the image has it.
    pub(crate) fn distorted_pixel(&self, at: (u32, u32)) -> DVec2 {
        let distorted = &self.views[at.0 as usize].distorted_pixels;
        distorted
            .get(at.1 as usize)
            .copied()
            .unwrap_or_else(|| self.pixel(at))
    }

    /// After a change of `radial` or of the uncalibrated views' focal length: puts their features where a pinhole
    /// would have them.
    pub(crate) fn undistort(&mut self) {
        let radial = self.radial;
        self.views
            .par_iter_mut()
            .for_each(|view| view.undistort(radial));
    }

    /// `None` where the view is not registered.
    pub(crate) fn observation(&self, at: (u32, u32)) -> Option<Observation<'_>> {
        let view = &self.views[at.0 as usize];
        let registered = view.registered.as_ref()?;
        Some(Observation {
            cam_from_world: &registered.cam_from_world,
            intrinsics: &view.lens,
            pixel: self.pixel(at),
        })
    }

    /// The measured depth of an observation in a submap whose unit is the metre.
    pub(crate) fn measured(&self, (view, feature): (u32, u32)) -> Option<MeasuredDepth> {
        let view = &self.views[view as usize];
        let submap = view.registered.as_ref()?.submap;
        let is_metric = self.submaps[submap as usize].is_metric;
        let depths = view.measured.as_ref().filter(|_| is_metric)?;
        depths.of(feature as usize)
    }

    /// Where the measured depth of an observation puts its point.
    pub(crate) fn measured_point(&self, at: (u32, u32)) -> Option<DVec3> {
        let measured = self.measured(at)?;
        let view = &self.views[at.0 as usize];
        let in_cam = view.lens.ray_in_cam(self.pixel(at)) / measured.inverse;
        let world_from_cam = view.registered.as_ref()?.cam_from_world.inverse();
        Some(world_from_cam.transform_point(in_cam))
    }

    /// The depth map that a sensor measured in a view, where it is believed and the submap is in metres.
    pub(crate) fn measured_map(&self, view_ix: usize) -> Option<Arc<DepthMap>> {
        let frame = self.metric_frame(view_ix)?;
        frame.sensor_depth.as_ref().map(Arc::clone)
    }

    /// The image of the second camera beside a view, likewise.
    pub(crate) fn second_image(&self, view_ix: usize) -> Option<Arc<SecondImage>> {
        let frame = self.metric_frame(view_ix)?;
        let second = frame.second.as_ref();
        second
            .filter(|_| frame.sensor_depth.is_none())
            .map(Arc::clone)
    }

    fn metric_frame(&self, view_ix: usize) -> Option<&Frame> {
        let view = &self.views[view_ix];
        let submap = view.registered.as_ref()?.submap;
        let is_usable = self.submaps[submap as usize].is_metric && view.measured.is_some();
        (is_usable && self.undistorted_of(view).is_none()).then_some(&view.keyframe.frame)
    }

    /// Lens and pinhole of a view's image; `None` where the image is a pinhole's as it is.
    pub(crate) fn undistorted_of(&self, view: &SfmView) -> Option<(CameraModel, Intrinsics)> {
        if view.is_calibrated {
            return None;
        }
        let image = &view.keyframe.frame.image;
        let size = (image.width_px, image.height_px);
        self.undistorted.of(size, &view.lens)
    }

    /// Index of a keyframe's view.
    pub(crate) fn view_of(&self, keyframe_id: u32) -> Option<usize> {
        // The newest are asked for most.
        let mut views = self.views.iter();
        views.rposition(|view| view.keyframe.id == keyframe_id)
    }

    /// Intrinsics at the size of the keyframe's image; of the straight one, where its lens bends.
    pub(crate) fn intrinsics_of(&self, keyframe_id: u32) -> Option<Intrinsics> {
        let view = &self.views[self.view_of(keyframe_id)?];
        if let Some((_, pinhole)) = self.undistorted_of(view) {
            return Some(pinhole);
        }
        let frame = &view.keyframe.frame;
        let known = frame.intrinsics.filter(|_| view.is_calibrated);
        Some(known.unwrap_or_else(|| {
            view.lens
                .resized(frame.image.width_px, frame.image.height_px)
        }))
    }

    pub(crate) fn image_of(&self, keyframe_id: u32) -> Option<Arc<RgbImage>> {
        let view = &self.views[self.view_of(keyframe_id)?];
        let image = &view.keyframe.frame.image;
        (!image.is_unloaded()).then(|| Arc::clone(image))
    }

    pub(crate) fn submap_of(&self, view_ix: usize) -> Option<u32> {
        self.views[view_ix].registered.as_ref().map(|p| p.submap)
    }

    pub(crate) fn centre(&self, view_ix: usize) -> Option<DVec3> {
        self.views[view_ix]
            .registered
            .as_ref()
            .map(|p| p.cam_from_world.inverse().translation)
    }

    pub(crate) fn place(&mut self, view_ix: usize, submap: u32, cam_from_world: Rigid) {
        self.views[view_ix].registered = Some(RegisteredView {
            submap,
            cam_from_world,
        });
        self.submaps[submap as usize].views.push(view_ix);
    }

    /// The view waits again; its observations go.
    pub(crate) fn unplace(&mut self, view_ix: usize) {
        for landmark in self.landmarks_of(&[view_ix]) {
            self.retain_observations(landmark, |s| s.0 as usize != view_ix);
        }
        if let Some(registered) = self.views[view_ix].registered.take() {
            self.submaps[registered.submap as usize]
                .views
                .retain(|&s| s != view_ix);
        }
    }

    pub(crate) fn add_landmark(&mut self, point: DVec3, submap: u32, seen: Vec<(u32, u32)>) -> u32 {
        let ix = self.landmarks.len() as u32;
        for &(view, feature) in &seen {
            self.views[view as usize].landmark_of[feature as usize] = ix;
            self.unmerged.insert(view as usize);
        }
        self.landmarks.push(Landmark {
            point,
            submap,
            seen,
        });
        ix
    }

    /// Adds an observation unless its view sees the landmark already.
    pub(crate) fn add_observation(&mut self, landmark_ix: u32, at: (u32, u32)) -> bool {
        let landmark = &mut self.landmarks[landmark_ix as usize];
        if landmark.seen.iter().any(|s| s.0 == at.0) {
            return false;
        }
        landmark.seen.push(at);
        self.views[at.0 as usize].landmark_of[at.1 as usize] = landmark_ix;
        self.unmerged.insert(at.0 as usize);
        true
    }

    /// Keeps the observations that `keep` names; a landmark left with one observation goes.
    pub(crate) fn retain_observations(
        &mut self,
        landmark_ix: u32,
        keep: impl Fn(&(u32, u32)) -> bool,
    ) {
        let landmark = &mut self.landmarks[landmark_ix as usize];
        let (kept, gone): (Vec<_>, Vec<_>) = landmark.seen.iter().partition(|s| keep(s));
        let (kept, gone) = if kept.len() < 2 {
            (Vec::new(), landmark.seen.clone())
        } else {
            (kept, gone)
        };
        landmark.seen = kept;
        for (view, feature) in gone {
            self.views[view as usize].landmark_of[feature as usize] = NONE;
        }
    }

    /// Joins `gone` into `stays`; observations of views that `stays` has already are dropped.
    pub(crate) fn join_landmarks(&mut self, stays: u32, gone: u32) {
        let moved = std::mem::take(&mut self.landmarks[gone as usize].seen);
        for at in moved {
            self.views[at.0 as usize].landmark_of[at.1 as usize] = NONE;
            self.add_observation(stays, at);
        }
    }

    /// Landmarks seen by any of the views, in order.
    pub(crate) fn landmarks_of(&self, views: &[usize]) -> Vec<u32> {
        let all = views
            .iter()
            .flat_map(|&s| self.views[s].landmark_of.iter().copied());
        let mut found: Vec<u32> = all.filter(|&l| l != NONE).collect();
        found.sort_unstable();
        found.dedup();
        found
    }

    /// How many landmarks every other view shares with one, by view index.
    pub(crate) fn shared_counts(&self, view_ix: usize) -> BTreeMap<usize, u32> {
        let mut counts = BTreeMap::new();
        for &landmark in self.views[view_ix]
            .landmark_of
            .iter()
            .filter(|l| **l != NONE)
        {
            for &(other, _) in &self.landmarks[landmark as usize].seen {
                if other as usize != view_ix {
                    *counts.entry(other as usize).or_insert(0) += 1;
                }
            }
        }
        counts
    }

    /// Takes a submap apart again: its views wait, its landmarks go.
    pub(crate) fn dissolve(&mut self, submap: u32) {
        self.n_rebuilt += 1;
        let views = std::mem::take(&mut self.submaps[submap as usize].views);
        for landmark in self.landmarks_of(&views) {
            self.retain_observations(landmark, |_| false);
        }
        for view in views {
            self.views[view].registered = None;
        }
        // The number is given again as long as nothing came after it.
        if submap as usize + 1 == self.submaps.len() {
            self.submaps.pop();
        }
    }

    /// Moves all of a submap by `new_from_old`.
    pub(crate) fn transform(&mut self, submap: u32, new_from_old: &Similarity) {
        let views = self.submaps[submap as usize].views.clone();
        for landmark in self.landmarks_of(&views) {
            let point = &mut self.landmarks[landmark as usize].point;
            *point = new_from_old.transform_point(*point);
        }
        for view in views {
            if let Some(registered) = &mut self.views[view].registered {
                registered.cam_from_world = new_from_old
                    .transform_pose(&registered.cam_from_world.inverse())
                    .inverse();
            }
        }
    }

    /// Makes a submap part of another one, by how it lies to it.
    pub(crate) fn absorb(&mut self, stays: u32, gone: u32, stays_from_gone: &Similarity) {
        self.transform(gone, stays_from_gone);
        let views = std::mem::take(&mut self.submaps[gone as usize].views);
        for landmark in self.landmarks_of(&views) {
            self.landmarks[landmark as usize].submap = stays;
        }
        for &view in &views {
            if let Some(registered) = &mut self.views[view].registered {
                registered.submap = stays;
            }
        }
        self.unmerged.extend(&views);
        self.submaps[stays as usize].views.extend(views);
    }

    /// Distances from a view to the landmarks it sees, along its axis.
    pub(crate) fn depths(&self, view_ix: usize) -> Vec<f64> {
        let view = &self.views[view_ix];
        let Some(registered) = &view.registered else {
            return Vec::new();
        };
        let seen = view.landmark_of.iter().filter(|l| **l != NONE);
        seen.map(|&l| {
            registered
                .cam_from_world
                .transform_point(self.landmarks[l as usize].point)
                .z
        })
        .collect()
    }
}
