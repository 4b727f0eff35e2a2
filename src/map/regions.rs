//! More splats than the budget allows -> those far from the camera go to disk, keyframe by keyframe, and come back when it
//! is near them again.
//!
//! A region is what was seeded from one keyframe, and it moves with that. Views that look at a region on disk are not
//! trained on: they would fill the hole.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::Arc;

use glam::DVec3;

use crate::camera::Intrinsics;
use crate::map::SplatMap;
use crate::map::align::Carry;
use crate::map::sections::{region_bytes, take_region};
use crate::map::spill::Slot;
use crate::pose::Rigid;
use crate::splat::Splats;

/// The newest keyframes say where the camera is.
const N_NEWEST: usize = 8;
/// Distances from there, in depths of the scene: what comes back, and what may go. A camera sees some two depths far.
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

/// A region on disk.
#[derive(Debug, Clone)]
pub struct Evicted {
    pub anchor: u32,
    pub n_splats: usize,
    pub sh_degree: u8,
    slot: Arc<Slot>,
    map_from_anchor: Rigid,
    /// What moved the map there since.
    motion: Option<Rigid>,
    /// Places of some of its splats when it left.
    sample: Vec<DVec3>,
}

/// All that is on disk, and what came and went.
#[derive(Debug, Default)]
pub(super) struct Regions {
    pub(super) on_disk: BTreeMap<u32, Evicted>,
    pub(super) n_evicted: u64,
    pub(super) n_restored: u64,
    has_warned: bool,
}

impl Evicted {
    /// Splats where the map has them by now, and their ages.
    pub fn splats(&self) -> io::Result<(Splats, Vec<u16>)> {
        let bytes = self.slot.read()?;
        let (mut splats, ages) = take_region(&mut &bytes[..]).map_err(io::Error::other)?;
        if let Some(motion) = self.motion {
            let carry = Carry::new(motion.into(), splats.sh_degree);
            (0..splats.len()).for_each(|i| carry.carry(&mut splats, i));
        }
        Ok((splats, ages))
    }

    fn moved_to(&self, map_from_anchor: &Rigid) -> Self {
        let motion = *map_from_anchor * self.map_from_anchor.inverse();
        let is_moved = *map_from_anchor != self.map_from_anchor;
        Self {
            motion: is_moved.then_some(motion),
            ..self.clone()
        }
    }
}

impl SplatMap {
    /// Brings back what is near, and makes room for that and for `n_wanted` more splats, as far as there is anything far.
    pub(super) fn balance(&mut self, n_wanted: usize) {
        let most = self.most_splats();
        let n = self.engine.n_splats();
        // Keyframes seldom add all that they may.
        let n_wanted = n_wanted.min(most / MOST_WANTED);
        let is_full = n + n_wanted > most;
        if !is_full && self.regions.on_disk.is_empty() {
            return;
        }
        let away = self.distances();
        let depth = f64::from(self.scene_depth);
        let at = |id: &u32| away.get(id).copied();
        let mut back: Vec<(f64, u32)> = self
            .regions
            .on_disk
            .keys()
            .filter_map(|id| Some((at(id)?, *id)))
            .filter(|(away, _)| *away < NEAR * depth)
            .collect();
        back.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let of_back: usize = back
            .iter()
            .map(|(_, id)| self.regions.on_disk[id].n_splats)
            .sum();
        if n + n_wanted + of_back > most {
            let spare = (SPARE * most as f64) as usize;
            let n_over = n + n_wanted + of_back + spare - most.min(n + n_wanted + of_back + spare);
            self.evict_far(n_over, FAR * depth, &away);
        }
        let n_before = self.regions.n_restored;
        for (_, id) in back {
            let room = most.saturating_sub(self.engine.n_splats());
            if self.regions.on_disk[&id].n_splats <= room {
                self.restore(id);
            }
        }
        if self.regions.n_restored > n_before {
            self.choose_trainable();
            self.note_peaks();
        }
    }

    /// Until so many splats have gone: whole regions, the farthest first, none nearer than `beyond`.
    pub(super) fn evict_far(&mut self, n_over: usize, beyond: f64, away: &BTreeMap<u32, f64>) {
        let splats = self.engine.splats();
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
            self.evict(&going, &splats);
        }
    }

    fn evict(&mut self, going: &BTreeSet<u32>, splats: &Splats) {
        let ages = self.engine.ages();
        let map_poses = self.engine.poses();
        let mut rows: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
        for (ix, anchor) in splats.anchors.iter().enumerate() {
            if going.contains(anchor) {
                rows.entry(*anchor).or_default().push(ix);
            }
        }
        let mut keep = vec![true; splats.len()];
        for (anchor, rows) in rows {
            let Some(placed) = self.keyframes.placed.get(&anchor) else {
                continue;
            };
            let map_from_anchor = map_poses[placed.view_ix].inverse();
            let region = splats.picked(&rows);
            let of_rows: Vec<u16> = rows
                .iter()
                .map(|ix| ages.get(*ix).copied().unwrap_or(0))
                .collect();
            let Some(slot) = self.spilled(&region_bytes(&region, &of_rows)) else {
                continue;
            };
            let stride = rows.len().div_ceil(N_SAMPLES).max(1);
            let sample = region.means.iter().step_by(stride);
            let evicted = Evicted {
                anchor,
                n_splats: rows.len(),
                sh_degree: region.sh_degree,
                slot: Arc::new(slot),
                map_from_anchor,
                motion: None,
                sample: sample.map(|m| DVec3::from(m.map(f64::from))).collect(),
            };
            self.regions.n_evicted += rows.len() as u64;
            // What was seeded there while a part of it was on disk stays with it.
            self.merge_evicted(evicted);
            rows.iter().for_each(|ix| keep[*ix] = false);
        }
        self.retain(&keep);
        self.choose_trainable();
    }

    /// A region may go while an older part of it is on disk.
    fn merge_evicted(&mut self, new: Evicted) {
        let Some(old) = self.regions.on_disk.remove(&new.anchor) else {
            self.regions.on_disk.insert(new.anchor, new);
            return;
        };
        let both = old.moved_to(&new.map_from_anchor).splats().ok();
        let both = both
            .zip(new.splats().ok())
            .map(|((mut a, mut ages), (b, more))| {
                a.extend(&b);
                ages.extend(more);
                (a.len(), region_bytes(&a, &ages))
            });
        let slot = both.and_then(|(n, bytes)| Some((n, self.spilled(&bytes)?)));
        let merged = match slot {
            Some((n_splats, slot)) => Evicted {
                n_splats,
                slot: Arc::new(slot),
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
        self.regions.on_disk.insert(merged.anchor, merged);
    }

    fn restore(&mut self, id: u32) {
        let Some(region) = self.regions.on_disk.remove(&id) else {
            return;
        };
        let map_from_anchor = self.map_from_keyframe(id).unwrap_or(region.map_from_anchor);
        match region.moved_to(&map_from_anchor).splats() {
            Ok((splats, ages)) => {
                let first = self.engine.n_splats();
                self.engine.append(&splats);
                self.number_splats();
                self.engine.set_ages(first, &ages);
                self.regions.n_restored += splats.len() as u64;
            }
            Err(e) => self.lose(region.n_splats, &e.to_string()),
        }
    }

    /// Regions on disk as they lie in the map by now, for files.
    pub(super) fn evicted(&mut self) -> Vec<Evicted> {
        let map_poses = self.engine.poses();
        let regions = self.regions.on_disk.values();
        let moved = regions.map(|region| {
            let placed = self.keyframes.placed.get(&region.anchor);
            let pose = placed.map(|placed| map_poses[placed.view_ix].inverse());
            region.moved_to(&pose.unwrap_or(region.map_from_anchor))
        });
        moved.collect()
    }

    /// Whether a view shows a region on disk; `None`: nothing is there.
    pub(super) fn looks_at_disk(&self, id: u32, cam_from_map: &Rigid, lens: &Intrinsics) -> bool {
        if self.regions.on_disk.contains_key(&id) {
            return true;
        }
        let within = SEEN_WITHIN * f64::from(self.scene_depth);
        let centre = cam_from_map.inverse().translation;
        let shows = |at: &&DVec3| {
            let in_cam = cam_from_map.transform_point(**at);
            let pixel = lens.project(in_cam);
            in_cam.z < within
                && pixel.is_some_and(|p| {
                    let (w, h) = (f64::from(lens.width_px), f64::from(lens.height_px));
                    p.x >= 0.0 && p.y >= 0.0 && p.x < w && p.y < h
                })
        };
        self.regions.on_disk.values().any(|region| {
            let off = region.map_from_anchor.translation - centre;
            off.length() < 2.0 * within
                && region.sample.iter().filter(shows).count() >= MIN_SEEN.min(region.sample.len())
        })
    }

    /// Of every keyframe from the newest ones.
    pub(super) fn distances(&mut self) -> BTreeMap<u32, f64> {
        let map_poses = self.engine.poses();
        let place = |view_ix: usize| map_poses[view_ix].inverse().translation;
        let placed = &self.keyframes.placed;
        let newest: Vec<DVec3> = placed
            .values()
            .rev()
            .take(N_NEWEST)
            .map(|p| place(p.view_ix))
            .collect();
        let nearest = |at: DVec3| {
            let away = newest.iter().map(|other| (at - *other).length());
            away.fold(f64::INFINITY, f64::min)
        };
        placed
            .iter()
            .map(|(id, p)| (*id, nearest(place(p.view_ix))))
            .collect()
    }

    fn map_from_keyframe(&mut self, id: u32) -> Option<Rigid> {
        let view_ix = self.keyframes.placed.get(&id)?.view_ix;
        Some(self.engine.poses()[view_ix].inverse())
    }

    fn lose(&mut self, n_splats: usize, reason: &str) {
        if !self.regions.has_warned {
            tracing::warn!("{n_splats} splats on disk are lost: {reason}; said once");
            self.regions.has_warned = true;
        }
    }
}
