//! Splats come where a view shows holes or errors, and go, or move, when they have become transparent.

use rand::RngExt;

use crate::camera::Intrinsics;
use crate::config::CopiesKeep;
use crate::map::SplatMap;
use crate::map::schedule::Phase;
use crate::map::seed::{self, SeedView};
use crate::map::transient;
use crate::pose::Rigid;
use crate::splat::mcmc::Copies;
use crate::splat::{McmcSettings, Rendering, Splats};

/// MCMC moves take in splats that one of the last so many rounds through all views has seen; the rest of a large map
/// is not under optimisation, and its splats are no measure of anything.
const ACTIVE_ROUNDS: usize = 4;
const MIN_ACTIVE_STEPS: usize = 500;
/// Share of the cap that is open when the first frames come; all of it is at the end of the input.
const FIRST_ROOM: f64 = 0.25;

impl SplatMap {
    /// Looks at one training view: seeds where the map has a hole or is wrong, and notes what has moved in it.
    pub(super) fn reseed(&mut self, phase: Phase) {
        if self.trainable.is_empty() {
            return;
        }
        let view_ix = self.trainable[self.rng.random_range(0..self.trainable.len())];
        let id = self
            .keyframes
            .placed
            .iter()
            .find(|(_, p)| p.view_ix == view_ix)
            .map(|(id, _)| *id);
        if let Some(id) = id {
            self.mask_transients(id);
            self.seed_from(id, phase != Phase::Streaming);
        }
    }

    pub(super) fn seed_all(&mut self, fresh: &[u32], deepened: &[u32]) {
        if !fresh.is_empty() || !deepened.is_empty() {
            self.unsettle();
        }
        let has_depth = |id: &&u32| self.keyframes.placed[*id].depth.width_px > 0;
        let fresh = fresh.iter().filter(has_depth);
        let ids: Vec<u32> = fresh.chain(deepened).copied().collect();
        self.balance(ids.len() * self.params.seeds_per_keyframe);
        for id in ids {
            self.seed_from(id, false);
        }
    }

    pub(super) fn seed_from(&mut self, keyframe_id: u32, fills_gaps: bool) {
        let room = self.cap().saturating_sub(self.engine.n_splats());
        if room == 0 {
            return;
        }
        let Some(camera) = self.camera(keyframe_id) else {
            return;
        };
        let rendering = self.shown(&camera, 0);
        let Some(placed) = self
            .keyframes
            .placed
            .get(&keyframe_id)
            .filter(|p| !p.is_held_out)
        else {
            return;
        };
        let view = SeedView {
            keyframe_id,
            image: &placed.image,
            intrinsics: &camera.0,
            map_from_cam: &camera.1.inverse(),
            depth: &placed.depth,
            rendering: rendering.as_ref(),
            fills_gaps,
        };
        let mut seeds = seed::seed(
            &view,
            self.params.seeds_per_keyframe,
            self.params.sh_degree,
            &mut self.rng,
        );
        seeds.truncate(room);
        if !seeds.is_empty() {
            self.engine.append(&seeds);
            self.number_splats();
        }
    }

    /// Removes splats that have become transparent or lost their numbers; the transparent ones move with MCMC.
    pub(super) fn prune(&mut self) {
        let splats = self.engine.splats();
        let min_opacity = self.params.min_opacity.clamp(1e-6, 1.0 - 1e-6);
        let min_logit = (min_opacity / (1.0 - min_opacity)).ln();
        let is_alive = |i: usize| self.params.mcmc || splats.opacity_logits[i] > min_logit;
        let keep: Vec<bool> = (0..splats.len())
            .map(|i| splats.is_finite(i) && is_alive(i))
            .collect();
        if keep.iter().any(|k| !k) {
            self.retain(&keep);
        }
    }

    /// Transparent splats move to where others are, and some are added (3DGS-MCMC).
    pub(super) fn relocate(&mut self) {
        let active_steps = (ACTIVE_ROUNDS * self.trainable.len()).max(MIN_ACTIVE_STEPS);
        let settings = McmcSettings {
            min_opacity: self.params.min_opacity,
            copies: match self.params.copies {
                CopiesKeep::Picture => Copies::Picture,
                CopiesKeep::Line => Copies::Line,
            },
            max_splats: self.cap(),
            growth: self.params.growth,
            active_steps: active_steps as u32,
            seed: (self.seed ^ self.n_steps) as u32,
        };
        self.engine.relocate_and_grow(&settings);
        self.number_splats();
    }

    /// After splats were added.
    pub(super) fn number_splats(&mut self) {
        if self.ids.grow_to(self.engine.n_splats()) {
            self.epoch += 1;
        }
        self.note_peaks();
    }

    pub(super) fn retain(&mut self, keep: &[bool]) {
        self.engine.retain(keep);
        self.ids.retain(keep);
    }

    /// Clients and viewers rely on finite numbers.
    pub(super) fn finite_splats(&mut self) -> (Splats, Vec<u32>) {
        let splats = self.engine.splats();
        let ids = self.ids.all();
        let finite = (0..splats.len()).filter(|i| splats.is_finite(*i));
        let finite: Vec<usize> = finite.collect();
        if finite.len() == splats.len() {
            return (splats, ids.to_vec());
        }
        let ids = finite.iter().map(|i| ids[*i]).collect();
        (splats.picked(&finite), ids)
    }

    /// While the end is known to be far, part of the room is kept for what is still to be seen.
    fn cap(&mut self) -> usize {
        let most = self.most_splats();
        let share = self.progress.map_or(1.0, |p| (FIRST_ROOM + p).min(1.0));
        // What a saved map brought needs no share.
        let before = self.past.as_ref().map_or(0, |past| past.n_splats.min(most));
        before + ((most - before) as f64 * share) as usize
    }

    /// What the budgets allow in all.
    pub(super) fn most_splats(&mut self) -> usize {
        let by_number = self.params.max_splats;
        if self.params.max_gpu_mib == 0 {
            return by_number;
        }
        let by_bytes = {
            let budget = self.params.max_gpu_mib << 20;
            let kept = self.bytes_for_views();
            self.engine.room_within(budget.saturating_sub(kept))
        };
        if by_bytes < by_number && self.engine.n_splats() >= by_bytes {
            if self.peaks.n_refused == 0 {
                tracing::warn!(
                    "map.max_gpu_mib = {} has room for {by_bytes} splats of map.max_splats = {by_number}: no more are added; said once",
                    self.params.max_gpu_mib
                );
            }
            self.peaks.n_refused += 1;
        }
        by_number.min(by_bytes)
    }

    /// A keyframe's camera as it is refined by now.
    pub(super) fn camera(&mut self, keyframe_id: u32) -> Option<(Intrinsics, Rigid)> {
        let placed = self.keyframes.placed.get(&keyframe_id)?;
        let intrinsics = placed.intrinsics.refocused(self.engine.focal_factor());
        Some((intrinsics, self.engine.poses()[placed.view_ix]))
    }

    /// What the map shows to a camera; `None` for an empty map.
    fn shown(&mut self, camera: &(Intrinsics, Rigid), sh_degree: u8) -> Option<Rendering> {
        let (intrinsics, cam_from_map) = camera;
        let is_empty = self.engine.n_splats() == 0;
        (!is_empty).then(|| self.engine.render(intrinsics, cam_from_map, sh_degree))
    }

    fn mask_transients(&mut self, keyframe_id: u32) {
        if self.params.transient >= 1.0 {
            return;
        }
        let camera = self.camera(keyframe_id);
        let rendering = camera.and_then(|camera| self.shown(&camera, self.params.sh_degree));
        let placed = self.keyframes.placed.get(&keyframe_id);
        if let Some((placed, rendering)) = placed.zip(rendering) {
            if placed.image.is_hollow() {
                return;
            }
            let mask = transient::mask(&placed.image, &rendering, self.params.transient);
            self.engine.set_mask(placed.view_ix, mask);
        }
    }
}
