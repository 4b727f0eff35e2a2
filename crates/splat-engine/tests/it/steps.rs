//! Every backend's optimiser steps against the reference's Adam.

use crate::backends::{BACKENDS, Backend, ORDINARY};
use crate::reference::Params;
use crate::reference::adam::{PoseAdam, SplatAdam};
use crate::reference::random::{self, Scene};
use splat_engine::gradients::Gradients;
use splat_engine::settings::{PoseMode, StepSettings};
use splat_engine::view::TrainingView;
use splat_types::transform::Rigid;

/// Adam alone: the reference implementation gets the backend's own gradients, so that only the update differs.
fn check_steps(backend: &Backend, scene: &Scene, settings: &[StepSettings]) {
    let mut engine = (backend.engine)();
    engine.append(&scene.splats).unwrap();
    // The second view sees fewer splats, so update counts differ.
    let aside =
        Rigid::exp([0.8, 0.0, 0.0].into(), [0.0, 0.5, 0.0].into()) * scene.view.cam_from_world;
    let views = [
        scene.view.clone(),
        TrainingView {
            cam_from_world: aside,
            ..scene.view.clone()
        },
    ];
    views
        .iter()
        .for_each(|view| assert!(engine.add_view(view.clone()).unwrap() < 2));
    let mut splat_adam = SplatAdam::new(&Params::from(&scene.splats));
    let mut pose_adams = [PoseAdam::default(); 2];

    for (n, settings) in settings.iter().enumerate() {
        let view_ix = n * n % 3 % 2;
        let (before, pose) = (engine.read().unwrap(), engine.poses().unwrap()[view_ix]);
        let view = TrainingView {
            cam_from_world: pose,
            ..views[view_ix].clone()
        };
        let gradients = (backend.gradients)(&before, &view, settings);
        engine.step(view_ix, settings).unwrap();

        let mut wanted = Params::from(&before);
        if settings.train_splats {
            let visible: Vec<usize> = gradients.visible.iter().map(|&ix| ix as usize).collect();
            splat_adam.update(
                &mut wanted,
                &as_params(&gradients, before.sh_degree),
                &visible,
                settings,
            );
        }
        let wanted_pose = if settings.pose == PoseMode::Direct {
            pose_adams[view_ix].update(pose, gradients.pose, settings)
        } else {
            pose
        };
        let found = Params::from(&engine.read().unwrap());
        let context = format!("{}, step {n}", backend.name);
        assert_close(
            &context,
            &found.means.concat(),
            &wanted.means.concat(),
            settings.lr_mean,
        );
        assert_close(
            &context,
            &found.log_scales.concat(),
            &wanted.log_scales.concat(),
            settings.lr_scale,
        );
        assert_close(
            &context,
            &found.quats.concat(),
            &wanted.quats.concat(),
            settings.lr_quat,
        );
        assert_close(
            &context,
            &found.opacity_logits,
            &wanted.opacity_logits,
            settings.lr_opacity,
        );
        assert_close(&context, &found.sh, &wanted.sh, settings.lr_sh_rest);
        let found_pose = engine.poses().unwrap()[view_ix];
        assert!(
            found_pose.angle_to(&wanted_pose) < 1e-3 * f64::from(settings.lr_pose_rotation),
            "{context}"
        );
        let offset = (found_pose.translation - wanted_pose.translation).length();
        assert!(
            offset < 1e-3 * f64::from(settings.lr_pose_translation),
            "{context}: {offset:e}"
        );
    }
}

fn as_params(gradients: &Gradients, sh_degree: u8) -> Params {
    Params {
        means: gradients.means.iter().map(|v| v.map(f64::from)).collect(),
        log_scales: gradients
            .log_scales
            .iter()
            .map(|v| v.map(f64::from))
            .collect(),
        quats: gradients.quats.iter().map(|v| v.map(f64::from)).collect(),
        opacity_logits: gradients
            .opacity_logits
            .iter()
            .copied()
            .map(f64::from)
            .collect(),
        sh: gradients.sh.iter().copied().map(f64::from).collect(),
        sh_degree,
    }
}

/// Within a hundredth of the step that was taken, and the rounding of the number itself.
fn assert_close(context: &str, found: &[f64], wanted: &[f64], lr: f32) {
    assert_eq!(found.len(), wanted.len());
    for (at, (found, wanted)) in found.iter().zip(wanted).enumerate() {
        let allowed = 1e-2 * f64::from(lr) + 1.2e-7 * wanted.abs();
        assert!(
            (found - wanted).abs() <= allowed,
            "{context} [{at}]: {found} where the reference implementation has {wanted}, lr {lr}"
        );
    }
}

#[test]
fn every_backend_takes_the_references_steps() {
    let scene = random::scene(77, &ORDINARY);
    let steady = random::settings();
    let settings: Vec<StepSettings> = (0..15)
        .map(|n| StepSettings {
            sh_degree: [0, 1, 3, 2, 3][n / 3],
            // Splats that only one of the views sees come to their bands later.
            sh_interval: [0, 0, 0, 2, 3][n / 3],
            train_splats: n != 4,
            pose: if n == 5 {
                PoseMode::Held
            } else {
                PoseMode::Direct
            },
            lr_mean: steady.lr_mean / (n + 1) as f32,
            // None, half after three updates, and the least there is.
            lr_mean_decay: [0.0, 1.0 / 3.0, 1e3][n % 3],
            ..steady.clone()
        })
        .collect();
    BACKENDS
        .iter()
        .for_each(|backend| check_steps(backend, &scene, &settings));
}

#[test]
fn a_step_on_a_view_that_sees_nothing_changes_nothing() {
    for backend in BACKENDS {
        let mut scene = random::scene(78, &ORDINARY);
        scene.view.cam_from_world =
            Rigid::exp([0.0, 0.0, -50.0].into(), [0.0; 3].into()) * scene.view.cam_from_world;
        let mut engine = (backend.engine)();
        engine.append(&scene.splats).unwrap();
        let view_ix = engine.add_view(scene.view.clone()).unwrap();
        (0..3).for_each(|_| engine.step(view_ix, &random::settings()).unwrap());
        assert_eq!(engine.read().unwrap(), scene.splats, "{}", backend.name);
        assert_eq!(
            engine.poses().unwrap(),
            [scene.view.cam_from_world],
            "{}",
            backend.name
        );
    }
}

/// Numbers that are finite and nothing else; the reference implementation has nothing to say about them.
fn at_the_edge_of_f32(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &ORDINARY);
    let extremes = [
        f32::MAX,
        -f32::MAX,
        f32::MIN_POSITIVE,
        1e-42,
        -1e25,
        1e19,
        60.0,
        -60.0,
        25.0,
        44.5,
    ];
    let stride = scene.splats.sh_stride();
    for ix in 0..scene.splats.len() / 2 {
        let extreme = extremes[(ix + seed as usize) % extremes.len()];
        match ix % 6 {
            0 => scene.splats.means[ix][ix % 3] = extreme,
            1 => scene.splats.log_scales[ix] = [extreme; 3],
            2 => scene.splats.log_scales[ix][ix % 3] = extreme,
            3 => scene.splats.quats[ix] = [extreme; 4],
            4 => scene.splats.quats[ix][ix % 4] = extreme,
            _ => scene.splats.sh[ix * stride + 1] = extreme,
        }
    }
    scene
}

#[test]
fn numbers_at_the_edge_of_f32_break_no_backend() {
    for backend in BACKENDS {
        for seed in 0..20 {
            let scene = at_the_edge_of_f32(seed);
            let mut engine = (backend.engine)();
            engine.append(&scene.splats).unwrap();
            let view_ix = engine.add_view(scene.view.clone()).unwrap();
            (0..3).for_each(|_| engine.step(view_ix, &random::settings()).unwrap());
            let splats = engine.read().unwrap();
            let numbers = [
                splats.means.as_flattened(),
                splats.log_scales.as_flattened(),
                splats.quats.as_flattened(),
            ];
            let numbers = numbers
                .into_iter()
                .chain([&splats.opacity_logits[..], &splats.sh[..]])
                .flatten();
            let n_lost = numbers.filter(|number| !number.is_finite()).count();
            assert_eq!(
                n_lost, 0,
                "{}, seed {seed}: numbers that were finite",
                backend.name
            );
            assert!(
                engine.poses().unwrap()[0].is_finite(),
                "{}, seed {seed}",
                backend.name
            );
            let alpha = engine
                .render(&scene.view.intrinsics, &scene.view.cam_from_world, 3)
                .unwrap()
                .alpha;
            assert!(
                alpha.iter().all(|a| (0.0..=1.0).contains(a)),
                "{}, seed {seed}",
                backend.name
            );
        }
    }
}
