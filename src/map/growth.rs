//! Splats come where a view shows holes or errors, and go when they have become transparent.

use rand::RngExt;

use crate::map::SplatMap;
use crate::map::schedule::Phase;
use crate::map::seed::{self, SeedView};

impl SplatMap {
    /// Looks at one training view, and seeds where the map has a hole or is wrong.
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
            self.seed_from(id, phase != Phase::Streaming, None);
        }
    }

    pub(super) fn seed_from(&mut self, keyframe_id: u32, fills_gaps: bool, progress: Option<f64>) {
        let Some(placed) = self
            .keyframes
            .placed
            .get(&keyframe_id)
            .filter(|p| !p.is_held_out)
        else {
            return;
        };
        // While the end is known to be far, part of the cap is kept for what is still to be seen.
        let share = progress.map_or(1.0, |p| (0.25 + p).min(1.0));
        let cap = (self.params.max_splats as f64 * share) as usize;
        let room = cap.saturating_sub(self.engine.n_splats());
        if room == 0 {
            return;
        }
        let cam_from_map = self.engine.poses()[placed.view_ix];
        let rendering = (self.engine.n_splats() > 0)
            .then(|| self.engine.render(&placed.intrinsics, &cam_from_map, 0));
        let view = SeedView {
            keyframe_id,
            image: &placed.image,
            intrinsics: &placed.intrinsics,
            map_from_cam: &cam_from_map.inverse(),
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
        }
    }

    /// Removes splats that have become transparent or lost their numbers.
    pub(super) fn prune(&mut self) {
        let splats = self.engine.splats();
        let min_opacity = self.params.min_opacity.clamp(1e-6, 1.0 - 1e-6);
        let min_logit = (min_opacity / (1.0 - min_opacity)).ln();
        let keep: Vec<bool> = (0..splats.len())
            .map(|i| splats.is_finite(i) && splats.opacity_logits[i] > min_logit)
            .collect();
        if keep.iter().any(|k| !k) {
            self.engine.retain(&keep);
        }
    }
}
