//! Where the newest keyframes go -> which submap is the map; the one before is parked.

use std::sync::Arc;

use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::submaps::parked::Parked;
use crate::mapper::submaps::parked_submaps::ParkedSubmaps;
use crate::mapper::submaps::registry::Submaps;
use splat_geometry::answer::View;
use splat_types::correction::{MapCorrection, Reason};

/// So many of the newest keyframes in a row lie in one submap before it becomes the map, and so many of its keyframes have
/// depth: fewer are likelier a mistake than a place, and a switch costs a pass over all splats.
const MIN_IN_A_ROW: usize = 8;
const MIN_WITH_DEPTH: usize = 3;
/// Where the newest keyframes alternate, or no depth comes, one of at least this many keyframes that was never mapped, and
/// this many times as large as the map's.
const MIN_TAKEOVER: usize = 8;
const TAKEOVER_RATIO: usize = 2;

impl Submaps {
    pub(crate) fn parked(&self) -> &ParkedSubmaps {
        &self.parked
    }

    pub(crate) fn parked_mut(&mut self) -> &mut ParkedSubmaps {
        &mut self.parked
    }

    /// The submap that should be the map and is not.
    pub(crate) fn to_follow(&self, keyframes: &KeyframeStore) -> Option<u32> {
        let active = self.active?;
        let newest = self.newest(active, keyframes);
        let submap = *newest.first().filter(|submap| **submap != active)?;
        let in_a_row = newest.iter().take_while(|other| **other == submap).count();
        let is_mapped = self.parked.contains(submap);
        let detached = self.detached.values();
        let with_depth = detached.filter(|v| v.submap == submap && v.depth.width_px > 0);
        if in_a_row >= MIN_IN_A_ROW && (is_mapped || with_depth.count() >= MIN_WITH_DEPTH) {
            return Some(submap);
        }
        let own = keyframes.registered().len().max(1);
        let never_mapped = self.detached_counts().into_iter();
        let (largest, n) = never_mapped.max_by_key(|(_, n)| *n)?;
        (n >= MIN_TAKEOVER && n >= TAKEOVER_RATIO * own).then_some(largest)
    }

    /// The submap of each of the newest keyframes that have a pose, the newest first.
    fn newest(&self, active: u32, keyframes: &KeyframeStore) -> Vec<u32> {
        let own = keyframes.registered().keys().rev().map(|id| (*id, active));
        let mut newest: Vec<(u32, u32)> = own.take(MIN_IN_A_ROW).collect();
        let detached = self.detached.iter().rev();
        newest.extend(
            detached
                .map(|(id, view)| (*id, view.submap))
                .take(MIN_IN_A_ROW),
        );
        for parked in self.parked.iter() {
            let ids = parked.keyframes.registered().keys().rev();
            newest.extend(ids.map(|id| (*id, parked.submap)).take(MIN_IN_A_ROW));
        }
        newest.sort_unstable_by(|a, b| b.cmp(a));
        newest.dedup_by_key(|(id, _)| *id);
        newest.truncate(MIN_IN_A_ROW);
        newest.into_iter().map(|(_, submap)| submap).collect()
    }

    pub(crate) fn active(&self) -> Option<u32> {
        self.active
    }

    /// The map is put aside as it is.
    pub(crate) fn park(&mut self, parked: Parked) {
        self.anchor.clear();
        self.parked.insert(Arc::new(parked));
    }

    /// Another submap is the map from here on: what it was parked as, and what is to be registered in it.
    pub(crate) fn switch_to(&mut self, submap: u32) -> (Option<Parked>, Vec<View>) {
        self.active = Some(submap);
        let parked = self.take_parked();
        self.start_epoch(MapCorrection::identity(Reason::Reset));
        (parked, self.take_detached())
    }

    /// The parked submap that is by now the map's own.
    pub(super) fn take_parked(&mut self) -> Option<Parked> {
        let parked = self.parked.take(self.active?)?;
        // Nobody who knows the map by its revisions sees one twice.
        self.revision = self.revision.max(parked.snapshot.revision);
        Some(parked)
    }
}
