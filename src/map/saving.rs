//! The map at one moment -> what a map file holds, and back. Services and autosaves call these while the map grows.

use std::path::Path;
use std::sync::Arc;

use crate::map::SplatMap;
use crate::map::checkpoint::{self, Checkpoint, CheckpointError};
use crate::map::snapshot::Snapshot;

impl SplatMap {
    /// All that a later run goes on from. Cheap beside the snapshot: pictures are packed when the file is written.
    /// `landmarks` are the tracker's.
    pub fn checkpoint(&mut self, snapshot: &Arc<Snapshot>, landmarks: Vec<u8>) -> Checkpoint {
        let ages = self.engine.ages();
        Checkpoint {
            landmarks,
            // Splats that are not finite have left the snapshot, and its rows are no longer the engine's.
            ages: if ages.len() == snapshot.splats.len() {
                ages
            } else {
                Vec::new()
            },
            views: self.saved_views(),
            max_view_bytes: self.params.save_pictures << 20,
            evicted: self.evicted(),
            ..Checkpoint::of((**snapshot).clone(), self.seed, self.n_steps_in_all())
        }
    }

    /// Writes the map as it is.
    pub fn save(&mut self, landmarks: Vec<u8>, path: &Path) -> Result<(), CheckpointError> {
        let snapshot = self.snapshot();
        let checkpoint = self.checkpoint(&snapshot, landmarks);
        checkpoint::write(&checkpoint, path)
    }

    /// Steps of this run and of those that it goes on from.
    pub fn n_steps_in_all(&self) -> u64 {
        self.n_steps + self.past.as_ref().map_or(0, |past| past.steps)
    }
}
