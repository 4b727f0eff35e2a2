//! The splats of the map beside the engine's own numbers: ids, budget, and what went to disk.
//!
//! More splats than the budget allows: those far from the camera go to disk, keyframe by keyframe, and come back when it is
//! near them again. Views that look at a region on disk are not trained on: they would fill the hole.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::DVec3;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::pages::Paging;
use crate::mapper::params::MapperParams;
use crate::mapper::splats::ids::SplatIds;
use crate::mapper::splats::region_codec::region_bytes;
use crate::mapper::splats::regions::Evicted;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_types::camera::Intrinsics;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Distances from the newest keyframes, in depths of the scene: what comes back, and what may go. A camera sees some two depths far.
const NEAR: f64 = 4.0;
const FAR: f64 = 6.0;
/// Room that is made beyond what is wanted, as a share of the cap: taking splats away costs a pass over all.
const SPARE: f64 = 0.05;
/// One part of so many of the cap is the most that is made free for new keyframes.
const MOST_WANTED: usize = 4;
/// Of a region: places that stand for it, those of them that a view must show, and how far off, in depths of the scene.
const N_SAMPLES: usize = 12;
const MIN_SEEN: usize = 3;
const SEEN_WITHIN: f64 = 6.0;

/// Share of the cap that is open when the first frames come; all of it is at the end of the input.
const FIRST_ROOM: f64 = 0.25;

/// Splats without those that have lost their numbers; an id and a count of updates each.
#[derive(Debug)]
pub(crate) struct FiniteSplats {
    pub(crate) splats: Splats,
    pub(crate) ids: Vec<u32>,
    pub(crate) update_counts: Vec<u16>,
}

/// What came and went, and the most that there was.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SplatCounts {
    pub(crate) n_evicted: u64,
    pub(crate) n_restored: u64,
    /// Times that splats were not added for the sake of `map.max_gpu_mib`.
    pub(crate) n_refused: u64,
    pub(crate) peak_splats: usize,
    pub(crate) peak_engine_bytes: u64,
    has_warned: bool,
}

/// What `plan` found: splats that must go, none nearer than a distance; distances of keyframes; regions that come back.
#[derive(Debug)]
pub(crate) struct Balance {
    pub(crate) n_over: usize,
    pub(crate) beyond: f64,
    pub(crate) away: BTreeMap<u32, f64>,
    back: Vec<u32>,
    most: usize,
}

/// All splats of the map, wherever they are.
#[derive(Debug, Default)]
pub(crate) struct SplatSet {
    pub(super) ids: SplatIds,
    pub(super) on_disk: BTreeMap<u32, Evicted>,
    counts: SplatCounts,
    /// Share of the input that has come, while more is to come and where it is known.
    progress: Option<f64>,
    /// What a saved map brought: no share of the cap is kept from it.
    n_resumed: usize,
    /// All ids are new, and no client knows them.
    pub(super) is_renumbered: bool,
    /// Ids of splats at a depth that no view has verified; some may be gone.
    pub(super) guessed: BTreeSet<u32>,
    /// Part of the cap that parked submaps keep.
    pub(super) n_parked: usize,
}

impl SplatSet {
    pub(crate) fn counts(&self) -> &SplatCounts {
        &self.counts
    }

    pub(crate) fn set_progress(&mut self, progress: Option<f64>) {
        self.progress = progress;
    }

    pub(crate) fn set_resumed(&mut self, n: usize) {
        self.n_resumed = n;
    }

    pub(crate) fn n_on_disk(&self) -> u64 {
        self.on_disk.values().map(|r| r.n_splats as u64).sum()
    }

    pub(crate) fn on_disk(&self) -> &BTreeMap<u32, Evicted> {
        &self.on_disk
    }

    /// Goes back to the ids and regions of an earlier moment.
    pub(crate) fn restore_from(&mut self, ids: &[u32], on_disk: &BTreeMap<u32, Evicted>) {
        self.ids.restore(ids);
        self.on_disk.clone_from(on_disk);
    }

    /// The engine had room only for the first `n`.
    pub(crate) fn keep_ids(&mut self, keep: &[bool]) {
        self.ids.retain(keep);
    }

    /// Whether all ids have changed since this was last called.
    pub(crate) fn take_renumbered(&mut self) -> bool {
        std::mem::take(&mut self.is_renumbered)
    }

    pub(crate) fn append(
        &mut self,
        splats: &Splats,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        engine.append(splats)?;
        self.number(engine);
        Ok(())
    }

    /// After the engine added splats.
    pub(crate) fn number(&mut self, engine: &dyn Engine) {
        if self.ids.grow_to(engine.len()) {
            self.is_renumbered = true;
            self.guessed.clear();
        }
        self.note_peaks(engine);
    }

    pub(crate) fn note_peaks(&mut self, engine: &dyn Engine) {
        let counts = &mut self.counts;
        counts.peak_splats = counts.peak_splats.max(engine.len());
        counts.peak_engine_bytes = counts.peak_engine_bytes.max(engine.memory().held_bytes);
    }

    pub(crate) fn retain(
        &mut self,
        keep: &[bool],
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        engine.retain(keep)?;
        self.ids.retain(keep);
        Ok(())
    }

    /// Removes splats that have become transparent or lost their numbers; the transparent ones move with MCMC, and densification
    /// removes them itself, as it makes all of them nearly transparent now and then.
    pub(crate) fn prune(
        &mut self,
        params: &MapperParams,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let splats = engine.read()?;
        let min_opacity = params.mcmc.min_opacity.clamp(1e-6, 1.0 - 1e-6);
        let min_logit = (min_opacity / (1.0 - min_opacity)).ln();
        let keeps_faint = params.mcmc.enabled || params.densify.enabled;
        let is_alive = |i: usize| keeps_faint || splats.opacity_logits[i] > min_logit;
        let keep: Vec<bool> = (0..splats.len())
            .map(|i| splats.is_finite(i) && is_alive(i))
            .collect();
        if keep.iter().any(|k| !k) {
            self.retain(&keep, engine)?;
        }
        Ok(())
    }

    /// Clients and viewers rely on finite numbers.
    pub(crate) fn finite_copy(&self, engine: &mut dyn Engine) -> Result<FiniteSplats, EngineError> {
        let splats = engine.read()?;
        let update_counts = engine.update_counts()?;
        let ids = self.ids.all();
        let finite = (0..splats.len()).filter(|i| splats.is_finite(*i));
        let finite: Vec<usize> = finite.collect();
        if finite.len() == splats.len() {
            return Ok(FiniteSplats {
                splats,
                ids: ids.to_vec(),
                update_counts,
            });
        }
        Ok(FiniteSplats {
            splats: splats.picked(&finite),
            ids: finite.iter().map(|i| ids[*i]).collect(),
            update_counts: finite.iter().map(|i| update_counts[*i]).collect(),
        })
    }

    /// While the end is known to be far, part of the room is kept for what is still to be seen.
    pub(crate) fn cap(
        &mut self,
        params: &MapperParams,
        keyframes: &KeyframeStore,
        engine: &dyn Engine,
    ) -> usize {
        let most = self.capacity(params, keyframes, engine);
        let share = self.progress.map_or(1.0, |p| (FIRST_ROOM + p).min(1.0));
        // What a saved map brought needs no share.
        let before = self.n_resumed.min(most);
        before + ((most - before) as f64 * share) as usize
    }

    /// What the budgets allow in all.
    pub(crate) fn capacity(
        &mut self,
        params: &MapperParams,
        keyframes: &KeyframeStore,
        engine: &dyn Engine,
    ) -> usize {
        let by_number = params.map.max_splats.saturating_sub(self.n_parked);
        if params.map.max_gpu_mib == 0 {
            return by_number;
        }
        let by_bytes = {
            let budget = params.map.max_gpu_mib << 20;
            let kept = keyframes.bytes_for_views(params);
            engine.capacity(budget.saturating_sub(kept))
        };
        if by_bytes < by_number && engine.len() >= by_bytes {
            if self.counts.n_refused == 0 {
                tracing::warn!(
                    "map.max_gpu_mib = {} has room for {by_bytes} splats of map.max_splats = {by_number}: no more are added; said once",
                    params.map.max_gpu_mib
                );
            }
            self.counts.n_refused += 1;
        }
        by_number.min(by_bytes)
    }

    /// What is near and comes back, and what must go for that and for `n_wanted` more splats, as far as there is anything far.
    /// `None`: nothing.
    pub(crate) fn plan(
        &mut self,
        n_wanted: usize,
        params: &MapperParams,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<Option<Balance>, EngineError> {
        let most = self.capacity(params, keyframes, engine);
        let n = engine.len();
        // Keyframes seldom add all that they may.
        let n_wanted = n_wanted.min(most / MOST_WANTED);
        let is_full = n + n_wanted > most;
        if !is_full && self.on_disk.is_empty() {
            return Ok(None);
        }
        let away = keyframes.distances(engine)?;
        let depth = f64::from(keyframes.scene_depth());
        let at = |id: &u32| away.get(id).copied();
        let mut back: Vec<(f64, u32)> = self
            .on_disk
            .keys()
            .filter_map(|id| Some((at(id)?, *id)))
            .filter(|(away, _)| *away < NEAR * depth)
            .collect();
        back.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let of_back: usize = back.iter().map(|(_, id)| self.on_disk[id].n_splats).sum();
        let mut n_over = 0;
        if n + n_wanted + of_back > most {
            let spare = (SPARE * most as f64) as usize;
            n_over = n + n_wanted + of_back + spare - most.min(n + n_wanted + of_back + spare);
        }
        Ok(Some(Balance {
            n_over,
            beyond: FAR * depth,
            away,
            back: back.into_iter().map(|(_, id)| id).collect(),
            most,
        }))
    }

    /// Brings back what there is room for. Returns whether anything came.
    pub(crate) fn restore_near(
        &mut self,
        balance: &Balance,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<bool, EngineError> {
        let n_before = self.counts.n_restored;
        for id in &balance.back {
            let room = balance.most.saturating_sub(engine.len());
            if self.on_disk[id].n_splats <= room {
                self.restore(*id, keyframes, engine)?;
            }
        }
        Ok(self.counts.n_restored > n_before)
    }

    /// Notes which keyframes show what is on disk.
    pub(crate) fn mark_paged_out(
        &self,
        keyframes: &mut KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let map_poses = engine.poses()?;
        let scene_depth = keyframes.scene_depth();
        keyframes.mark_paged_out(|id, p| {
            !self.on_disk.is_empty()
                && self.looks_at_disk(id, &map_poses[p.view_ix], &p.intrinsics, scene_depth)
        });
        Ok(())
    }

    /// Until so many splats have gone: whole regions, the farthest first, none nearer than `beyond`. Returns whether any
    /// have.
    pub(crate) fn evict_far(
        &mut self,
        (n_over, beyond): (usize, f64),
        away: &BTreeMap<u32, f64>,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
        paging: &mut Paging,
    ) -> Result<bool, EngineError> {
        let splats = engine.read()?;
        let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
        for anchor in &splats.anchors {
            *counts.entry(*anchor).or_default() += 1;
        }
        let mut far: Vec<(f64, u32)> = counts
            .keys()
            .filter_map(|id| Some((*away.get(id)?, *id)))
            .filter(|(away, _)| *away > beyond)
            .collect();
        far.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut going = BTreeSet::new();
        let mut n = 0;
        for (_, id) in far {
            if n >= n_over {
                break;
            }
            n += counts[&id];
            going.insert(id);
        }
        if !going.is_empty() {
            self.evict(&going, &splats, keyframes, engine, paging)?;
        }
        Ok(!going.is_empty())
    }

    fn evict(
        &mut self,
        going: &BTreeSet<u32>,
        splats: &Splats,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
        paging: &mut Paging,
    ) -> Result<(), EngineError> {
        let update_counts = engine.update_counts()?;
        let map_poses = engine.poses()?;
        let mut rows: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
        for (ix, anchor) in splats.anchors.iter().enumerate() {
            if going.contains(anchor) {
                rows.entry(*anchor).or_default().push(ix);
            }
        }
        let mut keep = vec![true; splats.len()];
        for (anchor, rows) in rows {
            let Some(registered) = keyframes.registered().get(&anchor) else {
                continue;
            };
            let world_from_anchor = map_poses[registered.view_ix].inverse();
            let region = splats.picked(&rows);
            let of_rows: Vec<u16> = rows
                .iter()
                .map(|ix| update_counts.get(*ix).copied().unwrap_or(0))
                .collect();
            let Some(page) = paging.put(&region_bytes(&region, &of_rows)) else {
                continue;
            };
            let stride = rows.len().div_ceil(N_SAMPLES).max(1);
            let sample = region.means.iter().step_by(stride);
            let evicted = Evicted {
                anchor,
                n_splats: rows.len(),
                sh_degree: region.sh_degree,
                page: Arc::from(page),
                world_from_anchor,
                carried: None,
                motion: None,
                sample: sample.map(|m| DVec3::from(m.map(f64::from))).collect(),
            };
            self.counts.n_evicted += rows.len() as u64;
            // What was seeded there while a part of it was on disk stays with it.
            self.merge_evicted(evicted, paging);
            rows.iter().for_each(|ix| keep[*ix] = false);
        }
        self.retain(&keep, engine)
    }

    /// A region may go while an older part of it is on disk.
    fn merge_evicted(&mut self, new: Evicted, paging: &mut Paging) {
        let Some(old) = self.on_disk.remove(&new.anchor) else {
            self.on_disk.insert(new.anchor, new);
            return;
        };
        let both = old.moved_to(&new.world_from_anchor).splats().ok();
        let both = both
            .zip(new.splats().ok())
            .map(|((mut a, mut update_counts), (b, more))| {
                a.extend(&b);
                update_counts.extend(more);
                (a.len(), region_bytes(&a, &update_counts))
            });
        let page = both.and_then(|(n, bytes)| Some((n, paging.put(&bytes)?)));
        let merged = match page {
            Some((n_splats, page)) => Evicted {
                n_splats,
                page: Arc::from(page),
                ..new
            },
            None => {
                self.lose(
                    old.n_splats,
                    "two parts of a region cannot be joined on disk",
                );
                new
            }
        };
        self.on_disk.insert(merged.anchor, merged);
    }

    fn restore(
        &mut self,
        id: u32,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let Some(region) = self.on_disk.remove(&id) else {
            return Ok(());
        };
        let world_from_anchor = match keyframes.registered().get(&id) {
            Some(registered) => engine.poses()?[registered.view_ix].inverse(),
            None => region.world_from_anchor,
        };
        match region.moved_to(&world_from_anchor).splats() {
            Ok((splats, update_counts)) => {
                let first = engine.len();
                self.append(&splats, engine)?;
                engine.set_update_counts(first, &update_counts)?;
                self.counts.n_restored += splats.len() as u64;
            }
            Err(e) => self.lose(region.n_splats, &e.to_string()),
        }
        Ok(())
    }

    /// Whether a view shows a region on disk; `None`: nothing is there.
    pub(crate) fn looks_at_disk(
        &self,
        id: u32,
        cam_from_world: &Rigid,
        lens: &Intrinsics,
        scene_depth: f32,
    ) -> bool {
        if self.on_disk.contains_key(&id) {
            return true;
        }
        let within = SEEN_WITHIN * f64::from(scene_depth);
        let centre = cam_from_world.inverse().translation;
        let shows = |at: &&DVec3| {
            let in_cam = cam_from_world.transform_point(**at);
            let pixel = lens.project(in_cam);
            in_cam.z < within
                && pixel.is_some_and(|p| {
                    let (w, h) = (f64::from(lens.width_px), f64::from(lens.height_px));
                    p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h
                })
        };
        self.on_disk.values().any(|region| {
            let off = region.world_from_anchor.translation - centre;
            off.length() < 2.0 * within
                && region.sample.iter().filter(shows).count() >= MIN_SEEN.min(region.sample.len())
        })
    }

    fn lose(&mut self, n_splats: usize, reason: &str) {
        if !self.counts.has_warned {
            tracing::warn!("{n_splats} splats on disk are lost: {reason}; said once");
            self.counts.has_warned = true;
        }
    }
}

/// Regions as they lie in the map, for files.
pub(crate) fn evicted_regions(
    on_disk: &BTreeMap<u32, Evicted>,
    keyframes: &KeyframeStore,
    cameras: &Cameras,
) -> Vec<Evicted> {
    let map_poses = &cameras.cam_from_maps;
    let moved = on_disk.values().map(|region| {
        let registered = keyframes.registered().get(&region.anchor);
        let pose = registered.map(|registered| map_poses[registered.view_ix].inverse());
        region.moved_to(&pose.unwrap_or(region.world_from_anchor))
    });
    moved.collect()
}
