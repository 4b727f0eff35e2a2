//! More keyframes than the budget allows -> pictures and depth of some leave memory, and come back to be trained on.
//!
//! A keyframe that leaves keeps its place, its camera and its splats. The newest stay; the others take turns. Before that,
//! depth of all but the newest is thinned.

use std::path::Path;
use std::sync::Arc;

use rand::RngExt;

use crate::frame::{DepthMap, RgbImage};
use crate::geometry::View;
use crate::map::SplatMap;
use crate::map::keyframes::{self, Placed};
use crate::map::saved_view::{self, Content, SavedView};
use crate::map::spill::{Slot, Spill};

/// The newest keyframes that never rest and, of those that memory has room for, the share that is for the newest.
const N_NEWEST: usize = 8;
const NEWEST_SHARE: f64 = 0.5;
/// The newest keyframes whose depth is whole. The model may still tell of them again, and it is they that seed.
const N_WHOLE_DEPTH: usize = 32;
/// Views may take one part of so many of `map.max_gpu_mib`; the rest is for splats.
const VIEWS_SHARE: usize = 2;
/// Steps between turns, and keyframes that come back in one.
pub(super) const TURN_EVERY: u64 = 50;
const N_PER_TURN: usize = 2;

/// Where the picture of a keyframe is.
#[derive(Debug, Clone, Default)]
pub struct Home {
    /// In memory, with its depth.
    pub is_here: bool,
    /// Packed: on disk, or nowhere as long as it has never left.
    pub copy: Option<Content>,
    /// Number of the turn in which it came; those that have been here longest leave first.
    pub since: u64,
    /// It shows a part of the map that is on disk.
    pub rests: bool,
    /// It came with a saved map: the geometry model does not know it, and pictures are none where the map has none.
    pub is_past: bool,
}

/// The file for what memory has no room for.
#[derive(Debug, Default)]
pub(super) struct Disk {
    spill: Option<Spill>,
    has_warned: bool,
    turn: u64,
    pub(super) n_lost: u64,
    pub(super) peak_here: usize,
}

impl Home {
    pub fn here() -> Self {
        Self {
            is_here: true,
            ..Self::default()
        }
    }
}

impl SplatMap {
    /// Writes a record beside the run; `None`, said once, where that is not possible.
    pub(super) fn spilled(&mut self, bytes: &[u8]) -> Option<Slot> {
        let limit = self.params.max_disk_mib << 20;
        let folder = self.folder.clone().unwrap_or_else(std::env::temp_dir);
        let spill = match &self.disk.spill {
            Some(spill) => Ok(spill.clone()),
            None => Spill::new(&folder, limit),
        };
        let put = spill.and_then(|spill| {
            self.disk.spill = Some(spill.clone());
            spill.put(bytes)
        });
        let reason = match put {
            Ok(Some(slot)) => return Some(slot),
            Ok(None) => format!("map.max_disk_mib = {} is used up", self.params.max_disk_mib),
            Err(e) => e.to_string(),
        };
        if !self.disk.has_warned {
            tracing::warn!(
                "what memory has no room for cannot be kept on disk: {reason}; said once: {}",
                folder.display()
            );
            self.disk.has_warned = true;
        }
        None
    }

    /// Folder for that file, else the one for temporary files.
    #[must_use]
    pub fn spilling_to(mut self, folder: Option<&Path>) -> Self {
        self.folder = folder.map(Path::to_owned);
        self
    }

    /// Keeps as many keyframes in memory as there may be, less room for those that come.
    pub(super) fn hold_keyframes(&mut self, n_coming: usize) {
        let n_here = self.n_here();
        self.disk.peak_here = self.disk.peak_here.max(n_here);
        let most = self.max_here().saturating_sub(n_coming);
        let n_over = n_here.saturating_sub(most);
        for id in self.leaving(n_over) {
            self.leave(id);
        }
        if n_over > 0 {
            self.choose_trainable();
        }
    }

    /// Depth is most of what a keyframe takes, and behind the newest it only guides a loss.
    pub(super) fn thin_old_depth(&mut self) {
        let placed = self.keyframes.placed.values_mut().rev();
        for placed in placed.skip(N_WHOLE_DEPTH) {
            let depth = &placed.depth;
            if depth.width_px.max(depth.height_px) > saved_view::MAX_DEPTH_SIDE {
                placed.depth = Arc::new(saved_view::thinned(depth));
                let depth = Arc::clone(&placed.depth);
                self.engine.set_depth(placed.view_ix, Some(depth));
            }
        }
    }

    /// Some that are on disk take the place of those that have been here longest: the nearest, and any.
    pub(super) fn take_turns(&mut self) {
        let is_away = |p: &Placed| !p.home.is_here && !p.is_held_out && p.home.copy.is_some();
        if !self.keyframes.placed.values().any(is_away) {
            return;
        }
        let away = self.distances();
        let mut waiting: Vec<(f64, u32)> = self
            .keyframes
            .placed
            .iter()
            .filter(|(_, p)| is_away(p) && !p.home.rests)
            .map(|(id, _)| (away.get(id).copied().unwrap_or(f64::INFINITY), *id))
            .collect();
        if waiting.is_empty() {
            return;
        }
        waiting.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut coming = vec![waiting[0].1];
        while coming.len() < N_PER_TURN.min(waiting.len()) {
            let any = waiting[self.rng.random_range(0..waiting.len())].1;
            if !coming.contains(&any) {
                coming.push(any);
            }
        }
        self.disk.turn += 1;
        let n_over = (self.n_here() + coming.len()).saturating_sub(self.max_here());
        for id in self.leaving(n_over) {
            self.leave(id);
        }
        coming.truncate(self.max_here().saturating_sub(self.n_here()));
        for id in coming {
            self.come(id);
        }
        self.choose_trainable();
    }

    /// The same for a moment: another makes room for it. Whoever visits sends it away again.
    pub(super) fn visit(&mut self, id: u32) -> bool {
        let placed = self.keyframes.placed.get(&id);
        if placed.is_some_and(|p| !p.home.is_here && p.home.copy.is_some()) {
            self.hold_keyframes(1);
        }
        self.come(id)
    }

    /// Picture and depth come into memory. Returns whether they are there.
    pub(super) fn come(&mut self, id: u32) -> bool {
        let turn = self.disk.turn;
        let Some(placed) = self.keyframes.placed.get_mut(&id) else {
            return false;
        };
        let Some(content) = placed.home.copy.clone().filter(|_| !placed.home.is_here) else {
            return placed.home.is_here;
        };
        let view = SavedView {
            keyframe_id: id,
            is_held_out: placed.is_held_out,
            content,
        };
        let size = (placed.image.width_px, placed.image.height_px);
        let (image, depth) = match view.unpacked(size) {
            Ok((image, depth)) => (Arc::new(image), Arc::new(depth)),
            Err(reason) => {
                tracing::warn!("the picture of keyframe {id} is lost: {reason}");
                placed.home.copy = None;
                self.disk.n_lost += 1;
                return false;
            }
        };
        placed.home.is_here = true;
        placed.home.since = turn;
        (placed.image, placed.depth) = (Arc::clone(&image), Arc::clone(&depth));
        self.engine
            .set_image(placed.view_ix, image, &placed.intrinsics);
        self.engine.set_depth(placed.view_ix, Some(depth));
        self.disk.peak_here = self.disk.peak_here.max(self.n_here());
        true
    }

    /// Picture and depth leave memory; a packed copy is on disk, or they are lost.
    pub(super) fn leave(&mut self, id: u32) {
        let Some(placed) = self.keyframes.placed.get(&id) else {
            return;
        };
        if placed.home.copy.is_none() {
            let packed = saved_view::pack(&placed.image, &placed.depth);
            let slot = packed.ok().and_then(|bytes| self.spilled(&bytes));
            self.disk.n_lost += u64::from(slot.is_none());
            if let Some(placed) = self.keyframes.placed.get_mut(&id) {
                placed.home.copy = slot.map(|slot| Content::OnDisk(Arc::new(slot)));
            }
        }
        let scale_params = self.scale_params.clone();
        if let Some(placed) = self.keyframes.placed.get_mut(&id) {
            // What it says of metres is measured by depth that goes.
            if let Some(params) = scale_params.filter(|_| placed.home.is_here) {
                placed.measure(&params);
            }
            placed.home.is_here = false;
            placed.keyframe = Arc::new(placed.keyframe.hollow());
            let (w, h) = (placed.image.width_px, placed.image.height_px);
            placed.image = Arc::new(RgbImage::hollow(w, h));
            placed.depth = Arc::new(DepthMap::none());
            self.engine.rest_view(placed.view_ix);
        }
    }

    /// A keyframe of which the model tells once more: more neighbours have verified its depth since, unless it is out of
    /// reach.
    /// Returns whether it had no depth before.
    pub(super) fn told_again(&mut self, view: &View, depth: Arc<DepthMap>) -> bool {
        let Some(placed) = self.keyframes.placed.get_mut(&view.keyframe_id) else {
            return false;
        };
        placed.health = view.health;
        if !placed.home.is_here {
            return false;
        }
        if placed.lens != view.lens && !placed.keyframe.frame.image.is_hollow() {
            let max_side = self.params.max_side;
            let (image, pinhole) = keyframes::picture(&placed.keyframe, view, max_side);
            (placed.image, placed.intrinsics) = (Arc::clone(&image), pinhole);
            placed.lens = view.lens;
            placed.home.copy = None;
            self.engine.set_image(placed.view_ix, image, &pinhole);
        }
        if depth.width_px == 0 {
            return false;
        }
        let is_first = placed.depth.width_px == 0;
        if is_first {
            placed.n_depth_looks = 0;
        }
        self.engine
            .set_depth(placed.view_ix, Some(Arc::clone(&depth)));
        (placed.median_depth, placed.depth) = (depth.median(), depth);
        placed.ratios = None;
        placed.home.copy = None;
        is_first
    }

    /// Views to train on: in memory, not held out, and with all that they show in memory, too; in order of arrival.
    pub(super) fn choose_trainable(&mut self) {
        let map_poses = self.engine.poses();
        let newest = self.newest_ids(N_NEWEST);
        let ids: Vec<u32> = self.keyframes.placed.keys().copied().collect();
        for id in ids {
            let placed = &self.keyframes.placed[&id];
            let rests = !self.regions.on_disk.is_empty()
                && !newest.contains(&id)
                && self.looks_at_disk(id, &map_poses[placed.view_ix], &placed.intrinsics);
            if let Some(placed) = self.keyframes.placed.get_mut(&id) {
                placed.home.rests = rests;
            }
        }
        let placed = self.keyframes.placed.values();
        let is_fit = |p: &&Placed| p.home.is_here && !p.is_held_out && !p.home.rests;
        self.trainable = placed.filter(is_fit).map(|p| p.view_ix).collect();
        self.trainable.sort_unstable();
        self.schedule.restart_round();
    }

    /// Pictures of all keyframes, wherever they are, for files.
    pub(super) fn saved_views(&self) -> Vec<SavedView> {
        let placed = self.keyframes.placed.iter();
        let view = |(id, placed): (&u32, &Placed)| {
            let in_memory = placed.home.is_here.then(|| Content::InMemory {
                image: Arc::clone(&placed.image),
                depth: Arc::clone(&placed.depth),
            });
            Some(SavedView {
                keyframe_id: *id,
                is_held_out: placed.is_held_out,
                content: placed.home.copy.clone().or(in_memory)?,
            })
        };
        placed.filter_map(view).collect()
    }

    /// Whether every keyframe has its picture in memory.
    pub fn has_all_pictures(&self) -> bool {
        self.n_here() == self.n_keyframes()
    }

    /// Views of keyframes that come into the map with them.
    pub(super) fn n_unplaced(&self, views: &[View]) -> usize {
        let is_new = |view: &&View| !self.has_keyframe(view.keyframe_id);
        views.iter().filter(is_new).count()
    }

    pub(super) fn n_here(&self) -> usize {
        let placed = self.keyframes.placed.values();
        placed.filter(|p| p.home.is_here).count()
    }

    /// Keyframes that memory, and the engine's budget, have room for.
    pub(super) fn max_here(&self) -> usize {
        let by_number = match self.params.max_keyframes_in_ram {
            0 => usize::MAX,
            n => n,
        };
        let budget = (self.params.max_gpu_mib << 20) as usize / VIEWS_SHARE;
        let by_bytes = match budget {
            0 => usize::MAX,
            budget => budget / self.bytes_of_view(),
        };
        by_number.min(by_bytes).max(N_NEWEST)
    }

    /// Bytes of `map.max_gpu_mib` that are kept for views that are still to come.
    pub(super) fn bytes_for_views(&self) -> u64 {
        let budget = (self.params.max_gpu_mib << 20) as usize / VIEWS_SHARE;
        let here = self.n_here() * self.bytes_of_view();
        let most = self.max_here().saturating_mul(self.bytes_of_view());
        budget.min(most).saturating_sub(here) as u64
    }

    /// As the engine has one: four bytes a pixel, eight a depth. The largest of the newest that are in memory.
    fn bytes_of_view(&self) -> usize {
        let of_view = |p: &Placed| 4 * p.image.pixels.len() / 3 + 8 * p.depth.depth.len();
        let placed = self.keyframes.placed.values().rev();
        let here = placed.filter(|p| p.home.is_here).take(N_NEWEST);
        here.map(of_view).max().unwrap_or(1).max(1)
    }

    fn newest_ids(&self, n: usize) -> Vec<u32> {
        self.keyframes
            .placed
            .keys()
            .rev()
            .take(n)
            .copied()
            .collect()
    }

    /// The next `n` to leave: held out ones and those that rest first, then those that have been here longest.
    fn leaving(&self, n: usize) -> Vec<u32> {
        if n == 0 {
            return Vec::new();
        }
        let n_newest = (NEWEST_SHARE * self.max_here() as f64) as usize;
        let newest = self.newest_ids(n_newest.max(N_NEWEST));
        let mut here: Vec<(bool, bool, u64, u32)> = self
            .keyframes
            .placed
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
