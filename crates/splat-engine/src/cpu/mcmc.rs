//! moves: dead splats to live ones, more where there are many, noise on the faint (MCMC).
//!
//! Who is drawn and what becomes of it is `mcmc`'s; here are the tables. Draws count on from splat to splat and depend
//! on nothing but the seed. Equations: docs/GRADIENTS.md, MCMC.

use rayon::prelude::*;

use crate::cpu::adam::Optimiser;
use crate::cpu::project::{CHUNK, Projected, sigmoid};
use crate::mcmc;
use crate::settings::{McmcSettings, StepSettings};
use splat_types::splats::splats::Splats;

/// All of one pass: the tables that it changes, and the step that was the last.
struct Moves<'a> {
    splats: &'a mut Splats,
    optimiser: &'a mut Optimiser,
    settings: &'a McmcSettings,
    now: u32,
}

/// Fills the places of the dead, then adds splats behind the last. With nothing alive, nothing changes.
pub(crate) fn relocate_and_grow(
    splats: &mut Splats,
    optimiser: &mut Optimiser,
    settings: &McmcSettings,
    now: u32,
) {
    let mut moves = Moves {
        splats,
        optimiser,
        settings,
        now,
    };
    let n = moves.splats.len();
    let dead: Vec<usize> = (0..n).filter(|&ix| !moves.is_live(ix)).collect();
    moves.fill(&dead, mcmc::RELOCATION);
    let added: Vec<usize> = (n..mcmc::grown(n, settings.growth, settings.max_splats)).collect();
    moves.fill(&added, mcmc::GROWTH);
}

impl Moves<'_> {
    fn is_live(&self, ix: usize) -> bool {
        sigmoid(self.splats.opacity_logits[ix]) > self.settings.min_opacity
            && self.splats.is_finite(ix)
    }

    /// May be copied.
    fn is_source(&self, ix: usize) -> bool {
        let active_steps = self.settings.active_steps;
        let is_active = active_steps == 0 || self.optimiser.unseen(ix, self.now) < active_steps;
        is_active && self.is_live(ix)
    }

    /// Makes each place the copy of a source that is drawn for it. The places may lie behind the last splat.
    fn fill(&mut self, places: &[usize], kind: u32) {
        let sources = self.draw(places.len(), kind);
        let mut n_shares = vec![1_u32; self.splats.len()];
        for &source in &sources {
            n_shares[source] = n_shares[source].saturating_add(1);
        }
        let shared = (0..n_shares.len()).filter(|&ix| n_shares[ix] > 1);
        for ix in shared {
            self.share(ix, n_shares[ix]);
        }
        for (&source, &place) in sources.iter().zip(places) {
            self.splats.copy_row(source, place);
        }
        self.optimiser.resize(self.splats, self.now);
        for (&source, &place) in sources.iter().zip(places) {
            self.optimiser.clear(self.splats.sh_stride(), place);
            self.optimiser.copy_age(source, place);
        }
    }

    /// With replacement, by opacity. Empty when there is nobody to draw.
    fn draw(&self, n_draws: usize, kind: u32) -> Vec<usize> {
        if n_draws == 0 {
            return Vec::new();
        }
        let bits = mcmc::weight_bits(self.splats.len());
        let mut total = 0;
        let starts: Vec<u32> = (0..self.splats.len())
            .map(|ix| {
                let start = total;
                if self.is_source(ix) {
                    total += mcmc::weight(sigmoid(self.splats.opacity_logits[ix]), bits);
                }
                start
            })
            .collect();
        if total == 0 {
            return Vec::new();
        }
        let draw = |k: usize| {
            let [word, ..] = mcmc::hash([self.settings.seed, k as u32, kind]);
            mcmc::draw(&starts, total, word)
        };
        (0..n_draws).map(draw).collect()
    }

    /// Makes a splat one of `n` at its place.
    fn share(&mut self, ix: usize, n: u32) {
        let logit = &mut self.splats.opacity_logits[ix];
        let McmcSettings {
            copies,
            min_opacity,
            ..
        } = *self.settings;
        let (opacity, factor) = copies.shared(sigmoid(*logit), n, min_opacity);
        *logit = (opacity / (1.0 - opacity)).ln();
        let by = factor.ln();
        self.splats.log_scales[ix].iter_mut().for_each(|l| *l += by);
        self.optimiser.clear(self.splats.sh_stride(), ix);
        if self.settings.keeps_age {
            self.optimiser.keep_age(ix);
        }
    }
}

/// Noise on the means of the splats that step `now` has seen, or of all.
pub(crate) fn add_noise(splats: &mut Splats, seen: &Projected, settings: &StepSettings, now: u32) {
    if settings.noise <= 0.0 || settings.noise.is_nan() {
        return;
    }
    let (log_scales, quats) = (&splats.log_scales, &splats.quats);
    let logits = &splats.opacity_logits;
    let chunks = splats.means.par_chunks_mut(CHUNK).enumerate();
    chunks.for_each(|(c, means)| {
        let of_chunk = if settings.all_splats {
            0..means.len()
        } else {
            seen.of_chunk(c)
        };
        for v in of_chunk {
            let ix = if settings.all_splats {
                c * CHUNK + v
            } else {
                seen.splats[v].splat_ix as usize
            };
            let opacity = sigmoid(logits[ix]);
            let Some(quat) = unit(quats[ix]) else {
                continue;
            };
            if opacity.is_nan() || opacity > mcmc::MAX_SHAKEN_OPACITY {
                continue;
            }
            let eta = mcmc::normal3([settings.noise_seed, now, ix as u32]);
            let offset = mcmc::add_noise(log_scales[ix], quat, opacity, eta);
            let mean = &mut means[ix - c * CHUNK];
            let moved = [0, 1, 2].map(|k| mean[k] + settings.noise * offset[k]);
            if moved.iter().all(|x| x.is_finite()) {
                *mean = moved;
            }
        }
    });
}

/// One without direction is the identity, as in `project`; `None`: not finite.
fn unit(quat: [f32; 4]) -> Option<[f32; 4]> {
    let length = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
    if length == 0.0 {
        return Some([1.0, 0.0, 0.0, 0.0]);
    }
    length.is_finite().then(|| quat.map(|q| q / length))
}
