//! Keyframes of the map: those that are registered, those that wait, and which of their images are in memory.
//!
//! A keyframe that leaves memory keeps its place, its camera and its splats. The newest stay; the others take turns. Before
//! that, depth of all but the newest is subsampled.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::DVec3;
use rand::{Rng, RngExt};

use crate::mapper::keyframes::image_codec::{self, Content, SavedView};
use crate::mapper::keyframes::metric_ratios;
use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::training_image::training_image;
use crate::mapper::metric_scale_params::ScaleParams;
use crate::mapper::pages::Paging;
use crate::mapper::params::MapperParams;
use crate::track::landmarks::TriangulatedLandmarks;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_geometry::answer::{Observations, View};
use splat_geometry::similarity;
use splat_types::depth::DepthMap;
use splat_types::frame::Keyframe;
use splat_types::image::RgbImage;
use splat_types::transform::{Rigid, Similarity};

/// The newest keyframes that never rest and, of those that memory has room for, the share that is for the newest.
const N_NEWEST: usize = 8;
const NEWEST_SHARE: f64 = 0.5;
/// The newest keyframes whose depth is whole. The model may still indicate them again, and it is they that seed.
const N_WHOLE_DEPTH: usize = 32;
/// Views may take one part of so many of `map.max_gpu_mib`; the rest is for splats.
const VIEWS_SHARE: usize = 2;
/// Steps between turns, and keyframes that come back in one.
pub(crate) const ROTATE_EVERY: u64 = 50;
const N_PER_ROTATION: usize = 2;

/// Everything that has come and may still be used, by keyframe id. Many methods: registration, paging and what
/// follows from both look at the same records.
#[derive(Debug, Clone)]
pub(crate) struct KeyframeStore {
    registered: BTreeMap<u32, RegisteredKeyframe>,
    /// Without a pose so far; the oldest go when there are too many.
    waiting: BTreeMap<u32, Arc<Keyframe>>,
    /// Median depth of the views, map units.
    scene_depth: f32,
    /// What the model says that poses may be off by: radians, and map units.
    pose_error: [f32; 2],
    /// Number of the turn that images take.
    turn: u64,
    n_lost: u64,
    peak_resident: usize,
}

impl Default for KeyframeStore {
    fn default() -> Self {
        Self {
            registered: BTreeMap::new(),
            waiting: BTreeMap::new(),
            scene_depth: 1.0,
            pose_error: [0.0; 2],
            turn: 0,
            n_lost: 0,
            peak_resident: 0,
        }
    }
}

impl KeyframeStore {
    /// Remembers keyframes until they are registered; beyond `max_waiting` the oldest are given up,
    /// whose ids are returned.
    pub(crate) fn remember(&mut self, keyframes: &[Arc<Keyframe>], max_waiting: usize) -> Vec<u32> {
        let mut given_up = Vec::new();
        for keyframe in keyframes {
            if !self.registered.contains_key(&keyframe.id) {
                self.waiting.insert(keyframe.id, Arc::clone(keyframe));
            }
        }
        while self.waiting.len() > max_waiting {
            if let Some((id, _)) = self.waiting.pop_first() {
                given_up.push(id);
            }
        }
        given_up
    }

    /// From the poses that the model gave to where the same cameras stand; `map_poses` by view index.
    pub(crate) fn world_from_submap(&self, map_poses: &[Rigid]) -> Similarity {
        let pairs = self.pose_pairs(map_poses, &BTreeSet::new());
        similarity::of_poses(&pairs).unwrap_or(Similarity::IDENTITY)
    }

    /// (pose in the map, pose in the model's frame) of all that are optimised, else of all, but for the ids `without`;
    /// `map_poses` by view index.
    pub(crate) fn pose_pairs(
        &self,
        map_poses: &[Rigid],
        without: &BTreeSet<u32>,
    ) -> Vec<(Rigid, Rigid)> {
        let no_choice = self.registered.values().all(|p| p.is_held_out);
        self.registered
            .iter()
            .filter(|(id, p)| (no_choice || !p.is_held_out) && !without.contains(id))
            .map(|(_, p)| (map_poses[p.view_ix].inverse(), p.submap_from_cam))
            .collect()
    }

    pub(crate) fn registered(&self) -> &BTreeMap<u32, RegisteredKeyframe> {
        &self.registered
    }

    pub(crate) fn get_mut(&mut self, id: u32) -> Option<&mut RegisteredKeyframe> {
        self.registered.get_mut(&id)
    }

    pub(crate) fn values_mut(
        &mut self,
    ) -> impl DoubleEndedIterator<Item = &mut RegisteredKeyframe> {
        self.registered.values_mut()
    }

    pub(crate) fn insert(&mut self, id: u32, registered: RegisteredKeyframe) {
        self.registered.insert(id, registered);
    }

    pub(crate) fn is_waiting(&self, id: u32) -> bool {
        self.waiting.contains_key(&id)
    }

    pub(crate) fn take_waiting(&mut self, id: u32) -> Option<Arc<Keyframe>> {
        self.waiting.remove(&id)
    }

    /// All that are registered leave, with what they say of the scene; those that wait stay.
    pub(crate) fn take_registered(&mut self) -> Self {
        let fresh = Self::default();
        Self {
            registered: std::mem::take(&mut self.registered),
            scene_depth: std::mem::replace(&mut self.scene_depth, fresh.scene_depth),
            pose_error: std::mem::replace(&mut self.pose_error, fresh.pose_error),
            ..fresh
        }
    }

    /// What is registered elsewhere comes in beside what is registered here.
    pub(crate) fn absorb(&mut self, other: Self) {
        let [rotation_rad, translation] = other.pose_error;
        self.registered.extend(other.registered);
        self.note_pose_error(rotation_rad, translation);
        self.n_lost += other.n_lost;
        self.measure_scene();
    }

    /// The world has another unit: lengths are so many times as long in it.
    pub(crate) fn rescale(&mut self, factor: f64) {
        self.scene_depth = (f64::from(self.scene_depth) * factor) as f32;
        self.pose_error[1] = (f64::from(self.pose_error[1]) * factor) as f32;
        self.registered
            .values_mut()
            .for_each(|registered| registered.rescale(factor));
    }

    /// Focal lengths are so many times as long.
    pub(crate) fn refocus(&mut self, factor: f64) {
        for registered in self.registered.values_mut() {
            registered.intrinsics = registered.intrinsics.refocused(factor);
        }
    }

    /// At most so many stay in memory, the newest; the others go to disk. Returns how many images were lost.
    pub(crate) fn page_out_oldest(
        &mut self,
        most: usize,
        engine: &mut dyn Engine,
        paging: &mut Paging,
        metres: Option<&ScaleParams>,
    ) -> Result<u64, EngineError> {
        let n_over = self.n_resident().saturating_sub(most);
        let here = self.registered.iter().filter(|(_, p)| p.home.is_here);
        let ids: Vec<u32> = here.map(|(id, _)| *id).take(n_over).collect();
        for id in ids {
            self.page_out(id, engine, paging, metres)?;
        }
        Ok(std::mem::take(&mut self.n_lost))
    }

    pub(crate) fn note_lost(&mut self, n_images: u64) {
        self.n_lost += n_images;
    }

    pub(crate) fn scene_depth(&self) -> f32 {
        self.scene_depth
    }

    pub(crate) fn pose_error(&self) -> [f32; 2] {
        self.pose_error
    }

    /// The largest error that was stated counts: radians, and map units.
    pub(crate) fn note_pose_error(&mut self, rotation_rad: f32, translation: f32) {
        self.pose_error[1] = self.pose_error[1].max(translation);
        self.pose_error[0] = self.pose_error[0].max(rotation_rad);
    }

    pub(crate) fn measure_scene(&mut self) {
        let medians = self.registered.values().filter_map(|p| p.depth_fit.median);
        let mut medians: Vec<f32> = medians.collect();
        medians.sort_by(f32::total_cmp);
        if let Some(median) = medians.get(medians.len() / 2) {
            self.scene_depth = *median;
        }
    }

    /// Goes back to an earlier state; what was counted stays.
    pub(crate) fn restore(&mut self, good: &Self) {
        let counted = (self.turn, self.n_lost, self.peak_resident);
        self.clone_from(good);
        (self.turn, self.n_lost, self.peak_resident) = counted;
    }

    /// Images that were lost, and the most keyframes that were in memory.
    pub(crate) fn counts(&self) -> (u64, usize) {
        (self.n_lost, self.peak_resident)
    }

    /// Views to train on: in memory, not held out, and with all that they show in memory, too; in order of arrival.
    pub(crate) fn trainable(&self) -> Vec<usize> {
        let is_fit = |p: &&RegisteredKeyframe| p.home.is_here && !p.is_held_out && !p.home.rests;
        let mut views: Vec<usize> = self
            .registered
            .values()
            .filter(is_fit)
            .map(|p| p.view_ix)
            .collect();
        views.sort_unstable();
        views
    }

    /// Notes which keyframes show a part of the map that is on disk; the newest never do.
    pub(crate) fn mark_paged_out(&mut self, shows: impl Fn(u32, &RegisteredKeyframe) -> bool) {
        let newest = self.newest_ids(N_NEWEST);
        for (id, registered) in &mut self.registered {
            registered.home.rests = !newest.contains(id) && shows(*id, registered);
        }
    }

    pub(crate) fn is_resident(&self, id: u32) -> bool {
        let registered = self.registered.get(&id);
        registered.is_some_and(|p| p.home.is_here)
    }

    /// Of every keyframe from the newest ones.
    pub(crate) fn distances(
        &self,
        engine: &mut dyn Engine,
    ) -> Result<BTreeMap<u32, f64>, EngineError> {
        let map_poses = engine.poses()?;
        let place = |view_ix: usize| map_poses[view_ix].inverse().translation;
        let newest = self.registered.values().rev().take(N_NEWEST);
        let newest: Vec<DVec3> = newest.map(|p| place(p.view_ix)).collect();
        let nearest = |at: DVec3| {
            let away = newest.iter().map(|other| (at - *other).length());
            away.fold(f64::INFINITY, f64::min)
        };
        Ok(self
            .registered
            .iter()
            .map(|(id, p)| (*id, nearest(place(p.view_ix))))
            .collect())
    }

    /// Keeps as many keyframes in memory as there may be, less room for those that come. Returns whether any has left.
    pub(crate) fn enforce_budget(
        &mut self,
        n_coming: usize,
        params: &MapperParams,
        engine: &mut dyn Engine,
        paging: &mut Paging,
        metres: Option<&ScaleParams>,
    ) -> Result<bool, EngineError> {
        let n_here = self.n_resident();
        self.peak_resident = self.peak_resident.max(n_here);
        let most = self.max_resident(params).saturating_sub(n_coming);
        let n_over = n_here.saturating_sub(most);
        for id in self.leaving(n_over, params) {
            self.page_out(id, engine, paging, metres)?;
        }
        Ok(n_over > 0)
    }

    /// Depth is most of what a keyframe takes, and behind the newest it only guides a loss.
    pub(crate) fn subsample_old_depth(
        &mut self,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let registered = self.registered.values_mut().rev();
        for registered in registered.skip(N_WHOLE_DEPTH) {
            let depth = &registered.depth;
            if depth.width_px.max(depth.height_px) > image_codec::MAX_DEPTH_SIDE {
                registered.depth = Arc::new(image_codec::subsampled(depth));
                let depth = Arc::clone(&registered.depth);
                engine.set_depth(registered.view_ix, Some(depth))?;
            }
        }
        Ok(())
    }

    /// Some that are on disk take the place of those that have been here longest: the nearest, and any. Returns whether
    /// any may have.
    pub(crate) fn rotate(
        &mut self,
        params: &MapperParams,
        engine: &mut dyn Engine,
        paging: &mut Paging,
        metres: Option<&ScaleParams>,
        rng: &mut impl Rng,
    ) -> Result<bool, EngineError> {
        let is_away =
            |p: &RegisteredKeyframe| !p.home.is_here && !p.is_held_out && p.home.copy.is_some();
        if !self.registered.values().any(is_away) {
            return Ok(false);
        }
        let away = self.distances(engine)?;
        let mut waiting: Vec<(f64, u32)> = self
            .registered
            .iter()
            .filter(|(_, p)| is_away(p) && !p.home.rests)
            .map(|(id, _)| (away.get(id).copied().unwrap_or(f64::INFINITY), *id))
            .collect();
        if waiting.is_empty() {
            return Ok(false);
        }
        waiting.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut coming = vec![waiting[0].1];
        while coming.len() < N_PER_ROTATION.min(waiting.len()) {
            let any = waiting[rng.random_range(0..waiting.len())].1;
            if !coming.contains(&any) {
                coming.push(any);
            }
        }
        self.turn += 1;
        let n_over = (self.n_resident() + coming.len()).saturating_sub(self.max_resident(params));
        for id in self.leaving(n_over, params) {
            self.page_out(id, engine, paging, metres)?;
        }
        coming.truncate(self.max_resident(params).saturating_sub(self.n_resident()));
        for id in coming {
            self.page_in(id, engine)?;
        }
        Ok(true)
    }

    /// Image and depth come into memory. Returns whether they are there.
    pub(crate) fn page_in(
        &mut self,
        id: u32,
        engine: &mut dyn Engine,
    ) -> Result<bool, EngineError> {
        let turn = self.turn;
        let Some(registered) = self.registered.get_mut(&id) else {
            return Ok(false);
        };
        let Some(content) = registered
            .home
            .copy
            .clone()
            .filter(|_| !registered.home.is_here)
        else {
            return Ok(registered.home.is_here);
        };
        let view = SavedView {
            keyframe_id: id,
            is_held_out: registered.is_held_out,
            content,
        };
        let size = (registered.image.width_px, registered.image.height_px);
        let (image, depth) = match view.unpacked(size) {
            Ok((image, depth)) => (Arc::new(image), registered.home.in_present_unit(depth)),
            Err(reason) => {
                tracing::warn!("the image of keyframe {id} is lost: {reason}");
                registered.home.copy = None;
                self.n_lost += 1;
                return Ok(false);
            }
        };
        registered.home.is_here = true;
        registered.home.since = turn;
        (registered.image, registered.depth) = (Arc::clone(&image), Arc::clone(&depth));
        engine.set_image(registered.view_ix, image, &registered.intrinsics)?;
        engine.set_depth(registered.view_ix, Some(depth))?;
        self.peak_resident = self.peak_resident.max(self.n_resident());
        Ok(true)
    }

    /// Image and depth leave memory; a packed copy is on disk, or they are lost.
    pub(crate) fn page_out(
        &mut self,
        id: u32,
        engine: &mut dyn Engine,
        paging: &mut Paging,
        metres: Option<&ScaleParams>,
    ) -> Result<(), EngineError> {
        let Some(registered) = self.registered.get(&id) else {
            return Ok(());
        };
        if registered.home.copy.is_none() {
            let packed = image_codec::pack(&registered.image, &registered.depth);
            let page = packed.ok().and_then(|bytes| paging.put(&bytes));
            self.n_lost += u64::from(page.is_none());
            if let Some(registered) = self.registered.get_mut(&id) {
                registered.home.copy = page.map(|page| Content::OnDisk(Arc::from(page)));
                registered.home.regrown = None;
            }
        }
        if let Some(registered) = self.registered.get_mut(&id) {
            // What it says of metres is measured by depth that goes.
            if let Some(params) = metres.filter(|_| registered.home.is_here) {
                metric_ratios::measure(registered, params);
            }
            registered.home.is_here = false;
            registered.keyframe = Arc::new(registered.keyframe.unloaded());
            let (w, h) = (registered.image.width_px, registered.image.height_px);
            registered.image = Arc::new(RgbImage::unloaded(w, h));
            registered.depth = Arc::new(DepthMap::none());
            engine.unload_view(registered.view_ix)?;
        }
        Ok(())
    }

    /// A keyframe of which the model reports once more: more neighbours have verified its depth since, unless it is out of
    /// reach.
    /// Returns whether it had no depth before.
    pub(crate) fn update_depth(
        &mut self,
        view: &View,
        depth: Arc<DepthMap>,
        max_side: u32,
        engine: &mut dyn Engine,
    ) -> Result<bool, EngineError> {
        let Some(registered) = self.registered.get_mut(&view.keyframe_id) else {
            return Ok(false);
        };
        registered.health = view.health;
        if !registered.home.is_here {
            return Ok(false);
        }
        if registered.lens != view.lens && !registered.keyframe.frame.image.is_unloaded() {
            let (image, pinhole) = training_image(&registered.keyframe, view, max_side);
            (registered.image, registered.intrinsics) = (Arc::clone(&image), pinhole);
            registered.lens = view.lens;
            registered.home.copy = None;
            engine.set_image(registered.view_ix, image, &pinhole)?;
        }
        if depth.width_px == 0 {
            return Ok(false);
        }
        let is_first = registered.depth.width_px == 0;
        if is_first {
            registered.depth_fit.n_looks = 0;
        }
        engine.set_depth(registered.view_ix, Some(Arc::clone(&depth)))?;
        (registered.depth_fit.median, registered.depth) = (depth.median(), depth);
        registered.depth_fit.log_metres = None;
        registered.home.copy = None;
        Ok(is_first)
    }

    /// Takes over what the model has triangulated; `unit`: that of the map in one of its depths.
    pub(crate) fn keep_landmarks(&mut self, observations: &[Observations], unit: f64) {
        for seen in observations {
            if let Some(registered) = self.registered.get_mut(&seen.keyframe_id) {
                registered.landmarks = TriangulatedLandmarks {
                    seen: seen.landmarks.as_slice().into(),
                    unit,
                };
            }
        }
    }

    /// Whether every keyframe has its image in memory.
    pub(crate) fn has_all_images(&self) -> bool {
        self.n_resident() == self.registered.len()
    }

    pub(crate) fn n_resident(&self) -> usize {
        let registered = self.registered.values();
        registered.filter(|p| p.home.is_here).count()
    }

    /// Keyframes that memory, and the engine's budget, have room for.
    pub(crate) fn max_resident(&self, params: &MapperParams) -> usize {
        let by_number = match params.map.max_resident_keyframes {
            0 => usize::MAX,
            n => n,
        };
        let budget = (params.map.max_gpu_mib << 20) as usize / VIEWS_SHARE;
        let by_bytes = match budget {
            0 => usize::MAX,
            budget => budget / self.bytes_of_view(),
        };
        by_number.min(by_bytes).max(N_NEWEST)
    }

    /// Bytes of `map.max_gpu_mib` that are kept for views that are still to come.
    pub(crate) fn bytes_for_views(&self, params: &MapperParams) -> u64 {
        let budget = (params.map.max_gpu_mib << 20) as usize / VIEWS_SHARE;
        let here = self.n_resident() * self.bytes_of_view();
        let most = self
            .max_resident(params)
            .saturating_mul(self.bytes_of_view());
        budget.min(most).saturating_sub(here) as u64
    }

    /// As the engine has one: four bytes a pixel, eight a depth. The largest of the newest that are in memory.
    fn bytes_of_view(&self) -> usize {
        let of_view =
            |p: &RegisteredKeyframe| 4 * p.image.pixels.len() / 3 + 8 * p.depth.depth.len();
        let registered = self.registered.values().rev();
        let here = registered.filter(|p| p.home.is_here).take(N_NEWEST);
        here.map(of_view).max().unwrap_or(1).max(1)
    }

    fn newest_ids(&self, n: usize) -> Vec<u32> {
        self.registered.keys().rev().take(n).copied().collect()
    }

    /// The next `n` to leave: held out ones and those that rest first, then those that have been here longest.
    fn leaving(&self, n: usize, params: &MapperParams) -> Vec<u32> {
        if n == 0 {
            return Vec::new();
        }
        let n_newest = (NEWEST_SHARE * self.max_resident(params) as f64) as usize;
        let newest = self.newest_ids(n_newest.max(N_NEWEST));
        let mut here: Vec<(bool, bool, u64, u32)> = self
            .registered
            .iter()
            .filter(|(_, p)| p.home.is_here)
            .map(|(id, p)| {
                let is_idle = p.is_held_out || p.home.rests;
                (newest.contains(id), !is_idle, p.home.since, *id)
            })
            .collect();
        here.sort_unstable();
        here.into_iter().take(n).map(|(.., id)| id).collect()
    }
}
