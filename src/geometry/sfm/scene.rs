//! What structure from motion holds: shots with features, the matches between them, landmarks and components.
//!
//! Only bookkeeping: every function here keeps `Shot::landmark_of` and `Landmark::seen` in step.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::straightening::Straight;
use crate::camera::{Distortion, Intrinsics, Lens};
use crate::frame::{Keyframe, RgbImage};
use crate::geometry::features::Features;
use crate::geometry::matching::Comparable;
use crate::geometry::triangulate::Sight;
use crate::pose::{Rigid, Similarity};

pub(super) const NONE: u32 = u32::MAX;

/// A keyframe with what was found in it. Pixels and `lens` are of the working picture, as a pinhole has them.
#[derive(Debug)]
pub(super) struct Shot {
    pub(super) keyframe: Arc<Keyframe>,
    pub(super) features: Features,
    /// The coarsest features, for finding pictures of the same place.
    pub(super) signature: Comparable,
    pub(super) lens: Intrinsics,
    pub(super) is_calibrated: bool,
    /// Where the features lie in the picture of an uncalibrated camera, whose lens may bend; empty for others.
    pub(super) bent_pixels: Vec<DVec2>,
    pub(super) placed: Option<Placed>,
    /// Landmark of each feature, or `NONE`.
    pub(super) landmark_of: Vec<u32>,
    /// For each feature its verified matches: (shot, feature).
    pub(super) matched: Vec<Vec<(u32, u32)>>,
    /// Agreeing landmarks when placing was last tried without success: trying again needs more.
    pub(super) failed_with: usize,
}

impl Shot {
    /// Pixels that no ray reaches stay: they fit no landmark.
    pub(super) fn straighten(&mut self, radial: f64) {
        let lens = bent(&self.lens, radial);
        for (pixel, bent) in self.features.pixels.iter_mut().zip(&self.bent_pixels) {
            let ray = lens.ray_in_cam(*bent).filter(|_| radial != 0.0);
            let straight = ray.and_then(|ray| self.lens.project(ray));
            *pixel = straight.unwrap_or(*bent);
        }
    }
}

/// A pinhole with a radial coefficient.
pub(super) fn bent(pinhole: &Intrinsics, radial: f64) -> Lens {
    Lens {
        intrinsics: *pinhole,
        distortion: Distortion::PlumbBob([radial, 0.0, 0.0, 0.0, 0.0]),
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Placed {
    pub(super) component: u32,
    pub(super) cam_from_map: Rigid,
}

/// Verified matches between shots `a < b`, as (feature of a, feature of b).
#[derive(Debug, Clone)]
pub(super) struct Link {
    pub(super) matches: Vec<(u32, u32)>,
    /// Motion b from a and its parallax; `None` while the focal length is unknown.
    pub(super) motion: Option<(Rigid, f64)>,
}

#[derive(Debug, Clone)]
pub(super) struct Landmark {
    pub(super) point: DVec3,
    pub(super) component: u32,
    /// (shot, feature), at most one of each shot; empty = gone.
    pub(super) seen: Vec<(u32, u32)>,
}

/// Shots that share one frame; `shots` in the order of placing, the first one holds the frame. Empty = merged away.
#[derive(Debug, Clone, Default)]
pub(super) struct Component {
    pub(super) shots: Vec<usize>,
    /// Shots when all were last adjusted together.
    pub(super) n_adjusted: usize,
}

#[derive(Debug, Default)]
pub(super) struct Scene {
    pub(super) shots: Vec<Shot>,
    pub(super) links: BTreeMap<(usize, usize), Link>,
    /// To shots long before, which may only look alike: not used until they fit or close a loop (`looping`).
    pub(super) held: BTreeMap<(usize, usize), Link>,
    /// Ends of links that closed loops.
    pub(super) closed: Vec<(usize, usize)>,
    pub(super) landmarks: Vec<Landmark>,
    pub(super) components: Vec<Component>,
    /// Of the lens of all uncalibrated shots, as in `bundle::Camera`.
    pub(super) radial: f64,
    /// The same when the matches were verified.
    pub(super) linked_with: f64,
    pub(super) straight: Straight,
}

impl Scene {
    pub(super) fn pixel(&self, (shot, feature): (u32, u32)) -> DVec2 {
        self.shots[shot as usize].features.pixels[feature as usize]
    }

    /// Where the picture has it.
    pub(super) fn bent_pixel(&self, at: (u32, u32)) -> DVec2 {
        let bent = &self.shots[at.0 as usize].bent_pixels;
        bent.get(at.1 as usize)
            .copied()
            .unwrap_or_else(|| self.pixel(at))
    }

    /// After a change of `radial` or of the uncalibrated shots' focal length: puts their features where a pinhole
    /// would have them.
    pub(super) fn straighten(&mut self) {
        let radial = self.radial;
        self.shots
            .par_iter_mut()
            .for_each(|shot| shot.straighten(radial));
    }

    /// `None` where the shot is not placed.
    pub(super) fn sight(&self, at: (u32, u32)) -> Option<Sight<'_>> {
        let shot = &self.shots[at.0 as usize];
        let placed = shot.placed.as_ref()?;
        Some(Sight {
            cam_from_map: &placed.cam_from_map,
            intrinsics: &shot.lens,
            pixel: self.pixel(at),
        })
    }

    /// Intrinsics at the size of the keyframe's picture; of the straight one, where its lens bends.
    pub(super) fn intrinsics_of(&self, keyframe_id: u32) -> Option<Intrinsics> {
        let shot = self
            .shots
            .iter()
            .rev()
            .find(|s| s.keyframe.id == keyframe_id)?;
        if let Some((_, pinhole)) = self.straight.of(shot) {
            return Some(pinhole);
        }
        let frame = &shot.keyframe.frame;
        let known = frame.intrinsics.filter(|_| shot.is_calibrated);
        Some(known.unwrap_or_else(|| {
            shot.lens
                .resized(frame.image.width_px, frame.image.height_px)
        }))
    }

    pub(super) fn image_of(&self, keyframe_id: u32) -> Option<Arc<RgbImage>> {
        let shot = self
            .shots
            .iter()
            .rev()
            .find(|s| s.keyframe.id == keyframe_id)?;
        let image = &shot.keyframe.frame.image;
        (!image.is_hollow()).then(|| Arc::clone(image))
    }

    pub(super) fn component_of(&self, shot_ix: usize) -> Option<u32> {
        self.shots[shot_ix].placed.as_ref().map(|p| p.component)
    }

    pub(super) fn centre(&self, shot_ix: usize) -> Option<DVec3> {
        self.shots[shot_ix]
            .placed
            .as_ref()
            .map(|p| p.cam_from_map.inverse().translation)
    }

    pub(super) fn place(&mut self, shot_ix: usize, component: u32, cam_from_map: Rigid) {
        self.shots[shot_ix].placed = Some(Placed {
            component,
            cam_from_map,
        });
        self.components[component as usize].shots.push(shot_ix);
    }

    /// The shot waits again; its sights go.
    pub(super) fn unplace(&mut self, shot_ix: usize) {
        for landmark in self.landmarks_of(&[shot_ix]) {
            self.retain_sights(landmark, |s| s.0 as usize != shot_ix);
        }
        if let Some(placed) = self.shots[shot_ix].placed.take() {
            self.components[placed.component as usize]
                .shots
                .retain(|&s| s != shot_ix);
        }
    }

    pub(super) fn add_landmark(
        &mut self,
        point: DVec3,
        component: u32,
        seen: Vec<(u32, u32)>,
    ) -> u32 {
        let ix = self.landmarks.len() as u32;
        for &(shot, feature) in &seen {
            self.shots[shot as usize].landmark_of[feature as usize] = ix;
        }
        self.landmarks.push(Landmark {
            point,
            component,
            seen,
        });
        ix
    }

    /// Adds a sight unless its shot sees the landmark already.
    pub(super) fn add_sight(&mut self, landmark_ix: u32, at: (u32, u32)) -> bool {
        let landmark = &mut self.landmarks[landmark_ix as usize];
        if landmark.seen.iter().any(|s| s.0 == at.0) {
            return false;
        }
        landmark.seen.push(at);
        self.shots[at.0 as usize].landmark_of[at.1 as usize] = landmark_ix;
        true
    }

    /// Keeps the sights that `keep` names; a landmark left with one sight goes.
    pub(super) fn retain_sights(&mut self, landmark_ix: u32, keep: impl Fn(&(u32, u32)) -> bool) {
        let landmark = &mut self.landmarks[landmark_ix as usize];
        let (kept, gone): (Vec<_>, Vec<_>) = landmark.seen.iter().partition(|s| keep(s));
        let (kept, gone) = if kept.len() < 2 {
            (Vec::new(), landmark.seen.clone())
        } else {
            (kept, gone)
        };
        landmark.seen = kept;
        for (shot, feature) in gone {
            self.shots[shot as usize].landmark_of[feature as usize] = NONE;
        }
    }

    /// Joins `gone` into `stays`; sights of shots that `stays` has already are dropped.
    pub(super) fn join_landmarks(&mut self, stays: u32, gone: u32) {
        let moved = std::mem::take(&mut self.landmarks[gone as usize].seen);
        for at in moved {
            self.shots[at.0 as usize].landmark_of[at.1 as usize] = NONE;
            self.add_sight(stays, at);
        }
    }

    /// Landmarks seen by any of the shots, in order.
    pub(super) fn landmarks_of(&self, shots: &[usize]) -> Vec<u32> {
        let all = shots
            .iter()
            .flat_map(|&s| self.shots[s].landmark_of.iter().copied());
        let mut found: Vec<u32> = all.filter(|&l| l != NONE).collect();
        found.sort_unstable();
        found.dedup();
        found
    }

    /// How many landmarks every other shot shares with one, by shot index.
    pub(super) fn shared_counts(&self, shot_ix: usize) -> BTreeMap<usize, u32> {
        let mut counts = BTreeMap::new();
        for &landmark in self.shots[shot_ix]
            .landmark_of
            .iter()
            .filter(|l| **l != NONE)
        {
            for &(other, _) in &self.landmarks[landmark as usize].seen {
                if other as usize != shot_ix {
                    *counts.entry(other as usize).or_insert(0) += 1;
                }
            }
        }
        counts
    }

    /// Takes a component apart again: its shots wait, its landmarks go.
    pub(super) fn dissolve(&mut self, component: u32) {
        let shots = std::mem::take(&mut self.components[component as usize].shots);
        for landmark in self.landmarks_of(&shots) {
            self.retain_sights(landmark, |_| false);
        }
        for shot in shots {
            self.shots[shot].placed = None;
        }
        // The number is given again as long as nothing came after it.
        if component as usize + 1 == self.components.len() {
            self.components.pop();
        }
    }

    /// Moves all of a component by `new_from_old`.
    pub(super) fn transform(&mut self, component: u32, new_from_old: &Similarity) {
        let shots = self.components[component as usize].shots.clone();
        for landmark in self.landmarks_of(&shots) {
            let point = &mut self.landmarks[landmark as usize].point;
            *point = new_from_old.transform_point(*point);
        }
        for shot in shots {
            if let Some(placed) = &mut self.shots[shot].placed {
                placed.cam_from_map = new_from_old
                    .transform_pose(&placed.cam_from_map.inverse())
                    .inverse();
            }
        }
    }

    /// Distances from a shot to the landmarks it sees, along its axis.
    pub(super) fn depths(&self, shot_ix: usize) -> Vec<f64> {
        let shot = &self.shots[shot_ix];
        let Some(placed) = &shot.placed else {
            return Vec::new();
        };
        let seen = shot.landmark_of.iter().filter(|l| **l != NONE);
        seen.map(|&l| {
            placed
                .cam_from_map
                .transform_point(self.landmarks[l as usize].point)
                .z
        })
        .collect()
    }
}
