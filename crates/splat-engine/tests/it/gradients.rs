//! The reference's gradients against central differences.

use crate::reference::differences::{ARRAYS, Problem, flat};
use crate::reference::random::{self, Recipe, SMALL, Scene};
use crate::reference::{Gradients, Target, Weights, loss, project, raster};
use splat_engine::loss_weights::LossWeights;
use splat_engine::settings::DepthMode;

/// No term at all.
const NONE: Weights = Weights {
    l1: 0.0,
    ssim: 0.0,
    depth_mode: DepthMode::InverseDepth,
    ssim_valid: false,
    all_splats: false,
    terms: LossWeights::all(0.0),
};
const L1: Weights = Weights { l1: 1.0, ..NONE };
const SSIM: Weights = Weights { ssim: 1.0, ..NONE };
const VALID_SSIM: Weights = Weights {
    ssim_valid: true,
    ..SSIM
};
const DEPTH: Weights = Weights {
    terms: LossWeights {
        depth_weight: 1.0,
        ..NONE.terms
    },
    ..NONE
};
const PAPER_CODE: Weights = Weights {
    depth_mode: DepthMode::PaperCode,
    ..DEPTH
};
const PAPER_ALPHA: Weights = Weights {
    depth_mode: DepthMode::PaperAlpha,
    ..DEPTH
};
const ALL: Weights = Weights {
    l1: 0.8,
    ssim: 0.2,
    terms: LossWeights {
        depth_weight: 0.3,
        ..LossWeights::all(0.1)
    },
    ..NONE
};

/// A random scene with one splat each that is held at the slope limit, saturated, and dark in one channel.
fn eventful_scene(seed: u64, sh_degree: u8) -> Scene {
    let recipe = Recipe { sh_degree, ..SMALL };
    let mut scene = random::scene(seed, &recipe);
    let intrinsics = scene.view.intrinsics;
    let world_from_cam = scene.view.cam_from_world.inverse();
    let beyond = 1.6 * f64::from(recipe.width_px);
    let far_out = intrinsics.ray_in_cam([beyond, 6.0].into()) * 2.0;
    scene.splats.means[0] = world_from_cam.transform_point(far_out).as_vec3().to_array();
    scene.splats.log_scales[0] = [-0.2, 0.1, -0.5];
    let central = intrinsics.ray_in_cam([9.5, 7.5].into()) * 0.8;
    scene.splats.means[1] = world_from_cam.transform_point(central).as_vec3().to_array();
    scene.splats.log_scales[1] = [-1.8, -1.6, -2.0];
    scene.splats.opacity_logits[1] = 7.0;
    let of_third = 2 * scene.splats.sh_stride();
    scene.splats.sh[of_third] = -3.0;
    scene
}

fn check_terms(sh_degree: u8, seed: u64) {
    let photometric = [
        ("l1", L1),
        ("ssim", SSIM),
        ("whole windows", VALID_SSIM),
        ("all", ALL),
    ];
    let stretched = [
        ("depth as in the paper's code", PAPER_CODE),
        ("depth as in the paper's text", PAPER_ALPHA),
    ];
    let terms = LossWeights::NAMES.iter().enumerate().map(|(ix, name)| {
        let terms = LossWeights::only(ix, 1.0);
        (*name, Weights { terms, ..NONE })
    });
    for (name, weights) in photometric.into_iter().chain(stretched).chain(terms) {
        let problem = Problem::new(eventful_scene(seed, sh_degree), weights, sh_degree);
        let claimed = problem.gradients(&problem.point);
        assert_ne!(
            claimed.loss.total, 0.0,
            "{name} is declared and does nothing"
        );
        if let Err(reason) = problem.check(&claimed) {
            panic!("{name}, degree {sh_degree}, seed {seed}: {reason}");
        }
    }
}

#[test]
fn the_references_gradients_agree_with_central_differences_at_sh_degree_0() {
    (0..4).for_each(|seed| check_terms(0, seed));
}

#[test]
fn the_references_gradients_agree_with_central_differences_at_sh_degree_1() {
    (10..13).for_each(|seed| check_terms(1, seed));
}

#[test]
fn the_references_gradients_agree_with_central_differences_at_sh_degree_2() {
    (20..22).for_each(|seed| check_terms(2, seed));
}

#[test]
fn the_references_gradients_agree_with_central_differences_at_sh_degree_3() {
    (30..32).for_each(|seed| check_terms(3, seed));
}

#[test]
fn bands_above_the_active_degree_are_left_alone() {
    let problem = Problem::new(eventful_scene(40, 3), ALL, 1);
    let claimed = problem.gradients(&problem.point);
    problem.check(&claimed).unwrap();
    let stride = claimed.splats.sh_stride();
    for of_splat in claimed.splats.sh.chunks_exact(stride) {
        assert!(of_splat[12..].iter().all(|&v| v == 0.0));
    }
    assert!(claimed.splats.sh.iter().any(|&v| v != 0.0));
}

#[test]
fn opaque_layers_that_stop_the_ray_have_the_gradients_that_differences_say() {
    let recipe = Recipe {
        n_splats: 14,
        opacity_logit: [2.0, 6.0],
        size_px: [3.0, 8.0],
        sh_degree: 1,
        ..SMALL
    };
    let problem = Problem::new(random::scene(50, &recipe), ALL, 1);
    let claimed = problem.gradients(&problem.point);
    let n_stopped = stopped_pixels(&claimed);
    assert!(n_stopped > 20, "{n_stopped}");
    problem.check(&claimed).unwrap();
}

/// Pixels where a splat that would have counted lies behind the end of the ray.
fn stopped_pixels(gradients: &Gradients) -> usize {
    gradients
        .raster
        .hits
        .iter()
        .filter(|hits| raster::transmittance_behind(hits) < 5e-3)
        .count()
}

#[test]
fn a_sign_turned_anywhere_is_caught() {
    let mut problem = Problem::new(eventful_scene(31, 1), ALL, 1);
    problem.point.exposure = [[0.2, -0.1, 0.05], [0.03, -0.04, 0.02]];
    let honest = problem.gradients(&problem.point);
    problem.check(&honest).unwrap();
    for (array_ix, array) in ARRAYS.into_iter().enumerate() {
        let mut wrong = honest.clone();
        let largest = |values: &[f64]| {
            (0..values.len())
                .max_by(|&a, &b| values[a].abs().total_cmp(&values[b].abs()))
                .unwrap()
        };
        let at = largest(&flat(&honest, array_ix));
        match array {
            "means" => wrong.splats.means[at / 3][at % 3] *= -1.0,
            "log_scales" => wrong.splats.log_scales[at / 3][at % 3] *= -1.0,
            "quats" => wrong.splats.quats[at / 4][at % 4] *= -1.0,
            "opacity_logits" => wrong.splats.opacity_logits[at] *= -1.0,
            "sh" => wrong.splats.sh[at] *= -1.0,
            "exposure" => wrong.exposure[at / 3][at % 3] *= -1.0,
            "log_focal" => wrong.log_focal *= -1.0,
            _ => wrong.pose[at] *= -1.0,
        }
        let verdict = problem.check(&wrong).unwrap_err();
        assert!(verdict.starts_with(&format!("{array}[{at}]")), "{verdict}");
    }
}

#[test]
fn the_scenes_of_these_tests_meet_every_special_case() {
    let mut met = [0; 4];
    for seed in 0..4 {
        let problem = Problem::new(eventful_scene(seed, 0), ALL, 0);
        let camera = problem.camera(&problem.point);
        let projected = project::project(&problem.point.params, &camera, 0);
        let result = problem.gradients(&problem.point);
        let hit = |ix: usize| result.raster.hits.iter().flatten().any(|hit| hit.ix == ix);
        met[0] += usize::from(
            projected
                .iter()
                .enumerate()
                .any(|(ix, s)| s.is_clamped.contains(&true) && hit(ix)),
        );
        met[1] += usize::from(
            result
                .raster
                .hits
                .iter()
                .flatten()
                .any(|hit| hit.is_saturated),
        );
        met[2] += usize::from(
            projected
                .iter()
                .enumerate()
                .any(|(ix, s)| s.is_dark.contains(&true) && hit(ix)),
        );
        met[3] += usize::from(result.loss.depth > 0.0);
    }
    assert!(met.iter().all(|&n| n >= 2), "{met:?}");
}

#[test]
fn weighted_pixels_and_an_exposure_keep_the_gradients_right() {
    for (name, weights) in [("l1", L1), ("ssim", SSIM), ("depth", DEPTH), ("all", ALL)] {
        for seed in 60..62 {
            let mut scene = eventful_scene(seed, 1);
            scene.view.mask = Some(random::mask(seed, &scene.view.image));
            let mut problem = Problem::new(scene, weights, 1);
            problem.point.exposure = [[0.3, -0.2, 0.1], [-0.05, 0.1, 0.02]];
            let claimed = problem.gradients(&problem.point);
            if let Err(reason) = problem.check(&claimed) {
                panic!("{name}, seed {seed}: {reason}");
            }
        }
    }
}

#[test]
fn a_image_of_which_no_pixel_counts_has_no_loss_and_no_gradient() {
    let mut scene = eventful_scene(63, 1);
    let n_pixels = scene.view.image.pixels.len() / 3;
    scene.view.mask = Some(vec![0; n_pixels].into());
    let weights = Weights {
        terms: LossWeights {
            opacity_reg: 0.0,
            scale_reg: 0.0,
            ..ALL.terms
        },
        ..ALL
    };
    let problem = Problem::new(scene, weights, 1);
    let result = problem.gradients(&problem.point);
    assert_eq!(result.loss.total, 0.0);
    for array_ix in 0..ARRAYS.len() {
        assert!(flat(&result, array_ix).iter().all(|&v| v == 0.0));
    }
}

/// The loss as a function of the raster alone, pixel by pixel.
#[test]
fn stretching_sends_gradients_through_the_smallest_and_the_largest_pixel() {
    for (weights, seed) in [
        (PAPER_CODE, 0),
        (PAPER_CODE, 1),
        (PAPER_ALPHA, 2),
        (PAPER_ALPHA, 3),
    ] {
        let problem = Problem::new(eventful_scene(seed, 0), weights, 0);
        let base = problem.gradients(&problem.point);
        let target = Target::new(&problem.scene.view);
        let decisions = &base.loss.depth_decisions;
        let ends = decisions.ends.unwrap();
        for pixel in 0..base.raster.alpha.len() {
            let claimed = [base.loss.v_alpha[pixel], base.loss.v_depth_sum[pixel]];
            for (plane, claimed) in claimed.into_iter().enumerate() {
                // A third of the way to the next decision at most.
                let step = 1e-6_f64.min(0.3 * decisions.margin);
                let [low, high] = [-step, step].map(|by| {
                    let mut raster = base.raster.clone();
                    [&mut raster.alpha, &mut raster.depth_sum][plane][pixel] += by;
                    loss::loss(&raster, &target, &weights).total
                });
                let numeric = (high - low) / (2.0 * step);
                assert!(
                    (claimed - numeric).abs() <= 1e-6 + 1e-5 * numeric.abs(),
                    "seed {seed}, pixel {pixel}, plane {plane}: {claimed:e}, differences say {numeric:e}"
                );
            }
            let is_moved = claimed != [0.0; 2];
            assert!(
                is_moved || !ends.contains(&pixel),
                "seed {seed}, pixel {pixel}"
            );
        }
    }
}
