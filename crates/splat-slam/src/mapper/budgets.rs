//! What memory was allowed, and what became of it.

use serde::{Deserialize, Serialize};

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
    /// With image and depth on disk alone, at the end.
    pub keyframes_on_disk: u64,
    /// Images that disk had no room for: their keyframes stay, but are not trained on again.
    #[serde(rename = "pictures_lost")]
    pub images_lost: u64,
}
