//! Splats at a depth that no view has verified, until one has.

use std::collections::BTreeSet;

use crate::mapper::splats::seeds::{Guess, Seeds};
use crate::mapper::splats::store::SplatSet;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_types::splats::splats::Splats;

impl SplatSet {
    /// Adds splats, of which some lie at a depth that no view has verified.
    pub(crate) fn append_seeds(
        &mut self,
        seeds: &Seeds,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        if seeds.splats.is_empty() {
            return Ok(());
        }
        let n_before = engine.len();
        self.append(&seeds.splats, engine)?;
        let added = self.ids.all()[n_before..].iter().zip(&seeds.is_guess);
        self.guessed
            .extend(added.filter(|(_, is_guess)| **is_guess).map(|(id, _)| *id));
        // What was pruned or went to disk must not add up.
        if self.guessed.len() > 2 * engine.len() {
            let here: BTreeSet<u32> = self.ids.all().iter().copied().collect();
            self.guessed.retain(|id| here.contains(id));
        }
        Ok(())
    }

    /// Judges all guesses: those that verified depth confirms are none any more, and those that it has something better for go.
    pub(crate) fn judge_guesses(
        &mut self,
        judge: impl Fn(&Splats, usize) -> Guess,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        if self.guessed.is_empty() {
            return Ok(());
        }
        let splats = engine.read()?;
        let mut keep = vec![true; splats.len()];
        for (ix, id) in self.ids.all().iter().enumerate() {
            if !self.guessed.contains(id) {
                continue;
            }
            match judge(&splats, ix) {
                Guess::Open => {}
                Guess::Confirmed => {
                    self.guessed.remove(id);
                }
                Guess::Replaced => keep[ix] = false,
            }
        }
        if keep.iter().any(|k| !k) {
            self.retain(&keep, engine)?;
        }
        Ok(())
    }
}
