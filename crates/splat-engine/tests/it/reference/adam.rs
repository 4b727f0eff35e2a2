//! Gradients -> parameters: Adam for the splats that were seen, and for the pose. docs/GRADIENTS.md 9.

use std::ops::Range;

use glam::DVec3;

use super::Params;
use splat_engine::settings::StepSettings;
use splat_types::transform::Rigid;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const SPLAT_EPS: f64 = 1e-15;
/// What a decay leaves of a rate at least.
const MIN_RATE_SHARE: f64 = 0.01;
const POSE_EPS: f64 = 1e-8;

/// First and second moments, and how often each splat was updated. Above SH band 0, `m` is rounded to bf16, and the
/// numbers of a splat's band share one second moment, which stands in the first of them.
#[derive(Debug, Clone)]
pub struct SplatAdam {
    pub m: Params,
    pub v: Params,
    pub n_updates: Vec<u32>,
}

#[derive(Debug, Clone, Copy, Default)]
pub struct PoseAdam {
    pub m: [f64; 6],
    pub v: [f64; 6],
    pub n_updates: u32,
}

impl SplatAdam {
    pub fn new(params: &Params) -> Self {
        let zeros = Params::zeros_like(params);
        Self {
            m: zeros.clone(),
            v: zeros,
            n_updates: vec![0; params.means.len()],
        }
    }

    /// Moments of one splat to 0; its count of updates stays.
    pub fn clear(&mut self, ix: usize) {
        for moments in [&mut self.m, &mut self.v] {
            let stride = moments.sh_stride();
            moments.means[ix] = [0.0; 3];
            moments.log_scales[ix] = [0.0; 3];
            moments.quats[ix] = [0.0; 4];
            moments.opacity_logits[ix] = 0.0;
            moments.sh[ix * stride..(ix + 1) * stride].fill(0.0);
        }
    }

    /// Room for one more splat.
    pub fn push(&mut self) {
        self.m.push_zeros();
        self.v.push_zeros();
        self.n_updates.push(0);
    }

    /// Splats that were not seen keep value, moments and age; so do coefficients above the active degree.
    pub fn update(
        &mut self,
        params: &mut Params,
        gradient: &Params,
        visible: &[usize],
        settings: &StepSettings,
    ) {
        let stride = params.sh_stride();
        for &ix in visible {
            self.n_updates[ix] += 1;
            let t = self.n_updates[ix];
            let settled = (1.0 / (1.0 + f64::from(settings.lr_mean_decay) * f64::from(t)))
                .max(MIN_RATE_SHARE);
            for k in 0..3 {
                let (m, v) = (&mut self.m.means[ix][k], &mut self.v.means[ix][k]);
                params.means[ix][k] -= step(m, v, gradient.means[ix][k], t, SPLAT_EPS)
                    * f64::from(settings.lr_mean)
                    * settled;
                let (m, v) = (&mut self.m.log_scales[ix][k], &mut self.v.log_scales[ix][k]);
                let g = gradient.log_scales[ix][k];
                params.log_scales[ix][k] -=
                    step(m, v, g, t, SPLAT_EPS) * f64::from(settings.lr_scale);
            }
            for k in 0..4 {
                let (m, v) = (&mut self.m.quats[ix][k], &mut self.v.quats[ix][k]);
                params.quats[ix][k] -=
                    step(m, v, gradient.quats[ix][k], t, SPLAT_EPS) * f64::from(settings.lr_quat);
            }
            let (m, v) = (
                &mut self.m.opacity_logits[ix],
                &mut self.v.opacity_logits[ix],
            );
            let g = gradient.opacity_logits[ix];
            params.opacity_logits[ix] -=
                step(m, v, g, t, SPLAT_EPS) * f64::from(settings.lr_opacity);
            for k in 0..3 {
                let at = ix * stride + k;
                let (m, v) = (&mut self.m.sh[at], &mut self.v.sh[at]);
                params.sh[at] -=
                    step(m, v, gradient.sh[at], t, SPLAT_EPS) * f64::from(settings.lr_sh0);
            }
            for band in 1..=usize::from(settings.sh_degree.min(params.sh_degree)) {
                let start = (band as u32 * settings.sh_interval).max(1);
                if t < start {
                    break;
                }
                let first = ix * stride + 3 * band * band;
                let numbers = first..first + 3 * (2 * band + 1);
                self.update_band(params, gradient, numbers, t - start + 1, settings);
            }
        }
    }

    fn update_band(
        &mut self,
        params: &mut Params,
        gradient: &Params,
        numbers: Range<usize>,
        n_updates: u32,
        settings: &StepSettings,
    ) {
        let squares = gradient.sh[numbers.clone()].iter().map(|g| g * g);
        let v = &mut self.v.sh[numbers.start];
        *v = BETA2 * *v + (1.0 - BETA2) * squares.sum::<f64>() / numbers.len() as f64;
        let t = f64::from(n_updates);
        let v_hat = *v / (1.0 - BETA2.powf(t));
        for at in numbers {
            let m = BETA1 * self.m.sh[at] + (1.0 - BETA1) * gradient.sh[at];
            self.m.sh[at] = to_bf16(m);
            let m_hat = m / (1.0 - BETA1.powf(t));
            params.sh[at] -= f64::from(settings.lr_sh_rest) * m_hat / (v_hat.sqrt() + SPLAT_EPS);
        }
    }
}

/// The nearest number of 8 significant bits, ties to even; none of them is near the ends of f32.
fn to_bf16(value: f64) -> f64 {
    if value == 0.0 {
        return 0.0;
    }
    let unit = (value.abs().log2().floor() - 7.0).exp2();
    (value / unit).round_ties_even() * unit
}

/// Adam of one view's exposure.
#[derive(Debug, Clone, Copy, Default)]
pub struct ExposureAdam {
    m: [[f64; 3]; 2],
    v: [[f64; 3]; 2],
    n_updates: u32,
}

impl ExposureAdam {
    /// Decays towards 0 at a tenth of the rate and stays within [3, 1].
    pub fn update(&mut self, exposure: &mut [[f64; 3]; 2], gradient: [[f64; 3]; 2], lr: f32) {
        self.n_updates += 1;
        for kind in 0..2 {
            for channel in 0..3 {
                let (m, v) = (&mut self.m[kind][channel], &mut self.v[kind][channel]);
                let g = gradient[kind][channel];
                let direction = step(m, v, g, self.n_updates, POSE_EPS);
                let value = &mut exposure[kind][channel];
                let moved = *value - f64::from(lr) * (direction + 0.1 * *value);
                let limit = [3.0, 1.0][kind];
                *value = moved.clamp(-limit, limit);
            }
        }
    }
}

impl PoseAdam {
    /// The increment multiplies from the left and is then forgotten; the moments stay.
    pub fn update(
        &mut self,
        cam_from_world: Rigid,
        gradient: [f64; 6],
        settings: &StepSettings,
    ) -> Rigid {
        self.n_updates += 1;
        let mut delta = [0.0; 6];
        for k in 0..6 {
            let lr = if k < 3 {
                settings.lr_pose_translation
            } else {
                settings.lr_pose_rotation
            };
            let direction = step(
                &mut self.m[k],
                &mut self.v[k],
                gradient[k],
                self.n_updates,
                POSE_EPS,
            );
            delta[k] = -direction * f64::from(lr);
        }
        let [rx, ry, rz, tx, ty, tz] = delta;
        (Rigid::exp(DVec3::new(rx, ry, rz), DVec3::new(tx, ty, tz)) * cam_from_world).renormalized()
    }
}

/// Kingma 2015, algorithm 1: the step for a learning rate of 1.
fn step(m: &mut f64, v: &mut f64, gradient: f64, n_updates: u32, eps: f64) -> f64 {
    *m = BETA1 * *m + (1.0 - BETA1) * gradient;
    *v = BETA2 * *v + (1.0 - BETA2) * gradient * gradient;
    let t = f64::from(n_updates);
    let m_hat = *m / (1.0 - BETA1.powf(t));
    let v_hat = *v / (1.0 - BETA2.powf(t));
    m_hat / (v_hat.sqrt() + eps)
}
