//! The appearance network: its gradient against central differences of a plain f64 forward pass, and steps on every backend against that pass
//! and its chain rule.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::backends::{BACKENDS, ORDINARY};
use crate::reference::adam::ExposureAdam;
use crate::reference::random;
use splat_engine::appearance::{
    AppearanceEmbedding, AppearanceMlp, AppearanceNetwork, first_appearance,
};
use splat_engine::cpu::engine;
use splat_engine::mlp::Moments;
use splat_engine::settings::{PoseMode, StepSettings};
use splat_engine::view::TrainingView;
use splat_types::transform::Rigid;

const SIZES: [(usize, usize); 3] = [(64, 16), (64, 64), (6, 64)];
const STEP: f64 = 1e-6;

/// The layers apart, as one reads the flat order: w1, b1, w2, b2, w3, b3.
struct Plain {
    layers: Vec<(DMatrix<f64>, DVector<f64>)>,
}

/// Sums before each ReLU, and the cut answers.
struct Answers {
    sums: [DVector<f64>; 3],
    exposure: [f64; 6],
}

impl Plain {
    fn new(flat: &[f64]) -> Self {
        let mut rest = flat;
        let layers = SIZES.map(|(rows, columns)| {
            let (weights, tail) = rest.split_at(rows * columns);
            let (biases, tail) = tail.split_at(rows);
            rest = tail;
            (
                DMatrix::from_row_slice(rows, columns, weights),
                DVector::from_column_slice(biases),
            )
        });
        assert!(rest.is_empty(), "5638 numbers in all");
        Self {
            layers: layers.to_vec(),
        }
    }

    fn answers(&self, embedding: &[f64]) -> Answers {
        let [(w1, b1), (w2, b2), (w3, b3)] = &self.layers[..] else {
            panic!("three layers");
        };
        let relu = |v: &DVector<f64>| v.map(|x| x.max(0.0));
        let first = w1 * DVector::from_column_slice(embedding) + b1;
        let second = w2 * relu(&first) + b2;
        let out = w3 * relu(&second) + b3;
        let exposure = std::array::from_fn(|i| {
            let bound = if i < 3 { 3.0 } else { 1.0 };
            out[i].clamp(-bound, bound)
        });
        Answers {
            sums: [first, second, out],
            exposure,
        }
    }

    /// Gradient of all parameters in the flat order, then of the embedding.
    fn gradient(&self, embedding: &[f64], g: [f64; 6]) -> (Vec<f64>, Vec<f64>) {
        let Answers { sums, .. } = self.answers(embedding);
        let [first, second, out] = &sums;
        let relu = |v: &DVector<f64>| v.map(|x| x.max(0.0));
        let gate =
            |g: DVector<f64>, v: &DVector<f64>| g.zip_map(v, |g, v| if v > 0.0 { g } else { 0.0 });
        let g3 = DVector::from_fn(6, |i, _| {
            let bound = if i < 3 { 3.0 } else { 1.0 };
            if out[i].abs() > bound { 0.0 } else { g[i] }
        });
        let g2 = gate(self.layers[2].0.transpose() * &g3, second);
        let g1 = gate(self.layers[1].0.transpose() * &g2, first);
        let g0 = self.layers[0].0.transpose() * &g1;
        let mut flat = Vec::new();
        let inputs = [
            DVector::from_column_slice(embedding),
            relu(first),
            relu(second),
        ];
        for (g, input) in [&g1, &g2, &g3].into_iter().zip(&inputs) {
            flat.extend((input * g.transpose()).iter());
            flat.extend(g.iter());
        }
        (flat, g0.as_slice().to_vec())
    }
}

/// Adam with weight decay in the gradient.
#[derive(Default)]
struct PlainAdam {
    m: Vec<f64>,
    v: Vec<f64>,
    n: i32,
}

impl PlainAdam {
    fn update(&mut self, values: &mut [f64], gradient: &[f64], rate: f64) {
        self.n += 1;
        self.m.resize(values.len(), 0.0);
        self.v.resize(values.len(), 0.0);
        for (at, (value, g)) in values.iter_mut().zip(gradient).enumerate() {
            let g = g + 1e-6 * *value;
            self.m[at] = 0.9 * self.m[at] + 0.1 * g;
            self.v[at] = 0.999 * self.v[at] + 0.001 * g * g;
            let m_hat = self.m[at] / (1.0 - 0.9_f64.powi(self.n));
            let v_hat = self.v[at] / (1.0 - 0.999_f64.powi(self.n));
            *value -= rate * m_hat / (v_hat.sqrt() + 1e-8);
        }
    }
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

/// Its last layer is not zero. With `reach` 6 some answers are cut.
fn random_network(seed: u64, reach: f32) -> (AppearanceNetwork, AppearanceEmbedding) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut network = AppearanceNetwork::default();
    for value in &mut network.mlp.parameters[AppearanceMlp::W3.start..] {
        *value = rng.random_range(-reach..reach);
    }
    let embedding = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
    (network, embedding)
}

#[test]
fn the_networks_gradient_agrees_with_differences() {
    for (seed, reach, n_cut) in [(1, 0.2, 0), (2, 6.0, 1)] {
        let (network, embedding) = random_network(seed, reach);
        let g: [[f64; 3]; 2] = [[0.3, -0.7, 1.1], [0.9, -0.4, 0.6]];
        let layers = network.mlp.forward(&embedding);
        let found = network.backward(&layers, g);
        let (flat, place) = (wide(&network.mlp.parameters), wide(&embedding));
        let loss = |flat: &[f64], place: &[f64]| {
            let answers = Plain::new(flat).answers(place);
            let on: Vec<bool> = answers.sums[..2]
                .iter()
                .flat_map(|v| v.iter().map(|x| *x > 0.0).collect::<Vec<_>>())
                .collect();
            let products = answers.exposure.iter().zip(g.as_flattened());
            (products.map(|(a, g)| a * g).sum::<f64>(), on)
        };
        let cut = layers.output.iter().zip(0..);
        let cut = cut.filter(|(v, i)| v.abs() > if *i < 3 { 3.0 } else { 1.0 });
        assert!(cut.count() >= n_cut, "{:?}", layers.output);
        let largest = found.parameters.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        let mut n_checked = 0;
        for k in (0..flat.len()).step_by(3).chain(flat.len() - 6..flat.len()) {
            let at = |by: f64| {
                let mut flat = flat.clone();
                flat[k] += by;
                loss(&flat, &place)
            };
            let (high, low) = (at(STEP), at(-STEP));
            if high.1 == low.1 {
                let wanted = (high.0 - low.0) / (2.0 * STEP);
                let error = (found.parameters[k] - wanted).abs();
                assert!(error < 1e-7 * largest.max(1.0), "parameter {k}: {error:e}");
                n_checked += 1;
            }
        }
        assert!(n_checked > 1_800, "{n_checked}");
        for k in 0..place.len() {
            let at = |by: f64| {
                let mut place = place.clone();
                place[k] += by;
                loss(&flat, &place)
            };
            let (high, low) = (at(STEP), at(-STEP));
            let wanted = (high.0 - low.0) / (2.0 * STEP);
            let error = (found.input[k] - wanted).abs();
            assert!(high.1 != low.1 || error < 1e-6, "embedding {k}: {error:e}");
        }
    }
}

#[test]
fn a_gradient_that_is_not_finite_changes_nothing() {
    let (mut network, mut embedding) = random_network(3, 0.1);
    let before = (network.clone(), embedding);
    let mut moments = Moments::default();
    let bad = [[0.1, f64::NAN, 0.0], [0.0; 3]];
    assert!(!network.update(&mut embedding, &mut moments, bad, 1e-2));
    assert_eq!((network, embedding), before);
}

/// What one view is by the plain pass.
struct PlainView {
    embedding: Vec<f64>,
    adam: PlainAdam,
    own: [[f64; 3]; 2],
    own_adam: ExposureAdam,
}

/// Own exposures move too: the engine adds both, and both answer to the gradient of the sum.
#[test]
fn steps_on_every_backend_follow_the_plain_pass() {
    for backend in &BACKENDS {
        let scene = random::scene(84, &ORDINARY);
        let settings = StepSettings {
            train_splats: false,
            pose: PoseMode::Held,
            lr_exposure: 5e-3,
            lr_appearance: 4e-3,
            ..random::settings()
        };
        let mut engine = (backend.engine)();
        engine.append(&scene.splats).unwrap();
        let aside = Rigid::exp(
            glam::DVec3::new(0.1, 0.0, 0.0),
            glam::DVec3::new(0.0, 0.05, 0.0),
        );
        let views = [Rigid::IDENTITY, aside].map(|motion| TrainingView {
            cam_from_world: motion * scene.view.cam_from_world,
            ..scene.view.clone()
        });
        for view in &views {
            engine.add_view(view.clone()).unwrap();
        }
        let mut flat = wide(&AppearanceNetwork::default().mlp.parameters);
        let mut adam = PlainAdam::default();
        let mut plain: Vec<PlainView> = (0..views.len())
            .map(|ix| PlainView {
                embedding: wide(&first_appearance(ix)),
                adam: PlainAdam::default(),
                own: [[0.0; 3]; 2],
                own_adam: ExposureAdam::default(),
            })
            .collect();
        let exposure_of = |flat: &[f64], view: &PlainView| -> [[f64; 3]; 2] {
            let shared = Plain::new(flat).answers(&view.embedding).exposure;
            std::array::from_fn(|k| std::array::from_fn(|i| shared[3 * k + i] + view.own[k][i]))
        };
        for n in 0..20 {
            let ix = n % 2;
            let seen = exposure_of(&flat, &plain[ix]).map(|kind| kind.map(|v| v as f32));
            let g = engine::gradients_exposed(&scene.splats, &views[ix], seen, &settings).exposure;
            engine.step(ix, &settings).unwrap();
            let view = &mut plain[ix];
            let flat_g: [f64; 6] = std::array::from_fn(|i| g[i / 3][i % 3]);
            let (of_network, of_embedding) = Plain::new(&flat).gradient(&view.embedding, flat_g);
            adam.update(&mut flat, &of_network, 4e-3);
            view.adam.update(&mut view.embedding, &of_embedding, 4e-2);
            view.own_adam.update(&mut view.own, g, settings.lr_exposure);
            for (view, found) in plain.iter().zip(engine.exposures().unwrap()) {
                let wanted = exposure_of(&flat, view).concat();
                for (found, wanted) in found.concat().iter().zip(wanted) {
                    let error = (f64::from(*found) - wanted).abs();
                    assert!(error < 3e-4, "{}, step {n}: {error:e}", backend.name);
                }
            }
        }
        let moved = exposure_of(&flat, &plain[0]).concat();
        let largest = moved.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        assert!(largest > 0.05, "nothing moved: {moved:?}");
    }
}

/// Two views of one place, one taken darker: the network separates them, without exposures of their own.
#[test]
fn the_network_learns_that_a_view_is_darker() {
    for backend in &BACKENDS {
        let scene = random::scene(85, &ORDINARY);
        let mut engine = (backend.engine)();
        let mut splats = scene.splats.clone();
        splats.sh.iter_mut().for_each(|k| *k *= 0.3);
        engine.append(&splats).unwrap();
        let view = &scene.view;
        let drawn = engine
            .render(&view.intrinsics, &view.cam_from_world, 3)
            .unwrap()
            .to_rgb();
        for gain in [1.0, 0.7] {
            let mut image = drawn.clone();
            for value in &mut image.pixels {
                *value = (gain * f32::from(*value)).round() as u8;
            }
            let image = std::sync::Arc::new(image);
            engine
                .add_view(TrainingView {
                    image,
                    ..view.clone()
                })
                .unwrap();
        }
        for n in 0..300 {
            let settings = StepSettings {
                train_splats: false,
                pose: PoseMode::Held,
                lr_appearance: 2e-3 * 0.985_f32.powi(n / 2),
                ..random::settings()
            };
            engine.step(n as usize % 2, &settings).unwrap();
        }
        let [plain, dark] = engine.exposures().unwrap().try_into().unwrap();
        for channel in 0..3 {
            let shown = |e: [[f32; 3]; 2]| e[0][channel].exp() * 0.4 + e[1][channel];
            let share = shown(dark) / shown(plain);
            assert!((share - 0.7).abs() < 0.04, "{}: {share}", backend.name);
        }
    }
}
