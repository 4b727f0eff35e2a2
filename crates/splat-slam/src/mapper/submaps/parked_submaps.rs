//! All submaps that are parked: they follow geometry, join each other, and keep within the budgets that all submaps share.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::metric_scale_params::ScaleParams;
use crate::mapper::pages::Paging;
use crate::mapper::submaps::parked::Parked;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_geometry::answer::PoseUpdate;

/// By geometry's number. A copy is cheap.
#[derive(Debug, Clone, Default)]
pub(crate) struct ParkedSubmaps {
    by_submap: BTreeMap<u32, Arc<Parked>>,
}

impl ParkedSubmaps {
    pub(crate) fn insert(&mut self, parked: Arc<Parked>) {
        self.by_submap.insert(parked.submap, parked);
    }

    pub(crate) fn take(&mut self, submap: u32) -> Option<Parked> {
        self.by_submap.remove(&submap).map(Arc::unwrap_or_clone)
    }

    pub(crate) fn clear(&mut self) {
        self.by_submap.clear();
    }

    pub(crate) fn contains(&self, submap: u32) -> bool {
        self.by_submap.contains_key(&submap)
    }

    /// In order of number.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Parked> {
        self.by_submap.values().map(|parked| &**parked)
    }

    pub(crate) fn iter_mut(&mut self) -> impl Iterator<Item = &mut Parked> {
        self.by_submap.values_mut().map(Arc::make_mut)
    }

    pub(crate) fn has_keyframe(&self, keyframe_id: u32) -> bool {
        self.iter()
            .any(|parked| parked.keyframes.registered().contains_key(&keyframe_id))
    }

    pub(crate) fn n_splats(&self) -> usize {
        self.iter().map(Parked::n_splats).sum()
    }

    pub(crate) fn n_keyframes(&self) -> usize {
        self.iter().map(Parked::n_keyframes).sum()
    }

    /// The submap with the most keyframes, the older of two, if it has more than `n_own`.
    pub(crate) fn larger_than(&self, n_own: usize) -> Option<u32> {
        let newest_first = self.by_submap.values().rev();
        let largest = newest_first.max_by_key(|parked| parked.n_keyframes())?;
        (largest.n_keyframes() > n_own).then_some(largest.submap)
    }

    /// Each in its own world; those that have become one are parked as one.
    pub(crate) fn apply_updates(&mut self, updates: &[PoseUpdate]) {
        for mut parked in std::mem::take(&mut self.by_submap).into_values() {
            if parked.is_named_in(updates) {
                Arc::make_mut(&mut parked).apply_updates(updates);
            }
            if let Some(mut other) = self.by_submap.remove(&parked.submap) {
                Arc::make_mut(&mut other).absorb(Arc::unwrap_or_clone(parked));
                parked = other;
            }
            self.insert(parked);
        }
    }

    /// What they keep of `max_splats` in any case, beside `n_own_keyframes` of the map: as large a part as theirs of all
    /// keyframes, if they have so many splats.
    pub(crate) fn kept(&self, max_splats: usize, n_own_keyframes: usize) -> usize {
        let n_keyframes = n_own_keyframes + self.n_keyframes();
        let kept = |parked: &Parked| {
            parked
                .n_splats()
                .min(share(parked, max_splats, n_keyframes))
        };
        self.iter().map(kept).sum()
    }

    /// Where they and `n_own` splats of the map are more than `max_splats`, the faintest of them go, of the smallest submap
    /// first, and none of what it keeps in any case. Returns how many have gone.
    pub(crate) fn prune(
        &mut self,
        max_splats: usize,
        (n_own, n_own_keyframes): (usize, usize),
    ) -> usize {
        let over = (n_own + self.n_splats()).saturating_sub(max_splats);
        let n_keyframes = n_own_keyframes + self.n_keyframes();
        let mut by_size: Vec<&mut Arc<Parked>> = self.by_submap.values_mut().collect();
        by_size.sort_by_key(|parked| (parked.n_splats(), parked.submap));
        let mut left = over;
        for parked in by_size {
            let n = parked.n_splats();
            let n_gone = left.min(n.saturating_sub(share(parked, max_splats, n_keyframes)));
            if n_gone > 0 {
                Arc::make_mut(parked).prune_to(n - n_gone);
                left -= n_gone;
            }
        }
        over - left
    }

    /// At most `most` of their images stay in memory. Returns how many were lost.
    pub(crate) fn page_out(
        &mut self,
        most: usize,
        engine: &mut dyn Engine,
        paging: &mut Paging,
        metres: Option<&ScaleParams>,
    ) -> Result<u64, EngineError> {
        let (mut room, mut n_lost) = (most, 0);
        for parked in self.by_submap.values_mut() {
            let n_here = parked.keyframes.n_resident();
            if n_here > room {
                let keyframes = &mut Arc::make_mut(parked).keyframes;
                n_lost += keyframes.page_out_oldest(room, engine, paging, metres)?;
            }
            room -= n_here.min(room);
        }
        Ok(n_lost)
    }
}

/// Of the cap, by the number of keyframes.
fn share(parked: &Parked, max_splats: usize, n_keyframes: usize) -> usize {
    max_splats * parked.n_keyframes() / n_keyframes.max(1)
}
