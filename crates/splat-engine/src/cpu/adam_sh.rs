//! adam_sh: gradients of the SH bands above 0 -> their update, with little memory.
//!
//! Part of `adam`. First moments are bf16; a band of a splat has one second moment, the mean over its numbers: their
//! gradients are one colour gradient times the basis, so they are of one size. Equations: docs/GRADIENTS.md, adam.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::cpu::moments::{BETA_1, BETA_2, EPS, UpdateCounts, correction};
use crate::cpu::project::{CHUNK, Projected};
use crate::cpu::project_backward::SplatGradients;
use crate::settings::StepSettings;
use splat_types::splats::rows::{make_room, retain_rows};
use splat_types::splats::splats::Splats;

/// Numbers of band 0, which is trained like any other attribute.
pub(crate) const BAND_0: usize = 3;

/// Adam's state of the bands above 0.
#[derive(Debug, Default)]
pub(crate) struct ShMoments {
    /// bf16, all numbers of a splat but those of band 0.
    first: Vec<u16>,
    /// One per splat and band.
    second: Vec<f32>,
}

impl ShMoments {
    pub(crate) fn resize(&mut self, n: usize, sh_stride: usize) {
        let (n_first, n_second) = (n * (sh_stride - BAND_0), n * n_bands(sh_stride));
        let more = n_first.saturating_sub(self.first.len());
        make_room(&mut self.first, more);
        let more = n_second.saturating_sub(self.second.len());
        make_room(&mut self.second, more);
        self.first.resize(n_first, 0);
        self.second.resize(n_second, 0.0);
    }

    pub(crate) fn bytes_per_splat(sh_degree: u8) -> usize {
        let sh_stride = 3 * (usize::from(sh_degree) + 1).pow(2);
        2 * (sh_stride - BAND_0) + 4 * n_bands(sh_stride)
    }

    /// Room for more rows included.
    pub(crate) fn held_bytes(&self) -> usize {
        2 * self.first.capacity() + 4 * self.second.capacity()
    }

    pub(crate) fn retain(&mut self, sh_stride: usize, keep: &[bool]) {
        retain_rows(&mut self.first, sh_stride - BAND_0, keep);
        retain_rows(&mut self.second, n_bands(sh_stride), keep);
    }

    pub(crate) fn clear(&mut self, sh_stride: usize, ix: usize) {
        let n_first = sh_stride - BAND_0;
        self.first[ix * n_first..(ix + 1) * n_first].fill(0);
        let n_second = n_bands(sh_stride);
        self.second[ix * n_second..(ix + 1) * n_second].fill(0.0);
    }

    #[cfg(test)]
    pub(crate) fn n_bytes(&self) -> usize {
        size_of_val(&self.first[..]) + size_of_val(&self.second[..])
    }

    /// `updated[v]` is what `UpdateCounts` say of a visible splat; `None`: it is left alone.
    pub(crate) fn update(
        &mut self,
        splats: &mut Splats,
        projected: &Projected,
        gradients: &SplatGradients,
        updated: &[Option<UpdateCounts>],
        settings: &StepSettings,
    ) {
        let (stride, grad_stride) = (splats.sh_stride(), gradients.sh_stride);
        let (n_active, n_first, n_second) =
            (n_bands(grad_stride), stride - BAND_0, n_bands(stride));
        if n_active == 0 {
            return;
        }
        let chunks = (
            splats.sh.par_chunks_mut(CHUNK * stride),
            self.first.par_chunks_mut(CHUNK * n_first),
            self.second.par_chunks_mut(CHUNK * n_second),
        );
        let chunks = chunks.into_par_iter().enumerate();
        chunks.for_each(|(c, (params, first, second))| {
            for v in projected.of_chunk(c) {
                let Some(update_counts) = updated[v] else {
                    continue;
                };
                let place = projected.splats[v].splat_ix as usize - c * CHUNK;
                let grads = &gradients.sh[v * grad_stride..(v + 1) * grad_stride];
                let at = place * stride + BAND_0;
                let row = Row {
                    params: &mut params[at..at + n_first],
                    first: &mut first[place * n_first..(place + 1) * n_first],
                    second: &mut second[place * n_second..place * n_second + n_active],
                    grads: &grads[BAND_0..],
                };
                update(
                    row,
                    update_counts,
                    settings.sh_interval,
                    settings.lr_sh_rest,
                );
            }
        });
    }
}

impl ShMoments {
    /// Of splats that a view does not show, one entry each, by momentum alone; `None`: left alone.
    pub(crate) fn update_unseen(
        &mut self,
        splats: &mut Splats,
        unseen: &[Option<UpdateCounts>],
        settings: &StepSettings,
    ) {
        let stride = splats.sh_stride();
        let (n_first, n_second) = (stride - BAND_0, n_bands(stride));
        let n_active = usize::from(settings.sh_degree.min(splats.sh_degree));
        if n_active == 0 {
            return;
        }
        let zeros = vec![0.0; n_first];
        let rows = (
            splats.sh.par_chunks_exact_mut(stride),
            self.first.par_chunks_exact_mut(n_first),
            self.second.par_chunks_exact_mut(n_second),
            unseen.par_iter(),
        );
        let rows = rows.into_par_iter().with_min_len(CHUNK);
        rows.for_each(|(params, first, second, update_counts)| {
            let Some(update_counts) = *update_counts else {
                return;
            };
            let row = Row {
                params: &mut params[BAND_0..],
                first,
                second: &mut second[..n_active],
                grads: &zeros,
            };
            update(
                row,
                update_counts,
                settings.sh_interval,
                settings.lr_sh_rest,
            );
        });
    }
}

/// One splat's bands above 0.
struct Row<'a> {
    params: &'a mut [f32],
    first: &'a mut [u16],
    /// Of the active bands.
    second: &'a mut [f32],
    grads: &'a [f32],
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn update(row: Row<'_>, update_counts: UpdateCounts, interval: u32, rate: f32) {
    let mut start = 0;
    for (ix, second) in row.second.iter_mut().enumerate() {
        let Some(age) = update_counts.of_band(ix as u32 + 1, interval) else {
            break;
        };
        let n = BAND_0 * (2 * ix + 3);
        let params = &mut row.params[start..start + n];
        let first = &mut row.first[start..start + n];
        let grads = &row.grads[start..start + n];
        start += n;
        let [unbias_first, unbias_second] = correction(age);
        let v = BETA_2 * *second + (1.0 - BETA_2) * mean_square(grads);
        *second = v;
        let rate = rate * unbias_first / (v.sqrt() * unbias_second + EPS);
        for i in 0..n {
            let m = BETA_1 * widen(first[i]) + (1.0 - BETA_1) * grads[i];
            first[i] = narrow(m);
            params[i] -= rate * m;
        }
    }
}

/// By lanes: one running sum would wait for each addition.
#[inline(always)]
fn mean_square(numbers: &[f32]) -> f32 {
    let (vectors, rest) = numbers.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for vector in vectors {
        for (sum, x) in sums.iter_mut().zip(vector) {
            *sum += x * x;
        }
    }
    let rest = rest.iter().map(|x| x * x);
    (sums.iter().sum::<f32>() + rest.sum::<f32>()) / numbers.len() as f32
}

/// Bands above 0 of so many numbers.
fn n_bands(sh_stride: usize) -> usize {
    (sh_stride / BAND_0).isqrt() - 1
}

#[inline(always)]
fn widen(bf16: u16) -> f32 {
    f32::from_bits(u32::from(bf16) << 16)
}

/// To the nearest bf16, ties to even; what would round to infinity stays the largest number.
#[inline(always)]
fn narrow(value: f32) -> u16 {
    const LARGEST: u32 = 0x7f7f;
    let bits = value.to_bits();
    let rounded = (bits + 0x7fff + ((bits >> 16) & 1)) >> 16;
    let (sign, size) = (rounded & 0x8000, rounded & 0x7fff);
    (sign | size.min(LARGEST)) as u16
}

#[cfg(test)]
mod tests {
    use super::{narrow, widen};

    #[test]
    fn bf16_is_the_nearest_one_with_ties_to_even() {
        for (value, expected) in [
            (0.0, 0.0),
            (1.0, 1.0),
            (-3.5, -3.5),
            // Halfway between 1 and 1 + 2^-7, then between that and 1 + 2^-6.
            (1.0 + 1.0 / 256.0, 1.0),
            (1.0 + 3.0 / 256.0, 1.0 + 4.0 / 256.0),
            (1.0 + 1.1 / 256.0, 1.0 + 2.0 / 256.0),
            (-1.0 - 0.9 / 256.0, -1.0),
        ] {
            assert_eq!(widen(narrow(value)), expected, "{value}");
        }
        assert!(widen(narrow(f32::MAX)).is_finite());
        assert!(widen(narrow(-f32::MAX)) < -3.3e38);
    }
}
