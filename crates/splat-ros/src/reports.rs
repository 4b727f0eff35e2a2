//! What the stages report of themselves and of the map, for the threads that publish: a cell for each stage that writes.

use std::sync::{Mutex, PoisonError};

use crate::status::{GridStatus, MapStatus, PublishedStatus, SelectStatus, SourceStatus};
use splat_io::latest::Latest;
use splat_types::correction::MapCorrection;
use splat_types::snapshot::Snapshot;
use splat_types::transform::Rigid;

/// Shared by the stages; each cell has one writer.
#[derive(Debug, Default)]
pub struct Reports {
    /// Written by the source.
    pub source: Latest<SourceStatus>,
    /// Written by selection.
    pub select: Latest<SelectStatus>,
    /// Written by the map thread.
    pub map: Latest<MapStatus>,
    /// Written with every snapshot that goes out.
    pub published: Latest<PublishedStatus>,
    /// Written by the source.
    pub camera: Latest<InputCamera>,
    pub correction: QueuedCorrection,
    /// Written by the thread that makes grids.
    pub grid: Latest<GridStatus>,
}

/// What the input says of its camera.
#[derive(Debug, Clone, Default)]
pub struct InputCamera {
    /// How it is mounted, in metres; the first that was known.
    pub base_from_cam: Option<Rigid>,
    /// Name of its frame; empty while the input names none.
    pub frame: String,
}

impl InputCamera {
    pub fn update(&mut self, base_from_cam: Option<Rigid>, frame: &str) {
        self.base_from_cam = self.base_from_cam.or(base_from_cam);
        if !frame.is_empty() {
            frame.clone_into(&mut self.frame);
        }
    }
}

/// How the map has moved since the last correction that went out.
///
/// Two threads change it, so it has a lock: the map thread adds motions, which are composed to one, and the publish
/// thread takes it.
#[derive(Debug, Default)]
pub struct QueuedCorrection(Mutex<Option<MapCorrection>>);

impl QueuedCorrection {
    /// It goes out with the first snapshot that shows it.
    pub fn add(&self, correction: MapCorrection) {
        let mut queued = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *queued = Some(match queued.as_ref() {
            Some(before) => correction.after(before),
            None => correction,
        });
    }

    /// The correction between the last published snapshot and this one, which begins another epoch or is of another map.
    pub(crate) fn take(&self, last: &Snapshot, snapshot: &Snapshot) -> Option<MapCorrection> {
        let mut queued = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let is_other = last.map_id != snapshot.map_id;
        // The map's thread may be ahead by a snapshot.
        let shown = queued.take_if(|queued| is_other || queued.revision <= snapshot.revision);
        shown.filter(|_| is_other || last.epoch != snapshot.epoch)
    }
}
