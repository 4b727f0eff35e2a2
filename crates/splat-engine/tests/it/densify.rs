//! Screen gradients as every backend adds them up, against the reference; opacities held down; rows that come and go.

use crate::backends::{BACKENDS, Backend, ORDINARY};
use crate::reference::densify::{loss_with_moved_mean, screen_gradients};
use crate::reference::hostile::camera;
use crate::reference::random::{self, SMALL, Scene};
use crate::reference::{Params, Target, Weights};
use splat_engine::densify::ScreenGradients;
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::StepSettings;
use splat_engine::traits::Engine;
use splat_engine::view::TrainingView;
use splat_types::transform::Rigid;

/// Of a number beside the largest one: sums in f32.
const STEP: f64 = 1e-6;

fn settings() -> StepSettings {
    StepSettings {
        accumulate_screen_gradients: true,
        ..random::settings()
    }
}

fn engine_of(backend: &Backend, scene: &Scene) -> Box<dyn Engine> {
    let mut engine = (backend.engine)();
    engine.append(&scene.splats).unwrap();
    for view in views(scene) {
        assert!(engine.add_view(view).unwrap() < 2);
    }
    engine
}

/// The second one sees fewer splats.
fn views(scene: &Scene) -> [TrainingView; 2] {
    let aside =
        Rigid::exp([0.8, 0.0, 0.0].into(), [0.0, 0.5, 0.0].into()) * scene.view.cam_from_world;
    let second = TrainingView {
        cam_from_world: aside,
        ..scene.view.clone()
    };
    [scene.view.clone(), second]
}

/// Sums of the reference over steps at the backend's own splats and poses.
fn expect(scene: &Scene, engine: &mut dyn Engine, order: &[usize]) -> (Vec<f64>, Vec<u32>) {
    let mut sums = vec![0.0; scene.splats.len()];
    let mut counts = vec![0; scene.splats.len()];
    for view_ix in order {
        let view = TrainingView {
            cam_from_world: engine.poses().unwrap()[*view_ix],
            ..views(scene)[*view_ix].clone()
        };
        let seen = Scene {
            splats: engine.read().unwrap(),
            view: view.clone(),
        };
        let found = screen_gradients(
            &Params::from(&seen.splats),
            &camera(&seen),
            &Target::new(&view),
            &Weights::new(&settings()),
            settings().sh_degree,
        );
        for (ix, [x, y]) in found {
            sums[ix] += x.hypot(y);
            counts[ix] += 1;
        }
        engine.step(*view_ix, &settings()).unwrap();
    }
    (sums, counts)
}

fn check(backend: &Backend, taken: &ScreenGradients, (sums, counts): &(Vec<f64>, Vec<u32>)) {
    assert_eq!(&taken.counts, counts, "{}", backend.name);
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let pairs = taken.sums.iter().zip(sums);
    let off = norm(&mut pairs.map(|(a, b)| f64::from(*a) - b));
    let all = norm(&mut sums.iter().copied());
    eprintln!("{}: sums are off by {:.1e}", backend.name, off / all);
    assert!(
        all > 0.0 && off < backend.gradient_error * all,
        "{}: {off:e} of {all:e}",
        backend.name
    );
}

#[test]
fn the_references_screen_gradient_agrees_with_central_differences() {
    let weights = Weights {
        l1: 0.8,
        ssim: 0.2,
        terms: LossWeights::default(),
        ..Weights::default()
    };
    for seed in 0..4 {
        let scene = random::scene(seed, &SMALL);
        let (params, target) = (Params::from(&scene.splats), Target::new(&scene.view));
        let claimed = screen_gradients(&params, &camera(&scene), &target, &weights, 1);
        let largest = claimed
            .iter()
            .flat_map(|(_, v)| v)
            .fold(0.0, |max: f64, v| max.max(v.abs()));
        let (mut n_off, mut n_all) = (0, 0);
        for (which, (_, claimed)) in claimed.iter().enumerate() {
            for axis in 0..2 {
                let at = |by: f64| {
                    let mut moved = [0.0; 2];
                    moved[axis] = by;
                    let moved = (1, which, moved);
                    loss_with_moved_mean(&params, &camera(&scene), &target, &weights, moved)
                };
                let numeric = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                n_all += 1;
                n_off += usize::from((claimed[axis] - numeric).abs() > 1e-4 * largest);
            }
        }
        // Signs of L1 and ends of splats may lie between.
        assert!(n_all > 10 && 20 * n_off <= n_all, "{n_off} of {n_all}");
    }
}

#[test]
fn every_backend_adds_up_the_references_screen_gradients() {
    for backend in &BACKENDS {
        for seed in 0..3 {
            let scene = random::scene(90 + seed, &ORDINARY);
            let mut engine = engine_of(backend, &scene);
            let expected = expect(&scene, &mut *engine, &[0, 1, 1, 0, 0]);
            assert!(
                expected.1.contains(&3) && expected.1.contains(&5),
                "views differ"
            );
            check(backend, &engine.take_screen_gradients().unwrap(), &expected);
            // Taken: the next ones begin anew, and only of steps that are to add up.
            let plain = random::settings();
            engine.step(0, &plain).unwrap();
            let none = engine.take_screen_gradients().unwrap();
            assert!(none.sums.iter().all(|sum| *sum == 0.0) && none.counts.iter().all(|n| *n == 0));
            assert_eq!(none.counts.len(), scene.splats.len());
            let expected = expect(&scene, &mut *engine, &[1, 0]);
            check(backend, &engine.take_screen_gradients().unwrap(), &expected);
        }
    }
}

#[test]
fn sums_stay_with_their_splats_as_rows_go_and_come() {
    for backend in &BACKENDS {
        let scene = random::scene(95, &ORDINARY);
        let mut engine = engine_of(backend, &scene);
        let (sums, counts) = expect(&scene, &mut *engine, &[0, 1]);
        let keep: Vec<bool> = (0..scene.splats.len()).map(|ix| ix % 3 != 0).collect();
        engine.retain(&keep).unwrap();
        engine.append(&scene.splats.picked(&[0, 1])).unwrap();
        // Without a sum, steps leave what is there as it is.
        engine.step(0, &random::settings()).unwrap();
        let kept = |ix: &usize| keep[*ix];
        let kept: Vec<usize> = (0..keep.len()).filter(kept).collect();
        let mut expected: (Vec<f64>, Vec<u32>) =
            kept.iter().map(|ix| (sums[*ix], counts[*ix])).unzip();
        expected.0.extend([0.0; 2]);
        expected.1.extend([0; 2]);
        check(backend, &engine.take_screen_gradients().unwrap(), &expected);
    }
}

#[test]
fn opacities_are_held_down_and_their_moments_are_gone() {
    for backend in &BACKENDS {
        let scene = random::scene(97, &ORDINARY);
        let mut engine = engine_of(backend, &scene);
        (0..3).for_each(|_| engine.step(0, &settings()).unwrap());
        let before = engine.read().unwrap();
        engine.reset_opacities(0.1).unwrap();
        let after = engine.read().unwrap();
        let most = (0.1_f32 / 0.9).ln();
        for (before, after) in before.opacity_logits.iter().zip(&after.opacity_logits) {
            assert_eq!(*after, before.min(most), "{}", backend.name);
        }
        assert_eq!(before.means, after.means, "{}", backend.name);
        // The first step after it goes against the gradient alone: with old moments some would go on as before.
        let gradients = (backend.gradients)(&after, &scene.view, &settings());
        let still = StepSettings {
            lr_mean: 0.0,
            ..settings()
        };
        engine.set_pose(0, scene.view.cam_from_world).unwrap();
        engine.step(0, &still).unwrap();
        let stepped = engine.read().unwrap();
        let mut n_seen = 0;
        for ix in gradients.visible.iter().map(|ix| *ix as usize) {
            let moved = stepped.opacity_logits[ix] - after.opacity_logits[ix];
            let g = gradients.opacity_logits[ix];
            if g.abs() > 1e-6 {
                n_seen += 1;
                assert!(moved * g < 0.0, "{}: {moved} by {g}", backend.name);
            }
        }
        assert!(n_seen > 10, "{n_seen}");
    }
}
