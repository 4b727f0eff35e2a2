//! The map as it was last read from the engine: a copy on the host, from which another engine can go on.
//!
//! It is taken with every snapshot and after every batch, so that a lost device costs the steps since and nothing else.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::splats::regions::Evicted;
use crate::mapper::submaps::registry::SubmapState;
use splat_types::snapshot::Snapshot;

/// What was read without a fault, and what the host knew between two changes of the map.
#[derive(Debug, Clone)]
pub(crate) struct LastGood {
    pub(crate) snapshot: Arc<Snapshot>,
    pub(crate) cameras: Cameras,
    /// One per splat of the snapshot.
    pub(crate) update_counts: Vec<u16>,
    /// Images and depth are shared with the map.
    pub(crate) keyframes: KeyframeStore,
    pub(crate) submaps: SubmapState,
    pub(crate) on_disk: BTreeMap<u32, Evicted>,
}
