//! The embedded geometry model: batches of keyframes -> poses and landmarks, then depth by stereo.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use crate::answer::{GeometryBatch, View};
use crate::error::GeometryError;
use crate::features::descriptor::working_size;
use crate::matching::PreparedDescriptors;
use crate::model::{DepthTask, GeometryModel, Work};
use crate::mvs::depth_stream::SweptDepth;
use crate::mvs::params::MvsParams;
use crate::sfm::adjust::adjust_global;
use crate::sfm::calibrate::{MIN_UNCALIBRATED, current_share, start_uncalibrated};
use crate::sfm::close_loops::{release_waiting, settle};
use crate::sfm::dense_depth::{Densifier, NextDepth};
use crate::sfm::finder::{Finder, Found};
use crate::sfm::global_adjustment::{AdjustedSubmap, GlobalAdjustment};
use crate::sfm::gyroscope::turn_since;
use crate::sfm::initialize::{Start, start};
use crate::sfm::join_submaps::join_by_odometry;
use crate::sfm::limits::Limits;
use crate::sfm::merge_submaps::merge;
use crate::sfm::metric_submap::metric_unit;
use crate::sfm::pairwise::{link_alike, link_anew, link_last, link_older, link_recent};
use crate::sfm::params::SfmParams;
use crate::sfm::reconstruction::{NONE, OdometryNoise, Reconstruction, SfmView, Submap};
use crate::sfm::register::{grow, grow_at_once, release_clearer};
use crate::sfm::undistorted_views::{links_are_stale, undistort_images};
use crate::sfm::updates::{self, Reported, SparseBatch, note};
use splat_types::camera::Intrinsics;
use splat_types::frame::{Batch, Keyframe};
use splat_types::load_shed::LoadShed;

/// Size of the image that `sfm.max_error_px` is meant for.
const ERROR_SIDE_PX: f64 = 640.0;
/// Keyframes that a submap beside the first one needs; less is likelier a mistake than a place.
const MIN_NEW_SUBMAP: usize = 4;
/// Waiting keyframes that are tried with every batch, the newest; all others once more at the end.
const MAX_WAITING: usize = 64;
/// Live: views that may wait for what they have seen long ago to be looked for, as many as links that agree on a loop may lie
/// apart. Of more, the oldest do without.
const MAX_BEHIND: usize = 24;
/// Live: when so many keyframes have gathered, each gets less effort, so that the next ones wait less: so large a share of
/// `sfm.max_features`, and matches with so many keyframes before it.
const MANY_NEW: usize = 2;
const FEATURES_OF_MANY: f64 = 0.65;
const N_LAST_OF_MANY: usize = 4;
/// Steps of the adjustment of a submap that has grown.
const N_GROWN_STEPS: usize = 8;
/// Focal length of an uncalibrated camera before it is known, as a share of the longer side.
const FIRST_FOCAL: f64 = 0.9;

/// The embedded geometry model.
#[derive(Debug)]
pub struct Sfm {
    sfm: SfmParams,
    finder: Finder,
    pub(crate) densifier: Densifier,
    seed: u64,
    pub(crate) scene: Reconstruction,
    pub(crate) reported: Reported,
    pub(crate) batch_id: u32,
    last_start: Option<Start>,
    /// A loop was closed since the last report.
    is_loop: bool,
    live: LiveState,
}

/// What only a live run has.
#[derive(Debug, Default)]
struct LiveState {
    /// Poses come by `sparse_soon`, until the end: submaps are adjusted as a whole by `GlobalAdjustment`.
    is_on: bool,
    /// Views that are not yet compared with those long before them.
    behind: Vec<usize>,
    /// What the newest adjustment has found.
    adjusted: Arc<Mutex<Option<AdjustedSubmap>>>,
    load_shed: LoadShed,
}

/// What is done for each new keyframe.
#[derive(Clone, Copy)]
struct Effort {
    max_features: usize,
    /// Keyframes just before it that it is matched with.
    n_last: usize,
    /// Whether the second camera's image of all but the newest is looked at.
    all_seconds: bool,
}

impl Sfm {
    /// An error where the parameters insist on a GPU or a network that is not there.
    pub fn new(sfm: &SfmParams, mvs: &MvsParams, seed: u64) -> Result<Self, GeometryError> {
        Ok(Self {
            sfm: sfm.clone(),
            finder: Finder::new(sfm)?,
            densifier: Densifier::new(mvs, sfm.depth_noise)?,
            seed,
            scene: Reconstruction {
                odometry_noise: OdometryNoise::new(sfm),
                ..Reconstruction::default()
            },
            reported: Reported::default(),
            batch_id: 0,
            last_start: None,
            is_loop: false,
            live: LiveState::default(),
        })
    }

    /// The same with the depth or the second images that keyframes bring, which give poses, landmarks and dense depth in metres.
    pub fn with_sensors(mut self) -> Self {
        self.finder.uses_sensors = true;
        self
    }

    /// Takes a batch; keyframes seen before are only reported again.
    pub fn sparse(&mut self, batch: &Batch) -> SparseBatch {
        self.batch_id = batch.id;
        let limits = self.take_in(&batch.keyframes);
        self.catch_up(&limits);
        let shared = self.shared_views(batch);
        self.report(&shared)
    }

    /// The same sooner: places that were seen long ago and the adjustment of all wait until `refine`, unless they are needed
    /// to register the new keyframes.
    fn sparse_soon(&mut self, batch: &Batch) -> SparseBatch {
        self.batch_id = batch.id;
        self.live.is_on = true;
        let first_new = self.scene.views.len();
        let n_new = batch.keyframes.len().saturating_sub(batch.n_shared);
        let effort = if n_new >= MANY_NEW {
            self.live.load_shed.hurried_keyframes += n_new as u64;
            Effort {
                max_features: (self.sfm.max_features as f64 * FEATURES_OF_MANY) as usize,
                n_last: N_LAST_OF_MANY,
                all_seconds: false,
            }
        } else {
            self.full_effort()
        };
        let link = |scene: &mut Reconstruction, newest, max_error_px, seed| {
            link_last(scene, newest, effort.n_last, max_error_px, seed);
        };
        let limits = self.take_in_with(&batch.keyframes, effort, link);
        self.live.behind.extend(first_new..self.scene.views.len());
        let fresh: Vec<usize> = (first_new..self.scene.views.len()).collect();
        grow_at_once(&mut self.scene, &fresh, &limits);
        let is_missing = |ix: &usize| self.scene.views[*ix].registered.is_none();
        let missing: Vec<usize> = fresh.into_iter().filter(is_missing).collect();
        if !missing.is_empty() {
            self.live.behind.retain(|ix| !missing.contains(ix));
            self.link_older(&missing, &limits);
            self.place_newest(&limits);
        }
        // Their neighbours stand for those that no time was left for.
        let n_left_out = self.live.behind.len().saturating_sub(MAX_BEHIND);
        self.live.load_shed.unsought_keyframes += n_left_out as u64;
        self.live.behind.drain(..n_left_out);
        let shared = self.shared_views(batch);
        self.report(&shared)
    }

    /// Some of what `sparse_soon` has left, in slices, since new keyframes wait meanwhile: what one view has seen long ago.
    /// `None`: nothing is left.
    fn refined(&mut self) -> Option<SparseBatch> {
        if self.live.behind.is_empty() {
            return None;
        }
        let limits = self.newest_limits();
        let next = self.live.behind.remove(0);
        self.link_older(&[next], &limits);
        self.place_newest(&limits);
        Some(self.report(&[]))
    }

    /// The adjustment of a submap that has grown, for another thread.
    fn next_adjustment(&mut self) -> Option<GlobalAdjustment> {
        let grown = self.grown().next()?;
        let max_error_px = self.newest_limits().max_error_px;
        GlobalAdjustment::of(&mut self.scene, grown, max_error_px, N_GROWN_STEPS)
    }

    fn take_adjusted(&mut self) -> Option<SparseBatch> {
        let adjusted = self.live.adjusted.lock();
        let adjusted = adjusted.unwrap_or_else(PoisonError::into_inner).take()?;
        let limits = self.newest_limits();
        let is_applied = adjusted.apply(&mut self.scene, &limits);
        is_applied.then(|| self.report(&[]))
    }

    fn newest_limits(&self) -> Limits {
        let newest = self.scene.views.last().map(|v| Arc::clone(&v.keyframe));
        self.limits(newest.as_slice())
    }

    /// Registers what waits by all links, closes loops, and adjusts what has grown.
    fn catch_up(&mut self, limits: &Limits) {
        self.place_newest(limits);
        for submap in self.grown().collect::<Vec<u32>>() {
            adjust_global(&mut self.scene, submap, limits.max_error_px, N_GROWN_STEPS);
        }
    }

    fn place_newest(&mut self, limits: &Limits) {
        let waiting = self.waiting();
        let newest = &waiting[waiting.len().saturating_sub(MAX_WAITING)..];
        self.place_waiting(newest, limits, MIN_NEW_SUBMAP);
    }

    fn link_older(&mut self, views: &[usize], limits: &Limits) {
        for &view_ix in views {
            link_older(&mut self.scene, view_ix, limits.max_error_px, self.seed);
        }
    }

    /// Last chance for what waits, then all is adjusted together.
    pub fn finish_sparse(&mut self) -> SparseBatch {
        self.live.is_on = false;
        let keyframes: Vec<Arc<Keyframe>> = self
            .scene
            .views
            .iter()
            .map(|s| Arc::clone(&s.keyframe))
            .collect();
        let limits = self.limits(&keyframes);
        let behind = std::mem::take(&mut self.live.behind);
        self.link_older(&behind, &limits);
        let waiting = self.waiting();
        for &view in &waiting {
            self.scene.views[view].failed_with = 0;
            link_alike(&mut self.scene, view, limits.max_error_px, self.seed);
        }
        // What did not fit then may fit now that all is adjusted.
        self.scene.unmerged.extend(0..self.scene.views.len());
        self.place_waiting(&waiting, &limits, 3);
        for submap in 0..self.scene.submaps.len() as u32 {
            adjust_global(&mut self.scene, submap, limits.max_error_px, 30);
        }
        let unmatched = self.densifier.unmatched();
        let again: Vec<usize> = unmatched
            .iter()
            .filter_map(|id| self.scene.view_of(*id))
            .collect();
        self.report(&again)
    }

    fn report(&mut self, again: &[usize]) -> SparseBatch {
        let all: Vec<usize>;
        let again = if undistort_images(&mut self.scene) {
            all = (0..self.scene.views.len()).collect();
            &all
        } else {
            again
        };
        let mut out = self.reported.changes(&self.scene, again);
        out.batch_id = self.batch_id;
        out.is_loop = std::mem::take(&mut self.is_loop);
        out.metric = metric_unit(&self.scene);
        out.note = note(&self.scene, self.last_start);
        out
    }

    fn full_effort(&self) -> Effort {
        Effort {
            max_features: self.sfm.max_features,
            n_last: usize::MAX,
            all_seconds: true,
        }
    }

    /// Makes views of the keyframes that are new, and links them to those before.
    pub(crate) fn take_in(&mut self, keyframes: &[Arc<Keyframe>]) -> Limits {
        let link = |scene: &mut Reconstruction, newest, max_error_px, seed| {
            link_recent(scene, newest, max_error_px, seed);
            link_older(scene, newest, max_error_px, seed);
        };
        self.take_in_with(keyframes, self.full_effort(), link)
    }

    /// Makes views of the keyframes that are new, and calls `link` with each, the limit of errors and a seed.
    fn take_in_with(
        &mut self,
        keyframes: &[Arc<Keyframe>],
        effort: Effort,
        link: impl Fn(&mut Reconstruction, usize, f64, u64),
    ) -> Limits {
        let limits = self.limits(keyframes);
        let fresh: Vec<&Arc<Keyframe>> = keyframes
            .iter()
            .filter(|k| self.scene.view_of(k.id).is_none())
            .collect();
        let finder = &self.finder;
        let newest = fresh.last().map(|keyframe| keyframe.id);
        let look = |keyframe: &&Arc<Keyframe>| {
            let with_second = effort.all_seconds || Some(keyframe.id) == newest;
            finder.look_at(&keyframe.frame, effort.max_features, with_second)
        };
        let found: Vec<Found> = fresh.par_iter().map(look).collect();
        for (keyframe, found) in fresh.into_iter().zip(found) {
            self.push(keyframe, found);
            let newest = self.scene.views.len() - 1;
            link(&mut self.scene, newest, limits.max_error_px, self.seed);
        }
        self.scene.let_go();
        limits
    }

    /// Views of the keyframes that the batch before had, too.
    pub(crate) fn shared_views(&self, batch: &Batch) -> Vec<usize> {
        let shared = batch.keyframes.iter().take(batch.n_shared);
        shared.filter_map(|k| self.scene.view_of(k.id)).collect()
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
            local_ba_prior: self.sfm.local_ba_prior,
            is_global_deferred: self.live.is_on,
            seed: self.seed,
        }
    }

    /// Adds a view.
    fn push(&mut self, keyframe: &Arc<Keyframe>, found: Found) {
        let Found {
            features: found,
            size: (w, h),
            measured,
        } = found;
        let image = &keyframe.frame.image;
        let known = keyframe.frame.intrinsics.filter(Intrinsics::is_plausible);
        let lens = known
            .unwrap_or_else(|| self.guessed_lens(image.width_px, image.height_px))
            .resized(w, h);
        let distorted_pixels = match known {
            Some(_) => Vec::new(),
            None => found.pixels.clone(),
        };
        let mut view = SfmView {
            keyframe: Arc::clone(keyframe),
            distorted_pixels,
            signature: PreparedDescriptors::new(&found.signature()),
            lens,
            is_calibrated: known.is_some(),
            registered: None,
            measured,
            gyro: turn_since(self.scene.views.last(), keyframe),
            landmark_of: vec![NONE; found.len()],
            matched: vec![Vec::new(); found.len()],
            failed_with: 0,
            features: found,
        };
        view.undistort(self.scene.radial);
        self.scene.views.push(view);
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

    /// Starts a submap of the waiting views, if there are enough of them.
    fn try_start(&mut self, pool: &[usize], min_views: usize, limits: &Limits) -> Option<Start> {
        let is_first = self.scene.submaps.is_empty();
        let waiting = pool
            .iter()
            .filter(|&&s| self.scene.views[s].registered.is_none());
        let n_uncalibrated = waiting
            .clone()
            .filter(|&&s| !self.scene.views[s].is_calibrated)
            .count();
        let n_waiting = waiting.count();
        let needed = if is_first {
            pool.len().min(3)
        } else {
            min_views
        };
        if n_waiting < needed.max(2) {
            return None;
        }
        if !is_first || n_uncalibrated == 0 {
            return Some(start(&mut self.scene, pool, needed, limits));
        }
        let is_last_chance = min_views < MIN_NEW_SUBMAP;
        if n_waiting < MIN_UNCALIBRATED && !is_last_chance {
            return None;
        }
        let guess = (self.sfm.focal_guess > 0.0)
            .then(|| current_share(&self.scene))
            .flatten();
        Some(start_uncalibrated(&mut self.scene, pool, guess, limits))
    }

    fn waiting(&self) -> Vec<usize> {
        (0..self.scene.views.len())
            .filter(|&s| self.scene.views[s].registered.is_none())
            .collect()
    }

    fn place_waiting(&mut self, pool: &[usize], limits: &Limits, min_views: usize) {
        release_clearer(&mut self.scene);
        grow(&mut self.scene, pool, limits);
        release_waiting(&mut self.scene);
        grow(&mut self.scene, pool, limits);
        while let Some(outcome) = self.try_start(pool, min_views, limits) {
            self.last_start = Some(outcome);
            if outcome != Start::Started {
                break;
            }
        }
        if links_are_stale(&mut self.scene, limits.max_error_px) {
            link_anew(&mut self.scene, limits.max_error_px, self.seed);
            for submap in 0..self.scene.submaps.len() as u32 {
                adjust_global(&mut self.scene, submap, limits.max_error_px, 15);
            }
            grow(&mut self.scene, pool, limits);
        }
        let max_loop_correction = self.sfm.loops.then_some(self.sfm.max_loop_correction);
        self.is_loop |= settle(&mut self.scene, limits, max_loop_correction);
        while merge(&mut self.scene, limits) || join_by_odometry(&mut self.scene, limits) {
            grow(&mut self.scene, pool, limits);
        }
    }

    /// Submaps whose views should be adjusted together, since there are so many more of them.
    fn grown(&self) -> impl Iterator<Item = u32> {
        let submaps = (0..).zip(&self.scene.submaps);
        let is_grown = |size: &Submap| {
            let n_views = size.views.len();
            n_views > 0 && n_views as f64 >= 1.1 * size.n_adjusted as f64
        };
        submaps
            .filter(move |(_, size)| is_grown(size))
            .map(|(submap, _)| submap)
    }

    pub(crate) fn densify(&mut self, sparse: &SparseBatch) -> GeometryBatch {
        let scene = &self.scene;
        self.densifier.densify(sparse, &|id| scene.image_of(id))
    }
}

impl Sfm {
    fn with_poses(&mut self, sparse: &SparseBatch) -> GeometryBatch {
        let scene = &self.scene;
        GeometryBatch {
            load_shed: self.live.load_shed,
            ..self.densifier.poses(sparse, &|id| scene.image_of(id))
        }
    }

    fn with_depth(&self, view: View) -> GeometryBatch {
        GeometryBatch {
            batch_id: self.batch_id,
            views: vec![view],
            load_shed: self.live.load_shed,
            ..GeometryBatch::default()
        }
    }
}

impl GeometryModel for Sfm {
    fn has_depth_of_poses(&self) -> bool {
        true
    }

    fn accepts_small_batches(&self) -> bool {
        true
    }

    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError> {
        let sparse = self.sparse(batch);
        Ok(self.densify(&sparse))
    }

    fn poses(&mut self, batch: &Batch) -> Option<GeometryBatch> {
        let sparse = self.sparse_soon(batch);
        Some(self.with_poses(&sparse))
    }

    fn refine(&mut self) -> Option<GeometryBatch> {
        let sparse = self.refined()?;
        Some(self.with_poses(&sparse))
    }

    fn adjustment(&mut self) -> Option<Work> {
        let work = self.next_adjustment()?;
        let found = Arc::clone(&self.live.adjusted);
        Some(Box::new(move || {
            let adjusted = work.run();
            *found.lock().unwrap_or_else(PoisonError::into_inner) = Some(adjusted);
        }))
    }

    fn take_adjustment(&mut self) -> Option<GeometryBatch> {
        let sparse = self.take_adjusted()?;
        Some(self.with_poses(&sparse))
    }

    fn depth(&mut self) -> Option<DepthTask> {
        let scene = &self.scene;
        let view_of = |id| updates::view(scene, scene.view_of(id)?);
        Some(match self.densifier.next(&view_of)? {
            NextDepth::Known(view) => DepthTask::Known(self.with_depth(*view)),
            NextDepth::Sweep(job) => DepthTask::Sweep(job),
        })
    }

    fn take_depth(&mut self, swept: SweptDepth) -> Option<GeometryBatch> {
        let view = self.densifier.take(swept)?;
        Some(self.with_depth(view))
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        let sparse = self.finish_sparse();
        Ok(self.densify(&sparse))
    }
}

#[cfg(test)]
mod tests;
