//! Keyframes in order -> their poses and a sparse set of landmarks: streaming structure from motion.
//!
//! Nothing is guessed: a keyframe that cannot be placed waits and is tried again with every later batch. Keyframes
//! that no placed one shares enough with may start a component of their own, which is merged when a link turns up.

mod adjusting;
mod calibrating;
mod densify;
mod landmarks;
mod links;
mod looping;
mod merging;
mod placing;
pub mod posed;
mod report;
mod scene;
mod starting;
mod straightening;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use rayon::prelude::*;

pub use report::{NO_PARALLAX, Neighbour, Sighting, SparseBatch, SparseView};

use self::adjusting::adjust_global;
use self::calibrating::{MIN_UNCALIBRATED, current_share, start_uncalibrated};
use self::densify::Densifier;
use self::links::{link_alike, link_anew, link_newest};
use self::looping::{release_waiting, settle};
use self::merging::merge;
use self::placing::grow;
use self::report::{Told, note};
use self::scene::{NONE, Scene, Shot};
use self::starting::{Start, start};
use self::straightening::{links_are_stale, straighten_pictures};
use crate::camera::Intrinsics;
use crate::config::{MvsParams, OldPoses, SfmParams};
use crate::frame::{Batch, Keyframe};
use crate::geometry::features::{Features, Finder, working_picture, working_size};
use crate::geometry::matching::Comparable;
use crate::geometry::{GeometryBatch, GeometryError, GeometryModel};

/// Size of the picture that `sfm.max_error_px` is meant for.
const ERROR_SIDE_PX: f64 = 640.0;
/// Keyframes that a component beside the first one needs; less is likelier a mistake than a place.
const MIN_NEW_COMPONENT: usize = 4;
/// Waiting keyframes that are tried with every batch, the newest; all others once more at the end.
const MAX_WAITING: usize = 64;
/// Keyframes whose pictures are held, more than stereo reaches back; and twice as many that have no place.
const MAX_PICTURES: usize = 128;
/// Focal length of an uncalibrated camera before it is known, as a share of the longer side.
const FIRST_FOCAL: f64 = 0.9;

/// `SfmParams` in pixels of the working picture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    max_error_px: f64,
    min_inliers: usize,
    min_parallax_deg: f64,
    old_poses: OldPoses,
    seed: u64,
}

/// The embedded geometry model.
#[derive(Debug)]
pub struct Sfm {
    sfm: SfmParams,
    finder: Finder,
    densifier: Densifier,
    seed: u64,
    scene: Scene,
    told: Told,
    batch_id: u32,
    last_start: Option<Start>,
    /// A loop was closed since the last report.
    is_loop: bool,
}

impl Sfm {
    /// An error where the parameters insist on a GPU or a network that is not there.
    pub fn new(sfm: &SfmParams, mvs: &MvsParams, seed: u64) -> Result<Self, GeometryError> {
        Ok(Self {
            sfm: sfm.clone(),
            finder: Finder::new(sfm)?,
            densifier: Densifier::new(mvs)?,
            seed,
            scene: Scene::default(),
            told: Told::default(),
            batch_id: 0,
            last_start: None,
            is_loop: false,
        })
    }

    /// Takes a batch; keyframes seen before are only reported again.
    pub fn sparse(&mut self, batch: &Batch) -> SparseBatch {
        self.batch_id = batch.id;
        let limits = self.take_in(&batch.keyframes);
        let waiting = self.waiting();
        let newest = &waiting[waiting.len().saturating_sub(MAX_WAITING)..];
        self.place_waiting(newest, &limits, MIN_NEW_COMPONENT);
        self.adjust_grown(&limits);
        let shared = self.shared_shots(batch);
        self.tell(&shared)
    }

    /// Last chance for what waits, then all is adjusted together.
    pub fn finish_sparse(&mut self) -> SparseBatch {
        let keyframes: Vec<Arc<Keyframe>> = self
            .scene
            .shots
            .iter()
            .map(|s| Arc::clone(&s.keyframe))
            .collect();
        let limits = self.limits(&keyframes);
        let waiting = self.waiting();
        for &shot in &waiting {
            self.scene.shots[shot].failed_with = 0;
            link_alike(&mut self.scene, shot, limits.max_error_px, self.seed);
        }
        self.place_waiting(&waiting, &limits, 3);
        for component in 0..self.scene.components.len() as u32 {
            adjust_global(&mut self.scene, component, limits.max_error_px, 30);
        }
        self.tell(&[])
    }

    fn tell(&mut self, again: &[usize]) -> SparseBatch {
        let all: Vec<usize>;
        let again = if straighten_pictures(&mut self.scene) {
            all = (0..self.scene.shots.len()).collect();
            &all
        } else {
            again
        };
        let mut out = self.told.changes(&self.scene, again);
        out.batch_id = self.batch_id;
        out.is_loop = std::mem::take(&mut self.is_loop);
        out.note = note(&self.scene, self.last_start);
        out
    }

    /// Makes shots of the keyframes that are new, and links them to those before.
    fn take_in(&mut self, keyframes: &[Arc<Keyframe>]) -> Limits {
        let limits = self.limits(keyframes);
        let fresh: Vec<&Arc<Keyframe>> = keyframes
            .iter()
            .filter(|k| self.shot_of(k.id).is_none())
            .collect();
        let looked = |keyframe: &&Arc<Keyframe>| {
            let picture = working_picture(&keyframe.frame.image, self.sfm.max_side);
            (
                self.finder.features(&picture, self.sfm.max_features),
                (picture.width as u32, picture.height as u32),
            )
        };
        let found: Vec<(Features, (u32, u32))> = fresh.par_iter().map(looked).collect();
        for (keyframe, (features, size)) in fresh.into_iter().zip(found) {
            self.push(keyframe, features, size);
            link_newest(&mut self.scene, limits.max_error_px, self.seed);
        }
        self.let_go();
        limits
    }

    /// Pictures that stereo has no use for any more leave memory; features and sizes stay.
    fn let_go(&mut self) {
        let n = self.scene.shots.len();
        for (ix, shot) in self.scene.shots.iter_mut().enumerate() {
            let is_old = shot.placed.is_some() && ix + MAX_PICTURES < n;
            let is_hopeless = ix + 2 * MAX_PICTURES < n;
            if (is_old || is_hopeless) && !shot.keyframe.frame.image.is_hollow() {
                shot.keyframe = Arc::new(shot.keyframe.hollow());
            }
        }
    }

    /// Shots of the keyframes that the batch before had, too.
    fn shared_shots(&self, batch: &Batch) -> Vec<usize> {
        let shared = batch.keyframes.iter().take(batch.n_shared);
        shared.filter_map(|k| self.shot_of(k.id)).collect()
    }

    fn limits(&self, keyframes: &[Arc<Keyframe>]) -> Limits {
        let longest = keyframes.iter().map(|k| {
            let (w, h) = working_size(
                k.frame.image.width_px,
                k.frame.image.height_px,
                self.sfm.max_side,
            );
            w.max(h)
        });
        let side = f64::from(longest.max().unwrap_or(self.sfm.max_side));
        Limits {
            max_error_px: self.sfm.max_error_px * side / ERROR_SIDE_PX,
            min_inliers: self.sfm.min_inliers,
            min_parallax_deg: self.sfm.min_parallax_deg,
            old_poses: self.sfm.old_poses,
            seed: self.seed,
        }
    }

    fn shot_of(&self, keyframe_id: u32) -> Option<usize> {
        // The newest are asked for most.
        self.scene
            .shots
            .iter()
            .rposition(|s| s.keyframe.id == keyframe_id)
    }

    /// Adds a shot whose features are given in a working picture of that size.
    fn push(&mut self, keyframe: &Arc<Keyframe>, found: Features, (w, h): (u32, u32)) {
        let image = &keyframe.frame.image;
        let known = keyframe.frame.intrinsics.filter(Intrinsics::is_plausible);
        let lens = known
            .unwrap_or_else(|| self.guessed_lens(image.width_px, image.height_px))
            .resized(w, h);
        let bent_pixels = match known {
            Some(_) => Vec::new(),
            None => found.pixels.clone(),
        };
        let mut shot = Shot {
            keyframe: Arc::clone(keyframe),
            bent_pixels,
            signature: Comparable::new(&found.signature()),
            lens,
            is_calibrated: known.is_some(),
            placed: None,
            landmark_of: vec![NONE; found.len()],
            matched: vec![Vec::new(); found.len()],
            failed_with: 0,
            features: found,
        };
        shot.straighten(self.scene.radial);
        self.scene.shots.push(shot);
    }

    fn guessed_lens(&self, width_px: u32, height_px: u32) -> Intrinsics {
        let (w, h) = (f64::from(width_px), f64::from(height_px));
        let guess = if self.sfm.focal_guess > 0.0 {
            self.sfm.focal_guess
        } else {
            FIRST_FOCAL * w.max(h)
        };
        let f = current_share(&self.scene).map_or(guess, |share| share * w.max(h));
        Intrinsics {
            width_px,
            height_px,
            fx: f,
            fy: f,
            cx: 0.5 * w,
            cy: 0.5 * h,
        }
    }

    /// Starts a component of the waiting shots, if there are enough of them.
    fn try_start(&mut self, pool: &[usize], min_shots: usize, limits: &Limits) -> Option<Start> {
        let is_first = self.scene.components.is_empty();
        let waiting = pool
            .iter()
            .filter(|&&s| self.scene.shots[s].placed.is_none());
        let n_uncalibrated = waiting
            .clone()
            .filter(|&&s| !self.scene.shots[s].is_calibrated)
            .count();
        let n_waiting = waiting.count();
        let needed = if is_first {
            pool.len().min(3)
        } else {
            min_shots
        };
        if n_waiting < needed.max(2) {
            return None;
        }
        if !is_first || n_uncalibrated == 0 {
            return Some(start(&mut self.scene, pool, needed, limits));
        }
        let is_last_chance = min_shots < MIN_NEW_COMPONENT;
        if n_waiting < MIN_UNCALIBRATED && !is_last_chance {
            return None;
        }
        let guess = (self.sfm.focal_guess > 0.0)
            .then(|| current_share(&self.scene))
            .flatten();
        Some(start_uncalibrated(&mut self.scene, pool, guess, limits))
    }

    fn waiting(&self) -> Vec<usize> {
        (0..self.scene.shots.len())
            .filter(|&s| self.scene.shots[s].placed.is_none())
            .collect()
    }

    fn place_waiting(&mut self, pool: &[usize], limits: &Limits, min_shots: usize) {
        grow(&mut self.scene, pool, limits);
        release_waiting(&mut self.scene);
        grow(&mut self.scene, pool, limits);
        while let Some(outcome) = self.try_start(pool, min_shots, limits) {
            self.last_start = Some(outcome);
            if outcome != Start::Started {
                break;
            }
        }
        if links_are_stale(&mut self.scene, limits.max_error_px) {
            link_anew(&mut self.scene, limits.max_error_px, self.seed);
            for component in 0..self.scene.components.len() as u32 {
                adjust_global(&mut self.scene, component, limits.max_error_px, 15);
            }
            grow(&mut self.scene, pool, limits);
        }
        let max_drift = self.sfm.loops.then_some(self.sfm.max_drift);
        self.is_loop |= settle(&mut self.scene, limits, max_drift);
        while merge(&mut self.scene, limits) {
            grow(&mut self.scene, pool, limits);
        }
    }

    /// All shots of a component together, when it grew enough to be worth it.
    fn adjust_grown(&mut self, limits: &Limits) {
        for component in 0..self.scene.components.len() as u32 {
            let size = &self.scene.components[component as usize];
            if size.shots.len() as f64 >= 1.1 * size.n_adjusted as f64 {
                adjust_global(&mut self.scene, component, limits.max_error_px, 8);
            }
        }
    }

    fn densify(&mut self, sparse: &SparseBatch) -> GeometryBatch {
        let scene = &self.scene;
        self.densifier.densify(sparse, &|id| scene.image_of(id))
    }
}

impl GeometryModel for Sfm {
    fn takes_small_batches(&self) -> bool {
        true
    }

    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let sparse = self.sparse(batch);
        Ok(self.densify(&sparse))
    }

    fn poses(&mut self, batch: &Batch) -> Option<GeometryBatch> {
        let sparse = self.sparse(batch);
        let scene = &self.scene;
        Some(self.densifier.poses(sparse, &|id| scene.image_of(id)))
    }

    fn depth(&mut self) -> Option<GeometryBatch> {
        let view = self.densifier.next()?;
        Some(GeometryBatch {
            batch_id: self.batch_id,
            views: vec![view],
            ..GeometryBatch::default()
        })
    }

    fn n_without_depth(&self) -> usize {
        self.densifier.n_waiting()
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        let sparse = self.finish_sparse();
        Ok(self.densify(&sparse))
    }
}
