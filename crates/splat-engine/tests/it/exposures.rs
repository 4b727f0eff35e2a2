//! Weighted pixels and exposures: what the CPU engine learns from images that do not count everywhere, or were taken
//! brighter.

use std::sync::Arc;

use crate::backends::ORDINARY;
use crate::reference::adam::ExposureAdam;
use crate::reference::hostile::KINDS;
use crate::reference::random::{self, Scene};
use splat_engine::cpu::engine::{self, CpuEngine};
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{DepthMode, PoseMode, StepSettings};
use splat_engine::traits::{Renderer as _, SplatBuffers as _, Trainer as _, ViewStore as _};
use splat_engine::view::TrainingView;
use splat_types::image::RgbImage;

/// The scene's view with an image of the scene, taken with a gain and an offset.
fn photograph(scene: &Scene, gain: f32, offset: f32) -> TrainingView {
    let view = &scene.view;
    let mut engine = CpuEngine::new();
    engine.append(&scene.splats).unwrap();
    let image = engine
        .render(&view.intrinsics, &view.cam_from_world, 3)
        .unwrap();
    let exposed = image.rgb.iter().map(|c| gain * c + offset);
    let pixels = exposed.map(|c| (255.0 * c).round().clamp(0.0, 255.0) as u8);
    TrainingView {
        image: Arc::new(RgbImage {
            width_px: image.width_px,
            height_px: image.height_px,
            pixels: pixels.collect(),
        }),
        ..view.clone()
    }
}

/// Colours around 0.4, so that a brighter image is not cut.
fn dim_scene(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &ORDINARY);
    scene.splats.sh.iter_mut().for_each(|k| *k *= 0.3);
    scene
}

#[test]
fn exposures_take_the_references_steps() {
    let scene = random::scene(80, &ORDINARY);
    let settings = StepSettings {
        train_splats: false,
        pose: PoseMode::Held,
        lr_exposure: 0.02,
        ..random::settings()
    };
    let mut engine = CpuEngine::new();
    engine.append(&scene.splats).unwrap();
    engine.add_view(scene.view.clone()).unwrap();
    let (mut reference, mut wanted) = (ExposureAdam::default(), [[0.0; 3]; 2]);
    for n in 0..30 {
        let exposure = engine.exposures().unwrap()[0];
        let gradients = engine::gradients_exposed(&scene.splats, &scene.view, exposure, &settings);
        engine.step(0, &settings).unwrap();
        reference.update(&mut wanted, gradients.exposure, settings.lr_exposure);
        let found = engine.exposures().unwrap()[0].concat();
        for (found, wanted) in found.into_iter().zip(wanted.concat()) {
            assert!((f64::from(found) - wanted).abs() < 1e-4, "step {n}");
        }
    }
}

#[test]
fn a_image_taken_brighter_is_explained_by_its_exposure() {
    let scene = dim_scene(81);
    let mut engine = CpuEngine::new();
    engine.append(&scene.splats).unwrap();
    engine.add_view(photograph(&scene, 1.3, 0.05)).unwrap();
    engine.add_view(photograph(&scene, 1.0, 0.0)).unwrap();
    for n in 0..600 {
        let settings = StepSettings {
            train_splats: false,
            pose: PoseMode::Held,
            lr_exposure: 0.02 * 0.99_f32.powi(n / 2),
            ..random::settings()
        };
        engine.step(n as usize % 2, &settings).unwrap();
    }
    let [bright, plain] = engine.exposures().unwrap().try_into().unwrap();
    for channel in 0..3 {
        assert!((bright[0][channel].exp() - 1.3).abs() < 0.03, "{bright:?}");
        assert!((bright[1][channel] - 0.05).abs() < 0.02, "{bright:?}");
        assert!(plain[0][channel].abs() < 0.01, "{plain:?}");
        assert!(plain[1][channel].abs() < 0.01, "{plain:?}");
    }
    assert_eq!(engine.read().unwrap(), scene.splats);
}

/// Twice as bright splats under half the gain give the same images: nothing but the pull decides.
#[test]
fn the_pull_keeps_the_common_exposure_at_zero() {
    let scene = dim_scene(82);
    let mut engine = CpuEngine::new();
    engine.append(&scene.splats).unwrap();
    engine.add_view(photograph(&scene, 1.2, 0.0)).unwrap();
    engine.add_view(photograph(&scene, 1.0 / 1.2, 0.0)).unwrap();
    let settings = StepSettings {
        lr_exposure: 0.01,
        pose: PoseMode::Held,
        weights: LossWeights {
            depth_weight: 0.0,
            ..random::settings().weights
        },
        ..random::settings()
    };
    (0..800).for_each(|n| engine.step(n % 2, &settings).unwrap());
    let [bright, dark] = engine.exposures().unwrap().try_into().unwrap();
    for channel in 0..3 {
        let mean = 0.5 * (bright[0][channel] + dark[0][channel]);
        assert!(mean.abs() < 0.06, "{bright:?} {dark:?}");
        assert!(bright[0][channel] - dark[0][channel] > 0.2);
    }
}

#[test]
fn what_a_weight_of_zero_hides_teaches_nothing() {
    let scene = random::scene(83, &ORDINARY);
    let mask = random::mask(83, &scene.view.image);
    let mut repainted = (*scene.view.image).clone();
    for (pixel, &weight) in repainted.pixels.chunks_exact_mut(3).zip(&*mask) {
        if weight == 0 {
            pixel.fill(77);
        }
    }
    // SSIM looks past a pixel at its neighbours, so only L1 is blind to the bit.
    let settings = StepSettings {
        ssim_weight: 0.0,
        ..random::settings()
    };
    let after = |image: &Arc<RgbImage>| {
        let mut engine = CpuEngine::new();
        engine.append(&scene.splats).unwrap();
        let image = Arc::clone(image);
        engine
            .add_view(TrainingView {
                image,
                ..scene.view.clone()
            })
            .unwrap();
        engine.set_mask(0, Some(Arc::clone(&mask))).unwrap();
        (0..5).for_each(|_| engine.step(0, &settings).unwrap());
        engine.read().unwrap()
    };
    assert!(after(&scene.view.image) == after(&Arc::new(repainted)));
}

#[test]
fn a_mask_of_ones_changes_no_bit_and_one_of_zeros_gives_no_loss() {
    let scene = random::scene(84, &ORDINARY);
    let run = |byte: Option<u8>| {
        let mut engine = CpuEngine::new();
        engine.append(&scene.splats).unwrap();
        engine.add_view(scene.view.clone()).unwrap();
        let n_pixels = scene.view.image.pixels.len() / 3;
        engine
            .set_mask(0, byte.map(|byte| vec![byte; n_pixels].into()))
            .unwrap();
        let settings = StepSettings {
            weights: LossWeights {
                opacity_reg: 0.0,
                scale_reg: 0.0,
                ..random::settings().weights
            },
            ..random::settings()
        };
        (0..3).for_each(|_| engine.step(0, &settings).unwrap());
        (engine.read().unwrap(), engine.take_stats().unwrap().loss)
    };
    assert!(run(Some(255)) == run(None));
    assert_eq!(run(Some(0)), (scene.splats.clone(), 0.0));
}

#[test]
fn hostile_scenes_stay_finite_with_every_mode_on() {
    let modes = [
        DepthMode::InverseDepth,
        DepthMode::PaperCode,
        DepthMode::PaperAlpha,
    ];
    for (name, n, make) in KINDS {
        for seed in 0..n.min(6) {
            let mut scene = make(seed);
            scene.view.mask = Some(random::mask(seed, &scene.view.image));
            let mut engine = CpuEngine::new();
            engine.append(&scene.splats).unwrap();
            engine.add_view(scene.view.clone()).unwrap();
            let were_finite: Vec<bool> = (0..scene.splats.len())
                .map(|ix| scene.splats.is_finite(ix))
                .collect();
            for step in 0..6 {
                let settings = StepSettings {
                    depth_mode: modes[step % 3],
                    weights: LossWeights {
                        depth_weight: 1.0,
                        ..random::settings().weights
                    },
                    lr_exposure: 0.5,
                    lr_appearance: 0.1,
                    noise: 1000.0,
                    noise_seed: seed as u32,
                    sh_interval: 2,
                    ..random::settings()
                };
                engine.step(0, &settings).unwrap();
            }
            let after = engine.read().unwrap();
            let is_kept = (0..after.len()).all(|ix| after.is_finite(ix) || !were_finite[ix]);
            assert!(is_kept, "{name}, seed {seed}");
            let exposures = engine.exposures().unwrap();
            let numbers = exposures[0].as_flattened();
            assert!(numbers.iter().all(|x| x.is_finite()), "{name}, seed {seed}");
            assert!(
                engine.take_stats().unwrap().loss.is_finite(),
                "{name}, seed {seed}"
            );
            assert!(
                engine.poses().unwrap()[0].is_finite(),
                "{name}, seed {seed}"
            );
        }
    }
}
