//! MCMC moves as the engine makes them: the image stays, the dead become copies, draws repeat.

use crate::backends::{BACKENDS, ORDINARY};
use crate::reference::random::{self, Recipe, Scene};
use splat_engine::cpu::engine::CpuEngine;
use splat_engine::mcmc::Relocation;
use splat_engine::settings::{McmcSettings, StepSettings};
use splat_engine::traits::{Renderer as _, SplatBuffers as _, Trainer as _, ViewStore as _};
use splat_types::splats::splats::Splats;

pub const MOVES: McmcSettings = McmcSettings {
    min_opacity: 0.005,
    copies: Relocation::Image,
    max_splats: 1_000_000,
    growth: 1.0,
    active_steps: 0,
    keeps_age: false,
    seed: 7,
};
/// An opacity of 0.0003: below what is drawn.
const DEAD_LOGIT: f32 = -8.0;

fn engine_of(scene: &Scene) -> CpuEngine {
    let mut engine = CpuEngine::new();
    engine.append(&scene.splats).unwrap();
    engine.add_view(scene.view.clone()).unwrap();
    engine
}

/// Every n-th splat is dead.
fn scene_with_dead(seed: u64, n_splats: usize, every: usize) -> Scene {
    let recipe = Recipe {
        n_splats,
        ..ORDINARY
    };
    let mut scene = random::scene(seed, &recipe);
    for (ix, logit) in scene.splats.opacity_logits.iter_mut().enumerate() {
        // Others are well above the limit, so that only these are dead.
        *logit = if ix % every == 0 {
            DEAD_LOGIT
        } else {
            logit.max(-2.0)
        };
        scene.splats.anchors[ix] = ix as u32;
    }
    scene
}

fn opacity(splats: &Splats, ix: usize) -> f32 {
    1.0 / (1.0 + (-splats.opacity_logits[ix]).exp())
}

/// Mean over all pixels and channels of |after - before|, black background, in 8 scenes. Dead splats are invisible and copies
/// lie where their source lies, as the formulas assume. A stack of opaque splats has not the shape of one, whatever it
/// keeps, so the bar depends on how opaque they are.
#[test]
fn moving_and_adding_splats_leaves_the_image_as_it_is() {
    for (copies, most, growth, bar) in [
        (Relocation::Line, 0.0, 1.0, 1e-3),
        (Relocation::Line, 0.0, 1.05, 1e-3),
        (Relocation::Line, 3.0, 1.05, 4e-3),
        (Relocation::Image, 3.0, 1.0, 1e-3),
        (Relocation::Image, 3.0, 1.05, 2e-3),
    ] {
        let mut mean = 0.0;
        for seed in 0..8 {
            let mut scene = scene_with_dead(seed, 200, 20);
            let logits = scene.splats.opacity_logits.iter_mut();
            logits.for_each(|logit| *logit = logit.min(most));
            let mut engine = engine_of(&scene);
            let (intrinsics, pose) = (scene.view.intrinsics, scene.view.cam_from_world);
            let before = engine.render(&intrinsics, &pose, 3).unwrap().rgb;
            let moves = McmcSettings {
                growth,
                copies,
                ..MOVES
            };
            let n = engine.relocate_and_grow(&moves).unwrap();
            assert_eq!(n, if growth > 1.0 { 210 } else { 200 });
            let after = engine.render(&intrinsics, &pose, 3).unwrap().rgb;
            let pairs = before.iter().zip(&after);
            let sum: f64 = pairs.map(|(a, b)| f64::from((a - b).abs())).sum();
            mean += sum / before.len() as f64 / 8.0;
        }
        eprintln!(
            "{copies:?}, logits up to {most}, growth {growth}: a pixel differs by {mean:.1e}"
        );
        assert!(mean < bar, "{mean:e}");
    }
}

#[test]
fn the_dead_become_copies_of_the_living() {
    let scene = scene_with_dead(20, 300, 3);
    let mut engine = engine_of(&scene);
    assert_eq!(engine.relocate_and_grow(&MOVES).unwrap(), 300);
    let after = engine.read().unwrap();
    for ix in (0..300).step_by(3) {
        let source = after.anchors[ix] as usize;
        assert_ne!(source % 3, 0, "a dead splat was copied");
        assert_eq!(after.means[ix], scene.splats.means[source]);
        assert_eq!(after.means[ix], after.means[source]);
        assert_eq!(after.log_scales[ix], after.log_scales[source]);
        assert_eq!(after.quats[ix], after.quats[source]);
        assert_eq!(after.opacity_logits[ix], after.opacity_logits[source]);
        assert_eq!(
            after.sh[ix * 48..(ix + 1) * 48],
            after.sh[source * 48..(source + 1) * 48]
        );
        assert!(opacity(&after, source) < opacity(&scene.splats, source));
        assert!(after.log_scales[source][0] < scene.splats.log_scales[source][0]);
    }
    let n_copies = |ix: u32| after.anchors.iter().filter(|&&a| a == ix).count() as u32;
    for ix in (0..300).filter(|ix| ix % 3 != 0) {
        let expected = MOVES
            .copies
            .shared(opacity(&scene.splats, ix), n_copies(ix as u32), 0.005)
            .0;
        assert!((opacity(&after, ix) - expected).abs() < 1e-5);
    }
}

#[test]
fn every_backend_makes_the_same_moves() {
    for copies in [Relocation::Image, Relocation::Line] {
        let scene = scene_with_dead(5, 400, 3);
        let moves = McmcSettings {
            growth: 1.1,
            copies,
            ..MOVES
        };
        let all = BACKENDS.iter().map(|backend| {
            let mut engine = (backend.engine)();
            engine.append(&scene.splats).unwrap();
            assert_eq!(
                engine.relocate_and_grow(&moves).unwrap(),
                440,
                "{}",
                backend.name
            );
            engine.read().unwrap()
        });
        let all: Vec<Splats> = all.collect();
        for (found, backend) in all.iter().zip(&BACKENDS).skip(1) {
            assert_eq!(found.anchors, all[0].anchors, "{}", backend.name);
            for ix in 0..found.len() {
                let sizes = found.log_scales[ix].iter().zip(all[0].log_scales[ix]);
                let off = sizes.fold(0.0_f32, |off, (a, b)| off.max((a - b).abs()));
                let off = off.max((opacity(found, ix) - opacity(&all[0], ix)).abs());
                assert!(off < 2e-5, "{} {copies:?} {ix}: {off}", backend.name);
            }
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_moves_on_any_number_of_threads() {
    let run = |n_threads, seed| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
        pool.build().unwrap().install(|| {
            let mut engine = engine_of(&scene_with_dead(21, 700, 7));
            let settings = StepSettings {
                noise: 10.0,
                noise_seed: seed,
                ..random::settings()
            };
            for round in 0..3 {
                (0..4).for_each(|_| engine.step(0, &settings).unwrap());
                engine
                    .relocate_and_grow(&McmcSettings {
                        growth: 1.1,
                        seed: seed + round,
                        ..MOVES
                    })
                    .unwrap();
            }
            engine.read().unwrap()
        })
    };
    let one = run(1, 5);
    assert!(one == run(1, 5) && one == run(2, 5));
    assert!(one != run(1, 6), "the seed has no say");
}

#[test]
fn empty_dead_single_and_broken_maps_are_survived() {
    let growing = McmcSettings {
        growth: 1.5,
        ..MOVES
    };
    assert_eq!(CpuEngine::new().relocate_and_grow(&growing).unwrap(), 0);

    let mut all_dead = engine_of(&scene_with_dead(22, 30, 1));
    let before = all_dead.read().unwrap();
    assert_eq!(all_dead.relocate_and_grow(&growing).unwrap(), 30);
    assert_eq!(all_dead.read().unwrap(), before);

    let mut single = CpuEngine::new();
    let mut splats = scene_with_dead(23, 2, 2).splats;
    splats.opacity_logits[0] = 30.0;
    splats.truncate(1);
    single.append(&splats).unwrap();
    assert_eq!(single.relocate_and_grow(&growing).unwrap(), 1);
    assert_eq!(
        single
            .relocate_and_grow(&McmcSettings {
                growth: 4.0,
                ..MOVES
            })
            .unwrap(),
        4
    );
    assert!((0..4).all(|ix| single.read().unwrap().is_finite(ix)));

    let mut scene = scene_with_dead(24, 60, 2);
    for (ix, value) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY]
        .into_iter()
        .enumerate()
    {
        scene.splats.means[5 * ix][1] = value;
        scene.splats.log_scales[5 * ix + 1][0] = value;
        scene.splats.quats[5 * ix + 2][3] = value;
        scene.splats.opacity_logits[5 * ix + 3] = value;
        scene.splats.sh[(5 * ix + 4) * 48 + 47] = value;
    }
    let mut engine = engine_of(&scene);
    let n = engine.relocate_and_grow(&growing).unwrap();
    let after = engine.read().unwrap();
    assert_eq!(n, 90);
    assert!(
        (0..n).all(|ix| after.is_finite(ix)),
        "what is broken is replaced"
    );
}

#[test]
fn a_hostile_limit_moves_nothing_or_keeps_numbers_finite() {
    for min_opacity in [f32::NAN, f32::INFINITY, -1.0, 0.0, 1.0, 2.0] {
        let mut engine = engine_of(&scene_with_dead(25, 60, 4));
        let n = engine
            .relocate_and_grow(&McmcSettings {
                min_opacity,
                growth: 1.2,
                ..MOVES
            })
            .unwrap();
        let after = engine.read().unwrap();
        assert!((0..n).all(|ix| after.is_finite(ix)), "{min_opacity}");
    }
}

#[test]
fn only_splats_seen_of_late_are_copied() {
    let mut scene = scene_with_dead(26, 80, 4);
    // Half of them lie far off, where no view looks.
    for mean in &mut scene.splats.means[40..] {
        *mean = mean.map(|x| x + 1e4);
    }
    let mut engine = engine_of(&scene);
    let settings = StepSettings {
        lr_opacity: 0.0,
        lr_mean: 0.0,
        ..random::settings()
    };
    (0..5).for_each(|_| engine.step(0, &settings).unwrap());
    let active = McmcSettings {
        active_steps: 3,
        growth: 1.5,
        ..MOVES
    };
    let n = engine.relocate_and_grow(&active).unwrap();
    let anchors = engine.read().unwrap().anchors;
    assert!((80..n).all(|ix| anchors[ix] < 40), "{:?}", &anchors[80..]);
    assert!(
        (0..80).step_by(4).all(|ix| anchors[ix] < 40),
        "the dead move wherever they lie"
    );
    let frozen = StepSettings {
        train_splats: false,
        ..settings
    };
    (0..9).for_each(|_| engine.step(0, &frozen).unwrap());
    let more = engine.relocate_and_grow(&active).unwrap();
    assert!(more > n, "steps that move no splat do not age the map");
}

#[test]
fn noise_moves_the_faint_that_are_seen_and_nothing_else() {
    let mut scene = scene_with_dead(27, 60, 2);
    for ix in 0..60 {
        scene.splats.opacity_logits[ix] = if ix % 2 == 0 { -4.0 } else { 2.0 };
    }
    scene.splats.means[0] = [1e4; 3];
    let still = StepSettings {
        train_splats: true,
        noise: 1.0,
        ..StepSettings::default()
    };
    let mut engine = engine_of(&scene);
    engine.step(0, &still).unwrap();
    let after = engine.read().unwrap();
    let moved: Vec<usize> = (0..60)
        .filter(|&ix| after.means[ix] != scene.splats.means[ix])
        .collect();
    assert!(
        moved.len() > 10 && moved.iter().all(|ix| ix % 2 == 0 && *ix != 0),
        "{moved:?}"
    );
    let mut silent = engine_of(&scene);
    silent
        .step(
            0,
            &StepSettings {
                noise: 0.0,
                ..still
            },
        )
        .unwrap();
    assert_eq!(silent.read().unwrap(), scene.splats);
}
