//! The backends, and their gradients against the twin's.

use splat_mapper::splat::cpu::{self, CpuEngine, Gradients};
use splat_mapper::splat::{Engine, Rendering, Splats, StepSettings, TrainingView};

use crate::reference::hostile::{KINDS, camera};
use crate::reference::loss::MIN_DEPTH_ALPHA;
use crate::reference::random::{self, Recipe, SMALL, Scene};
use crate::reference::{self, Params, Target, Weights};

const ARRAYS: [&str; 6] = [
    "means",
    "log_scales",
    "quats",
    "opacity_logits",
    "sh",
    "pose",
];

/// What stands in the dock.
pub struct Backend {
    pub name: &'static str,
    /// What it reaches, with room for a few roundings; far below the bars for any backend.
    pub picture_error: f64,
    /// Norm of the error of a parameter array over the array's norm.
    pub gradient_error: f64,
    pub engine: fn() -> Box<dyn Engine>,
    pub gradients: fn(&Splats, &TrainingView, &StepSettings) -> Gradients,
}

pub const BACKENDS: [Backend; 1] = [Backend {
    name: "cpu",
    picture_error: 1e-4,
    gradient_error: 2e-4,
    engine: || Box::new(CpuEngine::new()),
    gradients: cpu::gradients,
}];

impl Backend {
    pub fn render(&self, scene: &Scene) -> Rendering {
        let mut engine = (self.engine)();
        engine.append(&scene.splats);
        engine.render(&scene.view.intrinsics, &scene.view.cam_from_map, 3)
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
fn emphases() -> [(&'static str, StepSettings); 6] {
    let plain = StepSettings {
        ssim_weight: 0.0,
        depth_weight: 0.0,
        opacity_reg: 0.0,
        scale_reg: 0.0,
        ..random::settings()
    };
    [
        ("l1", plain.clone()),
        (
            "ssim",
            StepSettings {
                ssim_weight: 1.0,
                ..plain.clone()
            },
        ),
        (
            "depth",
            StepSettings {
                depth_weight: 30.0,
                ..plain.clone()
            },
        ),
        (
            "opacity",
            StepSettings {
                opacity_reg: 30.0,
                ..plain.clone()
            },
        ),
        (
            "scale",
            StepSettings {
                scale_reg: 30.0,
                ..plain
            },
        ),
        ("all", random::settings()),
    ]
}

fn twin_gradients(
    splats: &Splats,
    view: &TrainingView,
    settings: &StepSettings,
) -> reference::Gradients {
    let scene = Scene {
        splats: splats.clone(),
        view: view.clone(),
    };
    let weights = Weights::new(settings);
    reference::gradients(
        &Params::from(splats),
        &camera(&scene),
        &Target::new(view),
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
    twin: &reference::Gradients,
    settings: &StepSettings,
) -> Result<[f64; 7], String> {
    let visible: Vec<usize> = found.visible.iter().map(|&ix| ix as usize).collect();
    if visible != twin.visible {
        return Err(format!(
            "visible are {visible:?}, the twin sees {:?}",
            twin.visible
        ));
    }
    let widen = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<_>>();
    let pairs = [
        (
            widen(found.means.as_flattened()),
            twin.splats.means.concat(),
        ),
        (
            widen(found.log_scales.as_flattened()),
            twin.splats.log_scales.concat(),
        ),
        (
            widen(found.quats.as_flattened()),
            twin.splats.quats.concat(),
        ),
        (
            widen(&found.opacity_logits),
            twin.splats.opacity_logits.clone(),
        ),
        (widen(&found.sh), twin.splats.sh.clone()),
        (found.pose.to_vec(), twin.pose.to_vec()),
    ];
    let mut errors = [0.0; 7];
    for (which, (found, twin)) in pairs.iter().enumerate() {
        if found.len() != twin.len() {
            return Err(format!(
                "{}: {} numbers where {} belong",
                ARRAYS[which],
                found.len(),
                twin.len()
            ));
        }
        if let Some(at) = (0..twin.len())
            .find(|&at| !found[at].is_finite() || (twin[at] == 0.0 && found[at].abs() > 1e-6))
        {
            return Err(format!(
                "{}[{at}] is {:e}, the twin's {:e}",
                ARRAYS[which], found[at], twin[at]
            ));
        }
        let error = norm(found.iter().zip(twin).map(|(a, b)| a - b));
        errors[which] = if error == 0.0 {
            0.0
        } else {
            error / norm(twin.iter().copied()).max(1e-12)
        };
    }
    // What has no weight need not be computed.
    let mut losses = vec![(found.loss, twin.loss.total), (found.l1, twin.loss.l1)];
    if settings.ssim_weight > 0.0 {
        losses.push((found.ssim, twin.loss.ssim));
    }
    if settings.depth_weight > 0.0 {
        losses.push((found.depth, twin.loss.depth));
    }
    errors[6] = losses
        .into_iter()
        .map(|(a, b)| (a - b).abs() / b.abs().max(1e-3))
        .fold(0.0, f64::max);
    Ok(errors)
}

/// No pixel sits where rounding decides whether it has a depth.
fn is_decided(twin: &reference::Gradients) -> bool {
    twin.raster
        .alpha
        .iter()
        .all(|alpha| (alpha - MIN_DEPTH_ALPHA).abs() > 1e-4)
}

#[test]
fn every_backends_gradients_are_the_twins() {
    for backend in BACKENDS {
        let mut worst = [0.0_f64; 7];
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
                let twin = twin_gradients(&scene.splats, &scene.view, &settings);
                if !is_decided(&twin) {
                    continue;
                }
                let found = (backend.gradients)(&scene.splats, &scene.view, &settings);
                let errors = compare(&found, &twin, &settings)
                    .unwrap_or_else(|reason| panic!("{name}, seed {seed}: {reason}"));
                for (which, error) in errors.into_iter().enumerate() {
                    assert!(
                        error <= backend.gradient_error,
                        "{}, {name}, seed {seed}, {which}: {errors:?}",
                        backend.name
                    );
                    worst[which] = worst[which].max(error);
                }
            }
        }
        eprintln!(
            "{}: {:?}",
            backend.name,
            worst.map(|error| format!("{error:.0e}"))
        );
    }
}

#[test]
fn hostile_scenes_give_every_backend_the_twins_gradients() {
    for backend in BACKENDS {
        let mut failures = String::new();
        for (name, n, make) in KINDS {
            let mut worst = [0.0_f64; 7];
            for seed in 0..n.min(6) {
                let scene = make(seed);
                let settings = random::settings();
                let twin = twin_gradients(&scene.splats, &scene.view, &settings);
                let found = (backend.gradients)(&scene.splats, &scene.view, &settings);
                match compare(&found, &twin, &settings) {
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
