//! adam: gradients of the visible splats -> their update.
//!
//! Last stage. Selective: a splat that the view does not see keeps its parameters and moments, and bias correction
//! follows each splat's own age (Kingma & Ba 2015; Mallick et al. 2024 for the selection).

use multiversion::multiversion;
use rayon::prelude::*;

use super::project::{CHUNK, Projected};
use super::project_backward::SplatGradients;
use crate::splat::{Splats, StepSettings};

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPS: f32 = 1e-15;

/// Adam's state of all splats, in the layout of `Splats`.
#[derive(Debug, Default)]
pub struct Optimiser {
    means: Moments,
    log_scales: Moments,
    quats: Moments,
    opacity_logits: Moments,
    sh: Moments,
    /// Updates that each splat has had.
    ages: Vec<u32>,
    corrections: Vec<Correction>,
}

/// First and second moment of one attribute, laid out as its parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    pub first: Vec<f32>,
    pub second: Vec<f32>,
}

/// One attribute of all splats, `stride` numbers each.
#[derive(Debug)]
pub struct Attribute<'a> {
    pub params: &'a mut [f32],
    pub moments: &'a mut Moments,
    pub stride: usize,
    /// `grad_stride` numbers per visible splat; only so many of the parameters move.
    pub grads: &'a [f32],
    pub grad_stride: usize,
    /// Rate of a splat's first three numbers, and of the rest.
    pub rates: [f32; 2],
}

/// What bias correction makes of the moments: `1 / (1 - beta_1^t)` and `1 / sqrt(1 - beta_2^t)`; `None`: no update.
pub type Correction = Option<[f32; 2]>;

impl Optimiser {
    /// Splats behind those that were there start at rest.
    pub(crate) fn resize(&mut self, splats: &Splats) {
        let n = splats.len();
        self.ages.resize(n, 0);
        for (moments, stride) in self.moments_mut(splats.sh_stride()) {
            moments.first.resize(n * stride, 0.0);
            moments.second.resize(n * stride, 0.0);
        }
    }

    pub(crate) fn retain(&mut self, sh_stride: usize, keep: &[bool]) {
        retain_rows(&mut self.ages, 1, keep);
        for (moments, stride) in self.moments_mut(sh_stride) {
            retain_rows(&mut moments.first, stride, keep);
            retain_rows(&mut moments.second, stride, keep);
        }
    }

    /// Moves the visible splats. Returns how many were left alone because their gradient is not finite.
    pub(crate) fn update(
        &mut self,
        splats: &mut Splats,
        projected: &Projected,
        gradients: &SplatGradients,
        settings: &StepSettings,
    ) -> usize {
        let g = gradients;
        let n_skipped = age(
            projected,
            &g.is_finite,
            &mut self.ages,
            &mut self.corrections,
        );
        let sh_stride = splats.sh_stride();
        let corrections = &self.corrections;
        let run = |params, moments, grads, [stride, grad_stride]: [usize; 2], rates| {
            let attribute = Attribute {
                params,
                moments,
                stride,
                grads,
                grad_stride,
                rates,
            };
            adam(attribute, projected, corrections);
        };
        let means = splats.means.as_flattened_mut();
        run(
            means,
            &mut self.means,
            g.means.as_flattened(),
            [3; 2],
            [settings.lr_mean; 2],
        );
        let scales = splats.log_scales.as_flattened_mut();
        let scale_rates = [settings.lr_scale; 2];
        run(
            scales,
            &mut self.log_scales,
            g.log_scales.as_flattened(),
            [3; 2],
            scale_rates,
        );
        let quats = splats.quats.as_flattened_mut();
        run(
            quats,
            &mut self.quats,
            g.quats.as_flattened(),
            [4; 2],
            [settings.lr_quat; 2],
        );
        let logits = &mut splats.opacity_logits;
        run(
            logits,
            &mut self.opacity_logits,
            &g.opacity_logits,
            [1; 2],
            [settings.lr_opacity; 2],
        );
        let sh_rates = [settings.lr_sh0, settings.lr_sh_rest];
        run(
            &mut splats.sh,
            &mut self.sh,
            &g.sh,
            [sh_stride, g.sh_stride],
            sh_rates,
        );
        n_skipped
    }

    /// With the numbers of one splat, since moments are flat.
    fn moments_mut(&mut self, sh_stride: usize) -> [(&mut Moments, usize); 5] {
        [
            (&mut self.means, 3),
            (&mut self.log_scales, 3),
            (&mut self.quats, 4),
            (&mut self.opacity_logits, 1),
            (&mut self.sh, sh_stride),
        ]
    }
}

/// Ages every visible splat that has a finite gradient by one step. Returns how many had none.
pub fn age(
    projected: &Projected,
    is_finite: &[bool],
    ages: &mut [u32],
    out: &mut Vec<Correction>,
) -> usize {
    out.clear();
    let mut n_skipped = 0;
    for (splat, &is_finite) in projected.splats.iter().zip(is_finite) {
        if !is_finite {
            n_skipped += 1;
            out.push(None);
            continue;
        }
        let age = &mut ages[splat.splat_ix as usize];
        *age = age.saturating_add(1);
        let t = f64::from(*age);
        let correction = [
            1.0 / (1.0 - f64::from(BETA_1).powf(t)),
            1.0 / (1.0 - f64::from(BETA_2).powf(t)).sqrt(),
        ];
        out.push(Some(correction.map(|c| c as f32)));
    }
    n_skipped
}

/// Moves one attribute of the visible splats.
pub fn adam(attribute: Attribute<'_>, projected: &Projected, corrections: &[Correction]) {
    let Attribute {
        params,
        moments,
        stride,
        grads,
        grad_stride,
        rates,
    } = attribute;
    let chunk = CHUNK * stride;
    let chunks = (
        params.par_chunks_mut(chunk),
        moments.first.par_chunks_mut(chunk),
        moments.second.par_chunks_mut(chunk),
        projected.chunk_ends.par_iter(),
    );
    chunks
        .into_par_iter()
        .enumerate()
        .for_each(|(c, (params, first, second, &end))| {
            let begin = c
                .checked_sub(1)
                .map_or(0, |before| projected.chunk_ends[before]);
            for v in begin as usize..end as usize {
                let Some(correction) = corrections[v] else {
                    continue;
                };
                let place = projected.splats[v].splat_ix as usize - c * CHUNK;
                let range = place * stride..place * stride + grad_stride;
                let grads = &grads[v * grad_stride..(v + 1) * grad_stride];
                let state = (&mut first[range.clone()], &mut second[range.clone()]);
                update(&mut params[range], state, grads, correction, rates);
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
    correction: [f32; 2],
    rates: [f32; 2],
) {
    let n = grads.len();
    let (params, first, second) = (&mut params[..n], &mut first[..n], &mut second[..n]);
    let [unbias_first, unbias_second] = correction;
    for i in 0..n {
        let g = grads[i];
        let m = BETA_1 * first[i] + (1.0 - BETA_1) * g;
        let v = BETA_2 * second[i] + (1.0 - BETA_2) * g * g;
        first[i] = m;
        second[i] = v;
        let rate = if i < 3 { rates[0] } else { rates[1] };
        params[i] -= rate * (m * unbias_first) / (v.sqrt() * unbias_second + EPS);
    }
}

/// Keeps row i of `stride` values when `keep[i]`.
pub(crate) fn retain_rows<T: Copy>(values: &mut Vec<T>, stride: usize, keep: &[bool]) {
    let mut end = 0;
    for (i, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        values.copy_within(i * stride..(i + 1) * stride, end);
        end += stride;
    }
    values.truncate(end);
}
