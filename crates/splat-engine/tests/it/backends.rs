//! The backends, and their gradients against the reference's.

use crate::gpu::{gpu_engine, gpu_gradients};
use crate::reference::differences::ARRAYS;
use crate::reference::hostile::{KINDS, camera};
use crate::reference::loss_depth::MIN_DEPTH_ALPHA;
use crate::reference::random::{self, Recipe, SMALL, Scene};
use crate::reference::{self, Params, Target, Weights};
use splat_engine::cpu::engine::{self, CpuEngine};
use splat_engine::gradients::Gradients;
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{DepthMode, StepSettings};
use splat_engine::traits::Engine;
use splat_engine::view::TrainingView;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;

const PLAIN: [[f32; 3]; 2] = [[0.0; 3]; 2];
/// Errors of the arrays and of the loss.
type Errors = [f64; 9];

/// What stands in the dock.
pub struct Backend {
    pub name: &'static str,
    /// What it reaches, with room for a few roundings; far below the bars for any backend.
    pub image_error: f64,
    /// Norm of the error of a parameter array over the array's norm.
    pub gradient_error: f64,
    /// The same of the focal factor: one number, the small difference of large sums over the image's two halves.
    pub focal_error: f64,
    pub engine: fn() -> Box<dyn Engine>,
    pub gradients: fn(&Splats, &TrainingView, &StepSettings) -> Gradients,
}

pub const BACKENDS: [Backend; 3] = [
    Backend {
        name: "cpu",
        image_error: 1e-4,
        gradient_error: 2e-4,
        focal_error: 2e-4,
        engine: || Box::new(CpuEngine::new()),
        gradients: engine::gradients,
    },
    Backend {
        name: "wgpu",
        image_error: 1e-3,
        gradient_error: 1e-3,
        focal_error: 5e-2,
        engine: || Box::new(gpu_engine(true)),
        gradients: |splats, view, settings| gpu_gradients(true, splats, view, settings),
    },
    Backend {
        name: "wgpu without subgroups",
        image_error: 1e-3,
        gradient_error: 1e-3,
        focal_error: 5e-2,
        engine: || Box::new(gpu_engine(false)),
        gradients: |splats, view, settings| gpu_gradients(false, splats, view, settings),
    },
];

impl Backend {
    /// On `engine`, which is one of this backend's and used again: opening a device compiles all shaders.
    pub fn render(engine: &mut dyn Engine, scene: &Scene) -> Rendering {
        engine.retain(&vec![false; engine.len()]).unwrap();
        engine.append(&scene.splats).unwrap();
        engine
            .render(&scene.view.intrinsics, &scene.view.cam_from_world, 3)
            .unwrap()
    }
}

pub const ORDINARY: Recipe = Recipe {
    width_px: 47,
    height_px: 35,
    n_splats: 60,
    size_px: [0.7, 7.0],
    opacity_logit: [-3.0, 3.0],
    ..SMALL
};

/// Each term so heavy that its gradient cannot hide behind the others.
fn emphases() -> Vec<(String, StepSettings)> {
    let plain = StepSettings {
        ssim_weight: 0.0,
        weights: LossWeights::default(),
        ..random::settings()
    };
    let ssim = StepSettings {
        ssim_weight: 1.0,
        ..plain.clone()
    };
    let depth = |depth_mode| StepSettings {
        weights: LossWeights {
            depth_weight: 30.0,
            ..LossWeights::default()
        },
        depth_mode,
        ..plain.clone()
    };
    let valid = StepSettings {
        ssim_valid: true,
        ..ssim.clone()
    };
    let mut emphases = vec![
        ("l1".to_owned(), plain.clone()),
        ("ssim".to_owned(), ssim),
        ("ssim of whole windows".to_owned(), valid),
        (
            "depth as in the paper's code".to_owned(),
            depth(DepthMode::PaperCode),
        ),
        (
            "depth as in the paper's text".to_owned(),
            depth(DepthMode::PaperAlpha),
        ),
        ("all".to_owned(), random::settings()),
    ];
    for (ix, name) in LossWeights::NAMES.iter().enumerate() {
        let alone = StepSettings {
            weights: LossWeights::only(ix, 30.0),
            ..plain.clone()
        };
        emphases.push(((*name).to_owned(), alone));
    }
    emphases
}

fn reference_gradients(
    splats: &Splats,
    view: &TrainingView,
    exposure: [[f32; 3]; 2],
    settings: &StepSettings,
) -> reference::Gradients {
    let scene = Scene {
        splats: splats.clone(),
        view: view.clone(),
    };
    let weights = Weights::new(settings);
    let mut target = Target::new(view);
    target.exposure = exposure.map(|kind| kind.map(f64::from));
    reference::gradients(
        &Params::from(splats),
        &camera(&scene),
        &target,
        &weights,
        settings.sh_degree,
    )
}

fn norm(values: impl Iterator<Item = f64>) -> f64 {
    values.map(|value| value * value).sum::<f64>().sqrt()
}

/// Error of each array, and of the loss; or what does not fit at all.
fn compare(
    found: &Gradients,
    reference: &reference::Gradients,
    settings: &StepSettings,
) -> Result<Errors, String> {
    let visible: Vec<usize> = found.visible.iter().map(|&ix| ix as usize).collect();
    if visible != reference.visible {
        return Err(format!(
            "visible are {visible:?}, the reference implementation sees {:?}",
            reference.visible
        ));
    }
    let widen = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<_>>();
    let pairs = [
        (
            widen(found.means.as_flattened()),
            reference.splats.means.concat(),
        ),
        (
            widen(found.log_scales.as_flattened()),
            reference.splats.log_scales.concat(),
        ),
        (
            widen(found.quats.as_flattened()),
            reference.splats.quats.concat(),
        ),
        (
            widen(&found.opacity_logits),
            reference.splats.opacity_logits.clone(),
        ),
        (widen(&found.sh), reference.splats.sh.clone()),
        (found.pose.to_vec(), reference.pose.to_vec()),
        (found.exposure.concat(), reference.exposure.concat()),
        (vec![found.log_focal], vec![reference.log_focal]),
    ];
    let mut errors = Errors::default();
    for (which, (found, reference)) in pairs.iter().enumerate() {
        if found.len() != reference.len() {
            return Err(format!(
                "{}: {} numbers where {} belong",
                ARRAYS[which],
                found.len(),
                reference.len()
            ));
        }
        if let Some(at) = (0..reference.len())
            .find(|&at| !found[at].is_finite() || (reference[at] == 0.0 && found[at].abs() > 1e-6))
        {
            return Err(format!(
                "{}[{at}] is {:e}, the reference's {:e}",
                ARRAYS[which], found[at], reference[at]
            ));
        }
        let error = norm(found.iter().zip(reference).map(|(a, b)| a - b));
        errors[which] = if error == 0.0 {
            0.0
        } else {
            error / norm(reference.iter().copied()).max(1e-12)
        };
    }
    // What has no weight need not be computed.
    let mut losses = vec![
        (found.loss, reference.loss.total),
        (found.l1, reference.loss.l1),
    ];
    if settings.ssim_weight > 0.0 {
        losses.push((found.ssim, reference.loss.ssim));
    }
    if settings.weights.depth_weight > 0.0 {
        losses.push((found.depth, reference.loss.depth));
    }
    errors[8] = losses
        .into_iter()
        .map(|(a, b)| (a - b).abs() / b.abs().max(1e-3))
        .fold(0.0, f64::max);
    Ok(errors)
}

/// No pixel sits where rounding decides whether it has a depth, or which of two is larger.
fn is_decided(reference: &reference::Gradients) -> bool {
    let by_depth = reference.loss.depth_decisions.margin > 1e-5;
    by_depth
        && reference
            .raster
            .alpha
            .iter()
            .all(|alpha| (alpha - MIN_DEPTH_ALPHA).abs() > 1e-4)
}

/// Of the pairs of scene and loss: an adapter's exponential may turn a decision at a pixel (too faint, over, deep enough)
/// that the native engine's does not.
const MAX_TURNED: f64 = 0.03;
/// Error that one turned pixel of these small images can make: it may be an end of a stretched range.
const TURNED_ERROR: f64 = 0.2;

#[test]
fn every_backends_gradients_are_the_references() {
    for backend in BACKENDS {
        let mut worst = Errors::default();
        let (mut n_pairs, mut turned) = (0, Vec::new());
        for seed in 0..24 {
            let degree = (seed % 4) as u8;
            let scene = random::scene(
                1000 + seed,
                &Recipe {
                    sh_degree: degree,
                    ..ORDINARY
                },
            );
            for (name, settings) in emphases() {
                let reference = reference_gradients(&scene.splats, &scene.view, PLAIN, &settings);
                if !is_decided(&reference) {
                    continue;
                }
                let found = (backend.gradients)(&scene.splats, &scene.view, &settings);
                let errors = compare(&found, &reference, &settings)
                    .unwrap_or_else(|reason| panic!("{name}, seed {seed}: {reason}"));
                n_pairs += 1;
                for (which, error) in errors.into_iter().enumerate() {
                    let allowed = if ARRAYS.get(which) == Some(&"log_focal") {
                        backend.focal_error
                    } else {
                        backend.gradient_error
                    };
                    if error > allowed && backend.name != "cpu" && error < TURNED_ERROR {
                        turned.push(format!("{name}, seed {seed}, {which}: {error:.1e}"));
                        break;
                    }
                    assert!(
                        error <= allowed,
                        "{}, {name}, seed {seed}, {which}: {errors:?}",
                        backend.name
                    );
                    worst[which] = worst[which].max(error);
                }
            }
        }
        assert!(
            turned.len() as f64 <= MAX_TURNED * f64::from(n_pairs),
            "{}: {turned:?} of {n_pairs}",
            backend.name
        );
        eprintln!(
            "{}: {turned:?}, {:?}",
            backend.name,
            worst.map(|error| format!("{error:.0e}"))
        );
    }
}

#[test]
fn hostile_scenes_give_every_backend_the_references_gradients() {
    for backend in BACKENDS {
        let mut failures = String::new();
        for (name, n, make) in KINDS {
            let mut worst = Errors::default();
            for seed in 0..n.min(6) {
                let mut scene = make(seed);
                if seed % 2 == 1 {
                    scene.view.mask = Some(random::mask(seed, &scene.view.image));
                }
                let settings = random::settings();
                let reference = reference_gradients(&scene.splats, &scene.view, PLAIN, &settings);
                let found = (backend.gradients)(&scene.splats, &scene.view, &settings);
                match compare(&found, &reference, &settings) {
                    Ok(errors) => {
                        worst = std::array::from_fn(|which| worst[which].max(errors[which]));
                    }
                    Err(reason) => failures += &format!("{name}, seed {seed}: {reason}\n"),
                }
            }
            eprintln!(
                "{}, {name}: {:?}",
                backend.name,
                worst.map(|error| format!("{error:.0e}"))
            );
        }
        assert!(failures.is_empty(), "{}:\n{failures}", backend.name);
    }
}

#[test]
fn weighted_pixels_and_an_exposure_give_the_cpu_the_references_gradients() {
    let exposure = [[0.3, -0.25, 0.1], [-0.05, 0.1, 0.02]];
    for seed in 0..8 {
        let mut scene = random::scene(2000 + seed, &ORDINARY);
        scene.view.mask = Some(random::mask(seed, &scene.view.image));
        for (name, settings) in emphases() {
            let (splats, view) = (&scene.splats, &scene.view);
            let reference = reference_gradients(splats, view, exposure, &settings);
            if !is_decided(&reference) {
                continue;
            }
            let found = engine::gradients_exposed(splats, view, exposure, &settings);
            let errors = compare(&found, &reference, &settings)
                .unwrap_or_else(|reason| panic!("{name}, seed {seed}: {reason}"));
            let is_close = errors.iter().all(|&error| error <= 2e-4);
            assert!(is_close, "{name}, seed {seed}: {errors:?}");
        }
    }
}

/// The reference implementation sums each 11 x 11 window plainly in f64.
#[test]
fn ssim_is_that_of_plain_windows() {
    for backend in BACKENDS {
        for seed in 0..12 {
            let scene = random::scene(3000 + seed, &ORDINARY);
            let settings = random::settings();
            let reference = reference_gradients(&scene.splats, &scene.view, PLAIN, &settings);
            let found = (backend.gradients)(&scene.splats, &scene.view, &settings);
            let error = (found.ssim - reference.loss.ssim).abs();
            assert!(error < 1e-5, "{}, seed {seed}: {error:e}", backend.name);
        }
    }
}
