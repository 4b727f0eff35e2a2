//! The CPU engine as its callers see it: it learns, it repeats to the bit, it takes hostile splats.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_engine::cpu::engine::CpuEngine;
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::{PoseMode, StepSettings};
use splat_engine::traits::{Renderer as _, SplatBuffers as _, Trainer as _, ViewStore as _};
use splat_engine::view::TrainingView;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

const WIDTH_PX: u32 = 61;
const HEIGHT_PX: u32 = 45;

#[test]
fn steps_lower_the_loss() {
    let truth = random_splats(200, 1);
    let view = photograph(&truth, &side_pose());
    let mut engine = CpuEngine::new();
    engine.append(&disturbed(&truth)).unwrap();
    let view_ix = engine.add_view(view).unwrap();
    let before = mean_loss(&mut engine, view_ix, 10);
    let after = mean_loss(&mut engine, view_ix, 150);
    let end = mean_loss(&mut engine, view_ix, 10);
    assert!(end < 0.5 * before, "loss {before} -> {after} -> {end}");
}

#[test]
fn one_and_two_threads_come_to_the_same_bits() {
    let run = |n_threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(n_threads)
            .build()
            .unwrap();
        pool.install(|| trained(20))
    };
    let (one, again, two) = (run(1), run(1), run(2));
    assert!(one == again, "two runs differ");
    assert!(one == two, "one and two threads differ");
}

#[test]
fn retain_and_append_leave_the_optimiser_of_the_others_alone() {
    let splats = random_splats(60, 2);
    let view = photograph(&random_splats(60, 3), &side_pose());
    // Behind the camera: never visible, so that it changes nothing for the others.
    let mut passengers = random_splats(10, 4);
    passengers.means.iter_mut().for_each(|mean| mean[2] = -5.0);
    let plain = {
        let mut engine = CpuEngine::new();
        engine.append(&splats).unwrap();
        engine.add_view(view.clone()).unwrap();
        (0..6).for_each(|_| engine.step(0, &settings()).unwrap());
        engine.read().unwrap()
    };
    let mut engine = CpuEngine::new();
    engine.append(&passengers).unwrap();
    engine.append(&splats).unwrap();
    engine.add_view(view).unwrap();
    (0..3).for_each(|_| engine.step(0, &settings()).unwrap());
    let keep: Vec<bool> = (0..70).map(|ix| ix >= 10).collect();
    engine.retain(&keep).unwrap();
    engine.append(&passengers).unwrap();
    (0..3).for_each(|_| engine.step(0, &settings()).unwrap());
    engine
        .retain(&(0..70).map(|ix| ix < 60).collect::<Vec<_>>())
        .unwrap();
    assert!(
        engine.read().unwrap() == plain,
        "an update came out differently beside other splats"
    );
}

#[test]
fn hostile_splats_do_no_harm() {
    let bad = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        1e38,
        -1e38,
        1e-38,
        0.0,
    ];
    let mut splats = random_splats(50, 5);
    for &value in &bad {
        for slot in 0..12 {
            let mut one = random_splats(1, 6);
            match slot {
                0..3 => one.means[0][slot] = value,
                3..6 => one.log_scales[0][slot - 3] = value,
                6..10 => one.quats[0][slot - 6] = value,
                10 => one.opacity_logits[0] = value,
                _ => one.sh[5] = value,
            }
            extend(&mut splats, &one);
        }
    }
    let mut special = random_splats(4, 7);
    special.quats[0] = [0.0; 4];
    special.means[1] = [0.0; 3];
    // Covers everything, and a needle across the image.
    special.log_scales[2] = [8.0; 3];
    special.log_scales[3] = [6.0, -12.0, -12.0];
    extend(&mut splats, &special);
    let mut engine = CpuEngine::new();
    engine.append(&splats).unwrap();
    engine
        .add_view(photograph(&random_splats(50, 8), &side_pose()))
        .unwrap();
    (0..5).for_each(|_| engine.step(0, &settings()).unwrap());
    let after = engine.read().unwrap();
    assert!(
        after.means[..50]
            .as_flattened()
            .iter()
            .all(|x| x.is_finite()),
        "bad splats infect good ones"
    );
    let loss = engine.take_stats().unwrap().loss;
    assert!(loss.is_finite(), "{loss}");
    assert!(engine.poses().unwrap()[0].is_finite());
    let Rendering {
        rgb, alpha, depth, ..
    } = engine.render(&intrinsics(), &side_pose(), 3).unwrap();
    assert!(
        rgb.iter()
            .chain(&alpha)
            .chain(&depth)
            .all(|x| x.is_finite())
    );
}

#[test]
fn tiny_images_and_empty_maps_render_black() {
    let one_pixel = Intrinsics {
        width_px: 1,
        height_px: 1,
        cx: 0.5,
        cy: 0.5,
        ..intrinsics()
    };
    let no_pixel = Intrinsics {
        width_px: 0,
        height_px: 0,
        ..intrinsics()
    };
    for (splats, n_lit) in [(Splats::default(), 0), (random_splats(300, 9), 1)] {
        let mut engine = CpuEngine::new();
        engine.append(&splats).unwrap();
        for camera in [one_pixel, no_pixel] {
            let image = RgbImage {
                width_px: camera.width_px,
                height_px: camera.height_px,
                pixels: vec![9; (3 * camera.width_px * camera.height_px) as usize],
            };
            let view = TrainingView {
                image: Arc::new(image),
                intrinsics: camera,
                cam_from_world: Rigid::IDENTITY,
                depth: None,
                mask: None,
            };
            let view_ix = engine.add_view(view).unwrap();
            engine.step(view_ix, &settings()).unwrap();
            let rendering = engine.render(&camera, &Rigid::IDENTITY, 3).unwrap();
            let lit = rendering.alpha.iter().filter(|&&a| a > 0.0).count();
            assert_eq!(lit, n_lit.min(rendering.alpha.len()));
        }
        assert!(engine.take_stats().unwrap().loss.is_finite());
    }
}

#[test]
fn a_pose_finds_back_while_the_splats_are_frozen() {
    let splats = random_splats(300, 10);
    let truth = side_pose();
    let view = photograph(&splats, &truth);
    let off = Rigid::exp(
        DVec3::new(0.03, -0.02, 0.02),
        DVec3::new(0.01, 0.02, -0.015),
    ) * truth;
    let mut engine = CpuEngine::new();
    engine.append(&splats).unwrap();
    engine
        .add_view(TrainingView {
            cam_from_world: off,
            ..view
        })
        .unwrap();
    for step in 0..300 {
        let rate = 2e-3 * 0.985_f32.powi(step);
        let only_pose = StepSettings {
            train_splats: false,
            pose: PoseMode::Direct,
            lr_pose_rotation: rate,
            lr_pose_translation: rate,
            ..settings()
        };
        engine.step(0, &only_pose).unwrap();
    }
    let found = engine.poses().unwrap()[0];
    assert!(
        found.angle_to(&truth) < 0.1 * off.angle_to(&truth),
        "{} of {} rad",
        found.angle_to(&truth),
        off.angle_to(&truth)
    );
    let distance =
        |pose: &Rigid| (pose.inverse().translation - truth.inverse().translation).length();
    assert!(
        distance(&found) < 0.1 * distance(&off),
        "{} of {}",
        distance(&found),
        distance(&off)
    );
    assert!(engine.read().unwrap() == splats, "frozen splats moved");
}

#[test]
fn a_view_that_sees_nothing_changes_nothing() {
    let splats = random_splats(40, 11);
    let view = photograph(&splats, &side_pose());
    let away = Rigid::new(DQuat::from_rotation_y(std::f64::consts::PI), DVec3::ZERO);
    let mut engine = CpuEngine::new();
    engine.append(&splats).unwrap();
    engine
        .add_view(TrainingView {
            cam_from_world: away,
            ..view
        })
        .unwrap();
    engine.step(0, &settings()).unwrap();
    assert!(engine.read().unwrap() == splats);
    assert_eq!(engine.poses().unwrap()[0], away);
}

fn trained(n_steps: usize) -> (Splats, Vec<Rigid>, [u64; 2]) {
    let truth = random_splats(2000, 13);
    let mut engine = CpuEngine::new();
    engine.append(&disturbed(&truth)).unwrap();
    engine.add_view(photograph(&truth, &side_pose())).unwrap();
    (0..n_steps).for_each(|_| engine.step(0, &settings()).unwrap());
    let stats = engine.take_stats().unwrap();
    (
        engine.read().unwrap(),
        engine.poses().unwrap(),
        [stats.loss.to_bits(), stats.ssim.to_bits()],
    )
}

fn mean_loss(engine: &mut CpuEngine, view_ix: usize, n_steps: u64) -> f64 {
    (0..n_steps).for_each(|_| engine.step(view_ix, &settings()).unwrap());
    let stats = engine.take_stats().unwrap();
    assert_eq!(stats.n_steps, n_steps);
    stats.loss
}

fn photograph(splats: &Splats, cam_from_world: &Rigid) -> TrainingView {
    let mut engine = CpuEngine::new();
    engine.append(splats).unwrap();
    let image = engine.render(&intrinsics(), cam_from_world, 3).unwrap();
    let pixels = image
        .rgb
        .iter()
        .map(|c| (255.0 * c).round().clamp(0.0, 255.0) as u8)
        .collect();
    let confidence = image
        .alpha
        .iter()
        .map(|&a| if a > 0.7 { a } else { 0.0 })
        .collect();
    TrainingView {
        image: Arc::new(RgbImage {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            pixels,
        }),
        intrinsics: intrinsics(),
        cam_from_world: *cam_from_world,
        depth: Some(Arc::new(DepthMap {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            depth: image.depth,
            confidence,
        })),
        mask: None,
    }
}

fn intrinsics() -> Intrinsics {
    Intrinsics {
        width_px: WIDTH_PX,
        height_px: HEIGHT_PX,
        fx: 60.0,
        fy: 62.0,
        cx: 30.0,
        cy: 23.0,
    }
}

fn side_pose() -> Rigid {
    Rigid::exp(DVec3::new(0.1, -0.05, 0.2), DVec3::new(0.05, -0.1, 0.08))
}

fn random_splats(n: usize, seed: u64) -> Splats {
    let mut rng = Pcg32::seed_from_u64(seed);
    let mut splats = Splats {
        sh_degree: 3,
        anchors: vec![0; n],
        ..Splats::default()
    };
    for _ in 0..n {
        splats.means.push([
            rng.random_range(-0.8..0.8),
            rng.random_range(-0.6..0.6),
            rng.random_range(0.8..2.5),
        ]);
        splats
            .log_scales
            .push(std::array::from_fn(|_| rng.random_range(-3.2..-1.8)));
        splats
            .quats
            .push(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        splats.opacity_logits.push(rng.random_range(-1.5..3.0));
        splats
            .sh
            .extend((0..48).map(|k| rng.random_range(-1.0..1.0) / (1.0 + k as f32 / 3.0)));
    }
    splats
}

fn disturbed(splats: &Splats) -> Splats {
    let mut rng = Pcg32::seed_from_u64(99);
    let mut splats = splats.clone();
    splats
        .means
        .as_flattened_mut()
        .iter_mut()
        .for_each(|x| *x += rng.random_range(-0.03..0.03));
    splats
        .sh
        .iter_mut()
        .for_each(|x| *x += rng.random_range(-0.1..0.1));
    splats
        .opacity_logits
        .iter_mut()
        .for_each(|x| *x += rng.random_range(-0.5..0.5));
    splats
}

fn extend(splats: &mut Splats, more: &Splats) {
    splats.means.extend(&more.means);
    splats.log_scales.extend(&more.log_scales);
    splats.quats.extend(&more.quats);
    splats.opacity_logits.extend(&more.opacity_logits);
    splats.sh.extend(&more.sh);
    splats.anchors.extend(&more.anchors);
}

fn settings() -> StepSettings {
    StepSettings {
        lr_mean: 2e-3,
        lr_scale: 5e-3,
        lr_quat: 1e-3,
        lr_opacity: 2e-2,
        lr_sh0: 1e-2,
        lr_sh_rest: 5e-4,
        lr_pose_rotation: 1e-5,
        lr_pose_translation: 1e-5,
        ssim_weight: 0.2,
        weights: LossWeights {
            depth_weight: 0.05,
            ..LossWeights::all(0.001)
        },
        sh_degree: 3,
        train_splats: true,
        pose: PoseMode::Direct,
        ..StepSettings::default()
    }
}
