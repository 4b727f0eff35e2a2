//! The whole optimisation of FastSplatting in f64: losses, schedules by step, the pose network, a dense Adam, noise and moves of
//! 3DGS-MCMC. Written after the paper and docs/GRADIENTS.md; shares random numbers and first values with the engines, no arithmetic.

use glam::DVec3;
use nalgebra::{DVector, Matrix3, Vector3};

use super::adam::SplatAdam;
use super::pose_network::{Network, WIDTH};
use super::project::sigmoid;
use super::{Camera, Params, Target, Weights, gradients};
use splat_engine::mcmc;
use splat_engine::settings::StepSettings;
use splat_engine::view::{Correspondence, TrainingView};
use splat_types::transform::Rigid;

/// Of a network and of Adam (Kingma 2015).
const BETAS: [f64; 2] = [0.9, 0.999];
const EPS: f64 = 1e-8;
/// Step of the central differences of the epipolar distance, radians and world units: its error is some 1e-9 of the gradient.
const STEP: f64 = 1e-6;
/// A match that is farther off has no say.
const MAX_EPIPOLAR_PX: f64 = 20.0;
const N_PARAMETERS: usize = 8905;

/// All that is optimised, and the optimisers.
#[derive(Debug, Clone)]
pub struct PaperRun {
    pub params: Params,
    adam: SplatAdam,
    views: Vec<TrainingView>,
    matches: Vec<Vec<Correspondence>>,
    /// In the flat order that backends share.
    network: Vec<f64>,
    network_adam: FlatAdam,
    embeddings: Vec<(Vec<f64>, FlatAdam)>,
    camera_scale: f64,
    n_steps: u32,
}

/// Adam of a flat array.
#[derive(Debug, Clone, Default)]
struct FlatAdam {
    m: Vec<f64>,
    v: Vec<f64>,
    n: i32,
}

impl FlatAdam {
    fn update(&mut self, values: &mut [f64], gradient: &[f64], rate: f64) {
        self.n += 1;
        self.m.resize(values.len(), 0.0);
        self.v.resize(values.len(), 0.0);
        for (ix, (value, g)) in values.iter_mut().zip(gradient).enumerate() {
            self.m[ix] = BETAS[0] * self.m[ix] + (1.0 - BETAS[0]) * g;
            self.v[ix] = BETAS[1] * self.v[ix] + (1.0 - BETAS[1]) * g * g;
            let m_hat = self.m[ix] / (1.0 - BETAS[0].powi(self.n));
            let v_hat = self.v[ix] / (1.0 - BETAS[1].powi(self.n));
            *value -= rate * m_hat / (v_hat.sqrt() + EPS);
        }
    }
}

impl PaperRun {
    /// `network`: its first parameters. Embeddings start at zero.
    pub fn new(
        params: Params,
        views: Vec<TrainingView>,
        network: &[f32],
        camera_scale: f64,
    ) -> Self {
        assert_eq!(network.len(), N_PARAMETERS);
        Self {
            adam: SplatAdam::new(&params),
            params,
            matches: vec![Vec::new(); views.len()],
            network: network.iter().copied().map(f64::from).collect(),
            network_adam: FlatAdam::default(),
            embeddings: vec![(vec![0.0; WIDTH], FlatAdam::default()); views.len()],
            views,
            camera_scale,
            n_steps: 0,
        }
    }

    pub fn set_matches(&mut self, view_ix: usize, matches: Vec<Correspondence>) {
        self.matches[view_ix] = matches;
    }

    /// Base and network together, `cam_from_world`.
    pub fn pose(&self, view_ix: usize) -> Rigid {
        let network = Network::new(&self.network, self.camera_scale);
        let embedding = DVector::from_column_slice(&self.embeddings[view_ix].0);
        let (rotation, translation) = network.motion(&embedding);
        let base = Camera::new(
            &self.views[view_ix].intrinsics,
            &self.views[view_ix].cam_from_world,
        );
        // world_from_cam = world_from_base * [rotation, translation].
        let turned = rotation.transpose() * base.rotation;
        let moved = rotation.transpose() * (base.translation - translation);
        rigid(&turned, &moved)
    }

    /// One step on one view; `settings` are those of its place in the schedule.
    pub fn step(&mut self, view_ix: usize, settings: &StepSettings) {
        self.n_steps += 1;
        let pose = self.pose(view_ix);
        let view = TrainingView {
            cam_from_world: pose,
            ..self.views[view_ix].clone()
        };
        let camera = Camera::new(&view.intrinsics, &pose);
        let weights = Weights::new(settings);
        let target = Target::new(&view);
        let result = gradients(&self.params, &camera, &target, &weights, settings.sh_degree);
        let of_matches = self.epipolar_gradient(view_ix, &pose);
        let weight = f64::from(settings.epipolar_weight);
        let pose_gradient = std::array::from_fn(|k| result.pose[k] + weight * of_matches[k]);
        self.move_poses(view_ix, pose_gradient, f64::from(settings.lr_pose_network));
        let all: Vec<usize> = (0..self.params.means.len()).collect();
        self.adam
            .update(&mut self.params, &result.splats, &all, settings);
        self.add_noise(settings);
    }

    fn move_poses(&mut self, view_ix: usize, gradient: [f64; 6], rate: f64) {
        let network = Network::new(&self.network, self.camera_scale);
        let (embedding, adam) = &mut self.embeddings[view_ix];
        let column = DVector::from_column_slice(embedding);
        let (of_network, of_embedding) = network.backward(&column, gradient);
        self.network_adam
            .update(&mut self.network, &of_network, rate);
        adam.update(embedding, &of_embedding, rate);
    }

    /// By central differences of the increment (rho, theta) on the left of the view's pose.
    fn epipolar_gradient(&self, view_ix: usize, pose: &Rigid) -> [f64; 6] {
        std::array::from_fn(|k| {
            let at = |by: f64| {
                let mut delta = [0.0; 6];
                delta[k] = by;
                let [rho, theta] = [&delta[..3], &delta[3..]].map(DVec3::from_slice);
                self.epipolar(view_ix, &(Rigid::exp(rho, theta) * *pose))
            };
            (at(STEP) - at(-STEP)) / (2.0 * STEP)
        })
    }

    /// Weighted mean of the symmetric epipolar distances of a view's matches, in px (VGGT-X, 3R-GS).
    fn epipolar(&self, view_ix: usize, pose: &Rigid) -> f64 {
        let own = Camera::new(&self.views[view_ix].intrinsics, pose);
        let (mut sum, mut weights) = (0.0, 0.0);
        for found in &self.matches[view_ix] {
            let other_ix = found.other_view_ix as usize;
            let other = Camera::new(&self.views[other_ix].intrinsics, &self.pose(other_ix));
            let rotation = other.rotation * own.rotation.transpose();
            let t = other.translation - rotation * own.translation;
            let essential = t.cross_matrix() * rotation;
            let fundamental = inverse_lens(&other).transpose() * essential * inverse_lens(&own);
            let x = pixel(found.own_px);
            let y = pixel(found.other_px);
            let (line, own_line) = (fundamental * x, fundamental.transpose() * y);
            let squares = |v: &Vector3<f64>| v.x * v.x + v.y * v.y;
            let residual = y.dot(&line);
            let distance =
                residual.abs() * (1.0 / squares(&line) + 1.0 / squares(&own_line)).sqrt();
            sum += f64::from(found.weight) * distance.min(MAX_EPIPOLAR_PX);
            weights += f64::from(found.weight);
        }
        if weights > 0.0 { sum / weights } else { 0.0 }
    }

    /// SGLD (Kheradmand et al. 2024, eq. 9) on all means.
    fn add_noise(&mut self, settings: &StepSettings) {
        for ix in 0..self.params.means.len() {
            let words = [settings.noise_seed, self.n_steps, ix as u32];
            let eta = Vector3::from(mcmc::normal3(words).map(f64::from));
            let opacity = sigmoid(self.params.opacity_logits[ix]);
            let gate = 1.0 / (1.0 + (100.0 * (opacity - 0.005)).exp());
            let offset = self.covariance(ix) * eta * f64::from(settings.noise) * gate;
            for k in 0..3 {
                self.params.means[ix][k] += offset[k];
            }
        }
    }

    fn covariance(&self, ix: usize) -> Matrix3<f64> {
        let [w, x, y, z] = self.params.quats[ix];
        let rotation =
            nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
        let scales = Vector3::from(self.params.log_scales[ix]).map(|s| (2.0 * s).exp());
        let axes = rotation.to_rotation_matrix().into_inner();
        axes * Matrix3::from_diagonal(&scales) * axes.transpose()
    }

    /// Relocation of the dead, then growth to `n_after` splats, as in the paper of 3DGS-MCMC.
    pub fn relocate(&mut self, min_opacity: f64, n_after: usize, seed: u32) {
        let n = self.params.means.len();
        let is_dead =
            |params: &Params, ix: usize| sigmoid(params.opacity_logits[ix]) <= min_opacity;
        let dead: Vec<usize> = (0..n).filter(|&ix| is_dead(&self.params, ix)).collect();
        self.fill(&dead, min_opacity, [seed, mcmc::RELOCATION]);
        let added: Vec<usize> = (n..n_after).collect();
        self.fill(&added, min_opacity, [seed, mcmc::GROWTH]);
    }

    fn fill(&mut self, places: &[usize], min_opacity: f64, [seed, kind]: [u32; 2]) {
        let n = self.params.means.len();
        let opacities: Vec<f64> = self
            .params
            .opacity_logits
            .iter()
            .map(|&l| sigmoid(l))
            .collect();
        let unit = f64::from(1_u32 << mcmc::weight_bits(n));
        let weight = |ix: usize| {
            if opacities[ix] > min_opacity {
                (opacities[ix] * unit) as u64
            } else {
                0
            }
        };
        let total: u64 = (0..n).map(weight).sum();
        let sources: Vec<usize> = (0..places.len())
            .map(|k| {
                let [word, ..] = mcmc::hash([seed, k as u32, kind]);
                let target = (u64::from(word) * total) >> 32;
                let mut before = 0;
                (0..n)
                    .find(|&ix| {
                        before += weight(ix);
                        target < before
                    })
                    .expect("one is alive")
            })
            .collect();
        for source in 0..n {
            let n_shares = 1 + sources.iter().filter(|&&s| s == source).count();
            if n_shares > 1 {
                self.share(source, n_shares as u32, min_opacity);
            }
        }
        for (&source, &place) in sources.iter().zip(places) {
            self.copy(source, place);
        }
    }

    /// The double sum of the paper.
    fn share(&mut self, ix: usize, n: u32, min_opacity: f64) {
        let opacity = sigmoid(self.params.opacity_logits[ix]);
        let shared = (1.0 - (1.0 - opacity).powf(1.0 / f64::from(n))).max(min_opacity);
        let mut sum = 0.0;
        for i in 1..=n {
            let mut binomial = 1.0;
            for k in 0..i {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                sum += binomial * sign * shared.powi(k as i32 + 1) / f64::from(k + 1).sqrt();
                binomial *= f64::from(i - 1 - k) / f64::from(k + 1);
            }
        }
        self.params.opacity_logits[ix] = (shared / (1.0 - shared)).ln();
        self.params.log_scales[ix]
            .iter_mut()
            .for_each(|s| *s += (opacity / sum).ln());
        self.adam.clear(ix);
    }

    /// Every attribute; its moments are zero, its count of steps that of all.
    fn copy(&mut self, source: usize, place: usize) {
        let stride = self.params.sh_stride();
        if place == self.params.means.len() {
            self.params.push_zeros();
            self.adam.push();
        }
        let p = &mut self.params;
        p.means[place] = p.means[source];
        p.log_scales[place] = p.log_scales[source];
        p.quats[place] = p.quats[source];
        p.opacity_logits[place] = p.opacity_logits[source];
        p.sh.copy_within(source * stride..(source + 1) * stride, place * stride);
        self.adam.n_updates[place] = self.adam.n_updates[source];
        self.adam.clear(place);
    }
}

fn pixel([x, y]: [f32; 2]) -> Vector3<f64> {
    Vector3::new(f64::from(x), f64::from(y), 1.0)
}

fn inverse_lens(camera: &Camera) -> Matrix3<f64> {
    let lens = &camera.intrinsics;
    let matrix = Matrix3::new(lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0);
    matrix.try_inverse().expect("focal lengths are not 0")
}

fn rigid(rotation: &Matrix3<f64>, translation: &Vector3<f64>) -> Rigid {
    let columns: [f64; 9] = std::array::from_fn(|k| rotation.as_slice()[k]);
    let rotation = glam::DQuat::from_mat3(&glam::DMat3::from_cols_array(&columns));
    Rigid::new(
        rotation.normalize(),
        DVec3::from_array((*translation).into()),
    )
}
