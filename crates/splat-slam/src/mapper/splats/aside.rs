//! All splats of the engine -> a copy on the host, and back behind those that are there by then.

use std::collections::{BTreeMap, BTreeSet};

use crate::mapper::splats::regions::Evicted;
use crate::mapper::splats::store::{FiniteSplats, SplatSet};
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_types::splats::splats::Splats;
use splat_types::transform::Similarity;

/// What belongs to splats that left the engine, beside their numbers.
#[derive(Debug, Clone, Default)]
pub(crate) struct Aside {
    pub(crate) on_disk: BTreeMap<u32, Evicted>,
    /// Ids of splats at a depth that no view has verified.
    guessed: BTreeSet<u32>,
}

impl Aside {
    /// It lies in another world.
    pub(crate) fn carry(&mut self, motion: &Similarity) {
        self.on_disk
            .values_mut()
            .for_each(|region| region.carry(motion));
    }

    /// Of other splats, which go with these from here on.
    pub(crate) fn absorb(&mut self, other: Self) {
        self.on_disk.extend(other.on_disk);
        self.guessed.extend(other.guessed);
    }
}

impl SplatSet {
    /// So many of the cap are for splats that are not in the engine.
    pub(crate) fn set_parked(&mut self, n: usize) {
        self.n_parked = n;
    }

    /// The engine is empty afterwards.
    pub(crate) fn take_all(
        &mut self,
        engine: &mut dyn Engine,
    ) -> Result<(FiniteSplats, Aside), EngineError> {
        let copy = self.finite_copy(engine)?;
        self.retain(&vec![false; engine.len()], engine)?;
        let aside = Aside {
            on_disk: std::mem::take(&mut self.on_disk),
            guessed: std::mem::take(&mut self.guessed),
        };
        Ok((copy, aside))
    }

    /// They get new ids: those ascend in the engine's order.
    pub(crate) fn put_back(
        &mut self,
        (splats, ids, update_counts): (&Splats, &[u32], &[u16]),
        aside: Aside,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let first = engine.len();
        if !splats.is_empty() {
            self.append(splats, engine)?;
            // An adapter may have room for fewer.
            let n = engine.len() - first;
            engine.set_update_counts(first, &update_counts[..n])?;
        }
        self.on_disk.extend(aside.on_disk);
        if !self.is_renumbered {
            let renumbered = self.ids.all()[first..].iter().zip(ids);
            let guessed = renumbered.filter(|(_, old)| aside.guessed.contains(old));
            self.guessed.extend(guessed.map(|(new, _)| *new));
        }
        Ok(())
    }
}
