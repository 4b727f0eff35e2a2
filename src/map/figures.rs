//! What a map says of itself: its id, its loss curve, the size of its scene, and how it keeps within its budgets.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::map::SplatMap;

/// Points beyond which the distance between those of the loss curve doubles.
const MAX_CURVE: usize = 400;

/// What memory was allowed, and what went to disk for it; `budgets` in `report.json`. 0 where there is no limit.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Budgets {
    pub max_splats: u64,
    pub peak_splats: u64,
    /// That left memory, and came back, each time counted; and those on disk at the end.
    pub evicted_splats: u64,
    pub restored_splats: u64,
    pub splats_on_disk: u64,
    pub max_gpu_mib: u64,
    /// Most that the engine held: on a GPU in all its buffers, else splats, optimiser state and views.
    pub peak_engine_mib: f64,
    /// Times that splats were not added for the sake of `max_gpu_mib`.
    pub growth_refused: u64,
    pub max_keyframes_in_ram: u64,
    pub peak_keyframes_in_ram: u64,
    /// With picture and depth on disk alone, at the end.
    pub keyframes_on_disk: u64,
    /// Pictures that disk had no room for: their keyframes stay, but are not trained on again.
    pub pictures_lost: u64,
}

/// What is counted on the way.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Peaks {
    pub(super) n_splats: usize,
    pub(super) engine_bytes: u64,
    pub(super) n_refused: u64,
}

impl SplatMap {
    pub fn budgets(&self) -> Budgets {
        let placed = self.keyframes.placed.values();
        let on_disk = self.regions.on_disk.values();
        let peak_bytes = self.peaks.engine_bytes.max(self.engine.peak_gpu_bytes());
        Budgets {
            max_splats: self.params.max_splats as u64,
            peak_splats: self.peaks.n_splats as u64,
            evicted_splats: self.regions.n_evicted,
            restored_splats: self.regions.n_restored,
            splats_on_disk: on_disk.map(|region| region.n_splats as u64).sum(),
            max_gpu_mib: self.params.max_gpu_mib,
            peak_engine_mib: peak_bytes as f64 / f64::from(1 << 20),
            growth_refused: self.peaks.n_refused,
            max_keyframes_in_ram: self.params.max_keyframes_in_ram as u64,
            peak_keyframes_in_ram: self.disk.peak_here as u64,
            keyframes_on_disk: placed
                .filter(|p| !p.home.is_here && p.home.copy.is_some())
                .count() as u64,
            pictures_lost: self.disk.n_lost,
        }
    }

    pub(super) fn note_peaks(&mut self) {
        self.peaks.n_splats = self.peaks.n_splats.max(self.engine.n_splats());
        self.peaks.engine_bytes = self.peaks.engine_bytes.max(self.engine.held_bytes());
    }

    pub(super) fn map_id(&self) -> [u8; 16] {
        if let Some(past) = &self.past {
            return past.map_id;
        }
        let first = self
            .keyframes
            .placed
            .values()
            .next()
            .map(|p| p.keyframe.frame.stamp.nanos)
            .unwrap_or(0);
        let digest = Sha256::new()
            .chain_update(self.seed.to_le_bytes())
            .chain_update(first.to_le_bytes())
            .finalize();
        std::array::from_fn(|i| digest[i])
    }

    pub(super) fn measure_scene(&mut self) {
        let mut medians: Vec<f32> = self
            .keyframes
            .placed
            .values()
            .filter_map(|p| p.median_depth)
            .collect();
        medians.sort_by(f32::total_cmp);
        if let Some(median) = medians.get(medians.len() / 2) {
            self.scene_depth = *median;
        }
    }

    /// (step, mean loss since the one before).
    pub fn loss_curve(&self) -> &[(u64, f64)] {
        &self.loss_curve
    }

    pub(super) fn note_loss(&mut self) {
        let stats = self.engine.take_stats();
        if stats.n_steps > 0 {
            self.loss_curve.push((self.n_steps, stats.loss));
            let n_views = self.trainable.len();
            self.settling.note(stats.loss, stats.n_steps, n_views);
        }
        // A live run has no end: half the points at twice the distance show the same curve.
        if self.loss_curve.len() > MAX_CURVE {
            let mut odd = false;
            self.loss_curve.retain(|_| {
                odd = !odd;
                odd
            });
            self.note_every *= 2;
        }
    }
}
