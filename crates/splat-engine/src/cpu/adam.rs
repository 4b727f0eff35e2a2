//! adam: gradients of the visible splats -> their update.
//!
//! Last stage. Selective: a splat that the view does not see keeps its parameters and moments, and bias correction
//! follows each splat's own age (Kingma & Ba 2015; Mallick et al. 2024 for the selection).

use multiversion::multiversion;
use rayon::prelude::*;

use crate::cpu::adam_sh::{BAND_0, ShMoments};
use crate::cpu::moments::{BETA_1, BETA_2, EPS, Moments, UpdateCounts, correction};
use crate::cpu::project::{CHUNK, Projected};
use crate::cpu::project_backward::SplatGradients;
use crate::densify::ScreenGradients;
use crate::settings::StepSettings;
use splat_types::splats::rows::{make_room, retain_rows};
use splat_types::splats::splats::Splats;

/// Adam's state of all splats, and how long they have been there.
#[derive(Debug, Default)]
pub(crate) struct Optimiser {
    pub(crate) means: Moments,
    pub(crate) log_scales: Moments,
    pub(crate) quats: Moments,
    pub(crate) opacity_logits: Moments,
    pub(crate) sh_band_0: Moments,
    pub(crate) sh_above: ShMoments,
    pub(crate) update_counts: Vec<UpdateCounts>,
    /// Number of the step that last saw the splat, or brought it.
    pub(crate) last_seen: Vec<u32>,
    pub(crate) screen_gradients: ScreenGradients,
    /// Of the visible splats, after the update; `None`: left alone.
    updated: Vec<Option<UpdateCounts>>,
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
    /// Fall of the rate with the updates of a splat; 0: none.
    decay: f32,
}

impl Optimiser {
    /// Splats behind those that were there start at rest, seen by step `now`.
    pub(crate) fn resize(&mut self, splats: &Splats, now: u32) {
        let n = splats.len();
        let more = n.saturating_sub(self.update_counts.len());
        make_room(&mut self.update_counts, more);
        make_room(&mut self.last_seen, more);
        self.update_counts.resize(n, UpdateCounts::default());
        self.last_seen.resize(n, now);
        for (moments, stride) in self.moments_mut() {
            make_room(&mut moments.first, more * stride);
            make_room(&mut moments.second, more * stride);
            moments.first.resize(n * stride, 0.0);
            moments.second.resize(n * stride, 0.0);
        }
        self.sh_above.resize(n, splats.sh_stride());
        self.screen_gradients.resize(n);
    }

    pub(crate) fn retain(&mut self, sh_stride: usize, keep: &[bool]) {
        retain_rows(&mut self.update_counts, 1, keep);
        retain_rows(&mut self.last_seen, 1, keep);
        for (moments, stride) in self.moments_mut() {
            retain_rows(&mut moments.first, stride, keep);
            retain_rows(&mut moments.second, stride, keep);
        }
        self.sh_above.retain(sh_stride, keep);
        self.screen_gradients.retain(keep);
    }

    /// Puts the moments of splat `ix` to 0.
    pub(crate) fn clear(&mut self, sh_stride: usize, ix: usize) {
        self.update_counts[ix].since_cleared = 0;
        for (moments, stride) in self.moments_mut() {
            moments.first[ix * stride..(ix + 1) * stride].fill(0.0);
            moments.second[ix * stride..(ix + 1) * stride].fill(0.0);
        }
        self.sh_above.clear(sh_stride, ix);
        self.screen_gradients.clear(ix);
    }

    /// Puts the moments of all opacities to 0; bias correction goes on.
    pub(crate) fn clear_opacities(&mut self) {
        self.opacity_logits.first.fill(0.0);
        self.opacity_logits.second.fill(0.0);
    }

    /// The moments of splat `ix` count as old as it is.
    pub(crate) fn keep_age(&mut self, ix: usize) {
        let counts = &mut self.update_counts[ix];
        counts.since_cleared = counts.in_all;
    }

    /// Makes splat `to` as old as `from`, from which it was copied.
    pub(crate) fn copy_age(&mut self, from: usize, to: usize) {
        self.update_counts[to] = self.update_counts[from];
        self.last_seen[to] = self.last_seen[from];
    }

    /// Updates that each splat has had in all.
    pub(crate) fn update_counts(&self) -> Vec<u16> {
        self.update_counts
            .iter()
            .map(|update_counts| update_counts.in_all)
            .collect()
    }

    /// Of splats from `first` on, whose moments are 0.
    pub(crate) fn set_update_counts(&mut self, first: usize, update_counts: &[u16]) {
        for (own, in_all) in self.update_counts[first..].iter_mut().zip(update_counts) {
            own.in_all = *in_all;
        }
    }

    /// Parameters included.
    pub(crate) fn bytes_per_splat(&self, sh_degree: u8) -> usize {
        let n_sh = 3 * (usize::from(sh_degree) + 1).pow(2);
        let of_moments = 2 * (3 + 3 + 4 + 1 + BAND_0);
        let words = 3 + 3 + 4 + 1 + n_sh + 1 + of_moments + size_of::<UpdateCounts>() / 4 + 1;
        let accumulates = !self.screen_gradients.counts.is_empty();
        let of_screen = if accumulates { 8 } else { 0 };
        4 * words + ShMoments::bytes_per_splat(sh_degree) + of_screen
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
            + self.screen_gradients.held_bytes()
            + size_of::<UpdateCounts>() * self.update_counts.capacity()
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
                decay: 0.0,
            };
            adam(attribute, projected, updated);
        };
        let means = Attribute {
            params: splats.means.as_flattened_mut(),
            stride: 3,
            n: 3,
            moments: &mut self.means,
            grads: g.means.as_flattened(),
            grad_stride: 3,
            rate: settings.lr_mean,
            decay: settings.lr_mean_decay,
        };
        adam(means, projected, updated);
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

    /// Update counts every visible splat that has a finite gradient by one step. Returns how many had none.
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
            let update_counts = &mut self.update_counts[ix];
            update_counts.since_cleared = update_counts.since_cleared.saturating_add(1);
            update_counts.in_all = update_counts.in_all.saturating_add(1);
            self.updated.push(Some(*update_counts));
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

/// Moves one attribute of the visible splats.
fn adam(attribute: Attribute<'_>, projected: &Projected, updated: &[Option<UpdateCounts>]) {
    let Attribute {
        params,
        stride,
        n,
        moments,
        grads,
        grad_stride,
        rate,
        decay,
    } = attribute;
    let chunks = (
        params.par_chunks_mut(CHUNK * stride),
        moments.first.par_chunks_mut(CHUNK * n),
        moments.second.par_chunks_mut(CHUNK * n),
    );
    let chunks = chunks.into_par_iter().enumerate();
    chunks.for_each(|(c, (params, first, second))| {
        for v in projected.of_chunk(c) {
            let Some(update_counts) = updated[v] else {
                continue;
            };
            let place = projected.splats[v].splat_ix as usize - c * CHUNK;
            let row = place * n..(place + 1) * n;
            update(
                &mut params[place * stride..place * stride + n],
                (&mut first[row.clone()], &mut second[row]),
                &grads[v * grad_stride..v * grad_stride + n],
                correction(update_counts.since_cleared),
                rate * update_counts.share_of_rate(decay),
            );
        }
    });
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
pub(crate) fn update(
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

    /// Parameters, moments, update counts and the anchor; bytes that a splat with SH of degree 3 may take.
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
            + size_of_val(&optimiser.update_counts[..])
            + size_of_val(&optimiser.last_seen[..]);
        assert_eq!(n_bytes, 462 * N);
        const { assert!(462 <= MAX_BYTES) };
    }
}
