//! adam: gradients of the visible splats -> their update.
//!
//! Last stage. Selective: a splat that the view does not see keeps its parameters and moments, and bias correction
//! follows each splat's own age (Kingma & Ba 2015; Mallick et al. 2024 for the selection).

use std::sync::LazyLock;

use multiversion::multiversion;
use rayon::prelude::*;

use super::adam_sh::{BAND_0, ShMoments};
use super::project::{CHUNK, Projected};
use super::project_backward::SplatGradients;
use super::rows::{make_room, retain_rows};
use crate::splat::{Splats, StepSettings};

pub(crate) const BETA_1: f32 = 0.9;
pub(crate) const BETA_2: f32 = 0.999;
pub(crate) const EPS: f32 = 1e-15;
/// From this age on both corrections are 1 in f32.
const MAX_CORRECTED_AGE: u16 = 16_640;

/// What bias correction makes of the moments, by age: `1 / (1 - beta_1^t)` and `1 / sqrt(1 - beta_2^t)`.
static CORRECTIONS: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let correction = |age: u16| {
        let rest = [BETA_1, BETA_2].map(|beta| 1.0 - f64::from(beta).powf(f64::from(age)));
        [1.0 / rest[0], 1.0 / rest[1].sqrt()].map(|c| c as f32)
    };
    (0..=MAX_CORRECTED_AGE).map(correction).collect()
});

/// Adam's state of all splats, and how long they have been there.
#[derive(Debug, Default)]
pub struct Optimiser {
    means: Moments,
    log_scales: Moments,
    quats: Moments,
    opacity_logits: Moments,
    sh_band_0: Moments,
    sh_above: ShMoments,
    ages: Vec<Ages>,
    /// Number of the step that last saw the splat, or brought it.
    last_seen: Vec<u32>,
    /// Of the visible splats, after the update; `None`: left alone.
    updated: Vec<Option<Ages>>,
}

/// First and second moment of one attribute, one row a splat.
#[derive(Debug, Clone, Default, PartialEq)]
struct Moments {
    first: Vec<f32>,
    second: Vec<f32>,
}

/// Updates that a splat has had; both counts stop at their largest.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Ages {
    /// Since its moments were 0: what bias correction needs.
    since_cleared: u16,
    /// In all, those of the splat that it was copied from included: what admits SH bands. A splat that is shared out
    /// every few hundred steps would else never come to its upper bands.
    in_all: u16,
}

/// One attribute of all splats, or a part of it: the first `n` of `stride` numbers.
struct Attribute<'a> {
    params: &'a mut [f32],
    stride: usize,
    n: usize,
    moments: &'a mut Moments,
    /// `grad_stride` numbers per visible splat.
    grads: &'a [f32],
    grad_stride: usize,
    rate: f32,
}

impl Optimiser {
    /// Splats behind those that were there start at rest, seen by step `now`.
    pub(crate) fn resize(&mut self, splats: &Splats, now: u32) {
        let n = splats.len();
        let more = n.saturating_sub(self.ages.len());
        make_room(&mut self.ages, more);
        make_room(&mut self.last_seen, more);
        self.ages.resize(n, Ages::default());
        self.last_seen.resize(n, now);
        for (moments, stride) in self.moments_mut() {
            make_room(&mut moments.first, more * stride);
            make_room(&mut moments.second, more * stride);
            moments.first.resize(n * stride, 0.0);
            moments.second.resize(n * stride, 0.0);
        }
        self.sh_above.resize(n, splats.sh_stride());
    }

    pub(crate) fn retain(&mut self, sh_stride: usize, keep: &[bool]) {
        retain_rows(&mut self.ages, 1, keep);
        retain_rows(&mut self.last_seen, 1, keep);
        for (moments, stride) in self.moments_mut() {
            retain_rows(&mut moments.first, stride, keep);
            retain_rows(&mut moments.second, stride, keep);
        }
        self.sh_above.retain(sh_stride, keep);
    }

    /// Puts the moments of splat `ix` to 0.
    pub(crate) fn clear(&mut self, sh_stride: usize, ix: usize) {
        self.ages[ix].since_cleared = 0;
        for (moments, stride) in self.moments_mut() {
            moments.first[ix * stride..(ix + 1) * stride].fill(0.0);
            moments.second[ix * stride..(ix + 1) * stride].fill(0.0);
        }
        self.sh_above.clear(sh_stride, ix);
    }

    /// Makes splat `to` as old as `from`, from which it was copied.
    pub(crate) fn copy_age(&mut self, from: usize, to: usize) {
        self.ages[to] = self.ages[from];
        self.last_seen[to] = self.last_seen[from];
    }

    /// Updates that each splat has had in all.
    pub(crate) fn ages(&self) -> Vec<u16> {
        self.ages.iter().map(|ages| ages.in_all).collect()
    }

    /// Of splats from `first` on, whose moments are 0.
    pub(crate) fn set_ages(&mut self, first: usize, ages: &[u16]) {
        for (own, in_all) in self.ages[first..].iter_mut().zip(ages) {
            own.in_all = *in_all;
        }
    }

    /// Parameters included.
    pub(crate) fn bytes_per_splat(sh_degree: u8) -> usize {
        let n_sh = 3 * (usize::from(sh_degree) + 1).pow(2);
        let of_moments = 2 * (3 + 3 + 4 + 1 + BAND_0);
        let words = 3 + 3 + 4 + 1 + n_sh + 1 + of_moments + size_of::<Ages>() / 4 + 1;
        4 * words + ShMoments::bytes_per_splat(sh_degree)
    }

    /// Room for more rows included.
    pub(crate) fn held_bytes(&self) -> usize {
        let all = [
            &self.means,
            &self.log_scales,
            &self.quats,
            &self.opacity_logits,
            &self.sh_band_0,
        ];
        let of_moments = |m: &&Moments| 4 * (m.first.capacity() + m.second.capacity());
        all.iter().map(of_moments).sum::<usize>()
            + self.sh_above.held_bytes()
            + size_of::<Ages>() * self.ages.capacity()
            + 4 * self.last_seen.capacity()
    }

    /// Steps since the splat was seen; 0: by step `now` itself.
    pub(crate) fn unseen(&self, ix: usize, now: u32) -> u32 {
        now.wrapping_sub(self.last_seen[ix])
    }

    /// Moves the visible splats. Returns how many were left alone because their gradient is not finite.
    pub(crate) fn update(
        &mut self,
        splats: &mut Splats,
        projected: &Projected,
        gradients: &SplatGradients,
        settings: &StepSettings,
        now: u32,
    ) -> usize {
        let n_skipped = self.grow_older(projected, &gradients.is_finite, now);
        let (g, updated, sh_stride) = (gradients, &self.updated, splats.sh_stride());
        let run = |params, moments, grads, [stride, n, grad_stride]: [usize; 3], rate| {
            let attribute = Attribute {
                params,
                stride,
                n,
                moments,
                grads,
                grad_stride,
                rate,
            };
            adam(attribute, projected, updated);
        };
        let (params, grads) = (splats.means.as_flattened_mut(), g.means.as_flattened());
        run(params, &mut self.means, grads, [3; 3], settings.lr_mean);
        let params = splats.log_scales.as_flattened_mut();
        let grads = g.log_scales.as_flattened();
        run(
            params,
            &mut self.log_scales,
            grads,
            [3; 3],
            settings.lr_scale,
        );
        let (params, grads) = (splats.quats.as_flattened_mut(), g.quats.as_flattened());
        run(params, &mut self.quats, grads, [4; 3], settings.lr_quat);
        let (params, grads) = (&mut splats.opacity_logits, &g.opacity_logits);
        let moments = &mut self.opacity_logits;
        run(params, moments, grads, [1; 3], settings.lr_opacity);
        let strides = [sh_stride, BAND_0, g.sh_stride];
        let moments = &mut self.sh_band_0;
        run(&mut splats.sh, moments, &g.sh, strides, settings.lr_sh0);
        self.sh_above
            .update(splats, projected, g, updated, settings);
        n_skipped
    }

    /// Ages every visible splat that has a finite gradient by one step. Returns how many had none.
    fn grow_older(&mut self, projected: &Projected, is_finite: &[bool], now: u32) -> usize {
        self.updated.clear();
        let mut n_skipped = 0;
        for (splat, &is_finite) in projected.splats.iter().zip(is_finite) {
            let ix = splat.splat_ix as usize;
            self.last_seen[ix] = now;
            if !is_finite {
                n_skipped += 1;
                self.updated.push(None);
                continue;
            }
            let ages = &mut self.ages[ix];
            ages.since_cleared = ages.since_cleared.saturating_add(1);
            ages.in_all = ages.in_all.saturating_add(1);
            self.updated.push(Some(*ages));
        }
        n_skipped
    }

    /// With the numbers of one splat, since moments are flat.
    fn moments_mut(&mut self) -> [(&mut Moments, usize); 5] {
        [
            (&mut self.means, 3),
            (&mut self.log_scales, 3),
            (&mut self.quats, 4),
            (&mut self.opacity_logits, 1),
            (&mut self.sh_band_0, BAND_0),
        ]
    }
}

impl Ages {
    /// Updates of an SH band, this one included; `None`: it is not its turn yet.
    pub(crate) fn of_band(self, band: u32, interval: u32) -> Option<u16> {
        let first = band.saturating_mul(interval).clamp(1, u32::from(u16::MAX)) as u16;
        let since_first = self.in_all.checked_sub(first)?.saturating_add(1);
        Some(since_first.min(self.since_cleared))
    }
}

pub(crate) fn correction(age: u16) -> [f32; 2] {
    CORRECTIONS[usize::from(age.min(MAX_CORRECTED_AGE))]
}

/// Moves one attribute of the visible splats.
fn adam(attribute: Attribute<'_>, projected: &Projected, updated: &[Option<Ages>]) {
    let Attribute {
        params,
        stride,
        n,
        moments,
        grads,
        grad_stride,
        rate,
    } = attribute;
    let chunks = (
        params.par_chunks_mut(CHUNK * stride),
        moments.first.par_chunks_mut(CHUNK * n),
        moments.second.par_chunks_mut(CHUNK * n),
    );
    let chunks = chunks.into_par_iter().enumerate();
    chunks.for_each(|(c, (params, first, second))| {
        for v in projected.of_chunk(c) {
            let Some(ages) = updated[v] else { continue };
            let place = projected.splats[v].splat_ix as usize - c * CHUNK;
            let row = place * n..(place + 1) * n;
            update(
                &mut params[place * stride..place * stride + n],
                (&mut first[row.clone()], &mut second[row]),
                &grads[v * grad_stride..v * grad_stride + n],
                correction(ages.since_cleared),
                rate,
            );
        }
    });
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn update(
    params: &mut [f32],
    (first, second): (&mut [f32], &mut [f32]),
    grads: &[f32],
    [unbias_first, unbias_second]: [f32; 2],
    rate: f32,
) {
    let n = grads.len();
    let (params, first, second) = (&mut params[..n], &mut first[..n], &mut second[..n]);
    for i in 0..n {
        let g = grads[i];
        let m = BETA_1 * first[i] + (1.0 - BETA_1) * g;
        let v = BETA_2 * second[i] + (1.0 - BETA_2) * g * g;
        first[i] = m;
        second[i] = v;
        params[i] -= rate * (m * unbias_first) / (v.sqrt() * unbias_second + EPS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parameters, moments, ages and the anchor; bytes that a splat with SH of degree 3 may take.
    const MAX_BYTES: usize = 480;

    #[test]
    fn a_splat_and_its_moments_fit_the_memory_it_may_take() {
        const N: usize = 1000;
        let mut splats = Splats {
            sh_degree: 3,
            ..Splats::default()
        };
        splats.means.resize(N, [0.0; 3]);
        splats.log_scales.resize(N, [0.0; 3]);
        splats.quats.resize(N, [0.0; 4]);
        splats.opacity_logits.resize(N, 0.0);
        splats.sh.resize(48 * N, 0.0);
        splats.anchors.resize(N, 0);
        let mut optimiser = Optimiser::default();
        optimiser.resize(&splats, 0);
        let of_moments = optimiser
            .moments_mut()
            .map(|(moments, _)| size_of_val(&moments.first[..]) + size_of_val(&moments.second[..]));
        let n_bytes = size_of_val(&splats.means[..])
            + size_of_val(&splats.log_scales[..])
            + size_of_val(&splats.quats[..])
            + size_of_val(&splats.opacity_logits[..])
            + size_of_val(&splats.sh[..])
            + size_of_val(&splats.anchors[..])
            + of_moments.iter().sum::<usize>()
            + optimiser.sh_above.n_bytes()
            + size_of_val(&optimiser.ages[..])
            + size_of_val(&optimiser.last_seen[..]);
        assert_eq!(n_bytes, 462 * N);
        const { assert!(462 <= MAX_BYTES) };
    }

    #[test]
    fn a_band_waits_for_its_turn_and_then_counts_its_own_updates() {
        let ages = |since_cleared, in_all| Ages {
            since_cleared,
            in_all,
        };
        assert_eq!(ages(5, 5).of_band(3, 0), Some(5), "no interval");
        assert_eq!(ages(99, 99).of_band(1, 100), None);
        assert_eq!(ages(100, 100).of_band(1, 100), Some(1), "its first");
        assert_eq!(ages(150, 250).of_band(2, 100), Some(51));
        assert_eq!(ages(3, 250).of_band(2, 100), Some(3), "cleared since");
        assert_eq!(ages(9, 9).of_band(3, u32::MAX), None);
    }
}
