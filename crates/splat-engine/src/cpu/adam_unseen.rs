//! adam_unseen: splats that the view does not show -> their update by momentum and regularisers alone.
//!
//! After `adam`, only where a step moves all splats: so a dense Adam has it, as in 3DGS-MCMC. Equations: docs/GRADIENTS.md, adam.

use rayon::prelude::*;

use crate::cpu::adam::{Optimiser, update};
use crate::cpu::adam_sh::BAND_0;
use crate::cpu::moments::{Moments, UpdateCounts, correction};
use crate::cpu::project::{CHUNK, sigmoid};
use crate::settings::StepSettings;
use splat_types::splats::splats::Splats;

/// Numbers of the widest attribute.
const WIDEST: usize = 4;

impl Optimiser {
    /// Moves the splats that step `now` has not seen.
    pub(crate) fn update_unseen(&mut self, splats: &mut Splats, settings: &StepSettings, now: u32) {
        let unseen = self.grow_unseen_older(splats, settings, now);
        let n = splats.len() as f32;
        let [by_opacity, by_scale] = [
            settings.weights.opacity_reg / n,
            settings.weights.scale_reg / (3.0 * n),
        ];
        let opacity_gradient = |params: &[f32], out: &mut [f32]| {
            let opacity = sigmoid(params[0]);
            out[0] = by_opacity * opacity * (1.0 - opacity);
        };
        let scale_gradient = |params: &[f32], out: &mut [f32]| {
            for (out, log_scale) in out.iter_mut().zip(params) {
                *out = by_scale * log_scale.exp();
            }
        };
        let none = |_: &[f32], _: &mut [f32]| {};
        let means = splats.means.as_flattened_mut();
        let decayed = (settings.lr_mean, settings.lr_mean_decay);
        adam(means, &mut self.means, [3; 2], &unseen, decayed, none);
        let log_scales = splats.log_scales.as_flattened_mut();
        let rate = (settings.lr_scale, 0.0);
        adam(
            log_scales,
            &mut self.log_scales,
            [3; 2],
            &unseen,
            rate,
            scale_gradient,
        );
        let quats = splats.quats.as_flattened_mut();
        adam(
            quats,
            &mut self.quats,
            [4; 2],
            &unseen,
            (settings.lr_quat, 0.0),
            none,
        );
        let (logits, moments) = (&mut splats.opacity_logits, &mut self.opacity_logits);
        let rate = (settings.lr_opacity, 0.0);
        adam(logits, moments, [1; 2], &unseen, rate, opacity_gradient);
        let strides = [splats.sh_stride(), BAND_0];
        let rate = (settings.lr_sh0, 0.0);
        adam(
            &mut splats.sh,
            &mut self.sh_band_0,
            strides,
            &unseen,
            rate,
            none,
        );
        self.sh_above.update_unseen(splats, &unseen, settings);
    }

    /// Of each splat, the update counts of this step; `None`: the view has seen it, or its regularisers are not finite.
    fn grow_unseen_older(
        &mut self,
        splats: &Splats,
        settings: &StepSettings,
        now: u32,
    ) -> Vec<Option<UpdateCounts>> {
        let is_regularised = settings.weights.scale_reg > 0.0;
        let is_finite = |ix: usize| {
            let scales = splats.log_scales[ix].map(f32::exp);
            splats.opacity_logits[ix].is_finite()
                && (!is_regularised || scales.iter().all(|s| s.is_finite()))
        };
        let counts = self.update_counts.iter_mut().enumerate();
        let unseen = counts.map(|(ix, counts)| {
            if self.last_seen[ix] == now || !is_finite(ix) {
                return None;
            }
            counts.since_cleared = counts.since_cleared.saturating_add(1);
            counts.in_all = counts.in_all.saturating_add(1);
            Some(*counts)
        });
        unseen.collect()
    }
}

/// Moves one attribute, the first `n` of `stride` numbers of a splat; `gradient` is given the numbers and zeros to fill.
fn adam(
    params: &mut [f32],
    moments: &mut Moments,
    [stride, n]: [usize; 2],
    unseen: &[Option<UpdateCounts>],
    (rate, decay): (f32, f32),
    gradient: impl Fn(&[f32], &mut [f32]) + Sync,
) {
    let chunks = (
        params.par_chunks_mut(CHUNK * stride),
        moments.first.par_chunks_mut(CHUNK * n),
        moments.second.par_chunks_mut(CHUNK * n),
        unseen.par_chunks(CHUNK),
    );
    let chunks = chunks.into_par_iter();
    chunks.for_each(|(params, first, second, unseen)| {
        let rows = params
            .chunks_exact_mut(stride)
            .zip(first.chunks_exact_mut(n));
        let rows = rows.zip(second.chunks_exact_mut(n)).zip(unseen);
        for (((params, first), second), counts) in rows {
            let Some(counts) = counts else {
                continue;
            };
            let mut grads = [0.0; WIDEST];
            gradient(&params[..n], &mut grads[..n]);
            update(
                &mut params[..n],
                (first, second),
                &grads[..n],
                correction(counts.since_cleared),
                rate * counts.share_of_rate(decay),
            );
        }
    });
}
