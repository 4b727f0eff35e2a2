//! The twin's gradients against central differences, and the backends' against the twin's.

use std::hash::{DefaultHasher, Hash, Hasher};

use glam::DVec3;
use splat_mapper::pose::Rigid;

use crate::reference::random::{self, Recipe, SMALL, Scene};
use crate::reference::{
    Camera, Gradients, Params, Target, Weights, bin, gradients, project, raster,
};

/// Truncation error is about STEP^2 times the third derivative over six, some 1e-8 of the gradient for splats
/// wider than a pixel; rounding is 1e-16 / STEP.
const STEP: f64 = 1e-5;
const MAX_RELATIVE: f64 = 1e-5;
/// Numbers far below the largest of their array are held against this share of it.
const FLOOR: f64 = 1e-3;
/// Share of parameters whose difference may span a jump and is then no derivative.
const MAX_SKIPPED: f64 = 0.03;

const ARRAYS: [&str; 6] = [
    "means",
    "log_scales",
    "quats",
    "opacity_logits",
    "sh",
    "pose",
];

const L1: Weights = Weights {
    l1: 1.0,
    ssim: 0.0,
    depth: 0.0,
    opacity: 0.0,
    scale: 0.0,
};
const SSIM: Weights = Weights {
    l1: 0.0,
    ssim: 1.0,
    depth: 0.0,
    opacity: 0.0,
    scale: 0.0,
};
const DEPTH: Weights = Weights {
    l1: 0.0,
    ssim: 0.0,
    depth: 1.0,
    opacity: 0.0,
    scale: 0.0,
};
const OPACITY: Weights = Weights {
    l1: 0.0,
    ssim: 0.0,
    depth: 0.0,
    opacity: 1.0,
    scale: 0.0,
};
const SCALE: Weights = Weights {
    l1: 0.0,
    ssim: 0.0,
    depth: 0.0,
    opacity: 0.0,
    scale: 1.0,
};
const ALL: Weights = Weights {
    l1: 0.8,
    ssim: 0.2,
    depth: 0.3,
    opacity: 0.1,
    scale: 0.1,
};

/// Where the loss is taken.
#[derive(Clone)]
struct Point {
    params: Params,
    cam_from_map: Rigid,
}

struct Problem {
    point: Point,
    scene: Scene,
    target: Target,
    weights: Weights,
    sh_degree: u8,
}

impl Problem {
    fn new(scene: Scene, weights: Weights, sh_degree: u8) -> Self {
        let point = Point {
            params: Params::from(&scene.splats),
            cam_from_map: scene.view.cam_from_map,
        };
        let target = Target::new(&scene.view);
        Self {
            point,
            scene,
            target,
            weights,
            sh_degree,
        }
    }

    fn gradients(&self, point: &Point) -> Gradients {
        let camera = Camera::new(&self.scene.view.intrinsics, &point.cam_from_map);
        gradients(
            &point.params,
            &camera,
            &self.target,
            &self.weights,
            self.sh_degree,
        )
    }

    /// Everything that is decided and not computed. Between two points with equal decisions the loss is smooth.
    fn decisions(&self, point: &Point, result: &Gradients) -> u64 {
        let camera = Camera::new(&self.scene.view.intrinsics, &point.cam_from_map);
        let projected = project::project(&point.params, &camera, self.sh_degree);
        let mut hasher = DefaultHasher::new();
        bin::order(&projected).hash(&mut hasher);
        for splat in &projected {
            (splat.splat_ix, splat.is_clamped, splat.is_dark).hash(&mut hasher);
        }
        for (pixel, hits) in result.raster.hits.iter().enumerate() {
            for hit in hits {
                (hit.ix, hit.is_saturated).hash(&mut hasher);
            }
            let (wanted, alpha) = (self.target.depth[pixel].0, result.raster.alpha[pixel]);
            (
                alpha > 0.5,
                huber_branch(wanted / result.raster.depth(pixel) - 1.0),
            )
                .hash(&mut hasher);
        }
        for (rendered, wanted) in result.raster.rgb.iter().zip(&self.target.rgb) {
            (rendered > wanted).hash(&mut hasher);
        }
        hasher.finish()
    }

    /// Largest error of each array of `claimed`, relative, or what is wrong.
    fn check(&self, claimed: &Gradients) -> Result<[f64; 6], String> {
        let base = self.decisions(&self.point, &self.gradients(&self.point));
        let (mut n_skipped, mut n_all) = (0, 0);
        let mut worst = [0.0; 6];
        for (array_ix, array) in ARRAYS.into_iter().enumerate() {
            let claimed = flat(claimed, array_ix);
            let numeric: Vec<Option<f64>> = (0..claimed.len())
                .map(|k| {
                    let [low, high] = [-STEP, STEP].map(|h| self.point.moved(array_ix, k, h));
                    let [at_low, at_high] = [&low, &high].map(|point| self.gradients(point));
                    let is_smooth = self.decisions(&low, &at_low) == base
                        && self.decisions(&high, &at_high) == base;
                    is_smooth.then(|| (at_high.loss.total - at_low.loss.total) / (2.0 * STEP))
                })
                .collect();
            n_all += numeric.len();
            n_skipped += numeric.iter().filter(|n| n.is_none()).count();
            let largest = numeric
                .iter()
                .flatten()
                .fold(0.0, |max: f64, n| max.max(n.abs()));
            for (k, (claim, numeric)) in claimed.iter().zip(&numeric).enumerate() {
                let Some(numeric) = numeric else { continue };
                // Rounding of the loss alone moves a vanishing array by so much.
                let error = (claim - numeric).abs() / numeric.abs().max(FLOOR * largest).max(1e-7);
                if error.is_nan() || error > MAX_RELATIVE {
                    return Err(format!(
                        "{array}[{k}]: claimed {claim:e}, differences say {numeric:e}"
                    ));
                }
                worst[array_ix] = error.max(worst[array_ix]);
            }
        }
        if n_skipped as f64 > MAX_SKIPPED * n_all as f64 {
            return Err(format!("{n_skipped} of {n_all} differences span a jump"));
        }
        Ok(worst)
    }
}

fn huber_branch(error: f64) -> i8 {
    if error.abs() <= 0.05 {
        0
    } else {
        error.signum() as i8
    }
}

impl Point {
    fn moved(&self, array_ix: usize, k: usize, by: f64) -> Self {
        let mut moved = self.clone();
        match ARRAYS[array_ix] {
            "means" => moved.params.means[k / 3][k % 3] += by,
            "log_scales" => moved.params.log_scales[k / 3][k % 3] += by,
            "quats" => moved.params.quats[k / 4][k % 4] += by,
            "opacity_logits" => moved.params.opacity_logits[k] += by,
            "sh" => moved.params.sh[k] += by,
            _ => {
                let mut delta = [0.0; 6];
                delta[k] = by;
                let [rho, theta] = [&delta[..3], &delta[3..]].map(DVec3::from_slice);
                moved.cam_from_map = Rigid::exp(rho, theta) * self.cam_from_map;
            }
        }
        moved
    }
}

fn flat(gradients: &Gradients, array_ix: usize) -> Vec<f64> {
    match ARRAYS[array_ix] {
        "means" => gradients.splats.means.concat(),
        "log_scales" => gradients.splats.log_scales.concat(),
        "quats" => gradients.splats.quats.concat(),
        "opacity_logits" => gradients.splats.opacity_logits.clone(),
        "sh" => gradients.splats.sh.clone(),
        _ => gradients.pose.to_vec(),
    }
}

/// A random scene with one splat each that is held at the slope limit, saturated, and dark in one channel.
fn eventful_scene(seed: u64, sh_degree: u8) -> Scene {
    let recipe = Recipe { sh_degree, ..SMALL };
    let mut scene = random::scene(seed, &recipe);
    let intrinsics = scene.view.intrinsics;
    let map_from_cam = scene.view.cam_from_map.inverse();
    let beyond = 1.6 * f64::from(recipe.width_px);
    let far_out = intrinsics.ray_in_cam([beyond, 6.0].into()) * 2.0;
    scene.splats.means[0] = map_from_cam.transform_point(far_out).as_vec3().to_array();
    scene.splats.log_scales[0] = [-0.2, 0.1, -0.5];
    let central = intrinsics.ray_in_cam([9.5, 7.5].into()) * 0.8;
    scene.splats.means[1] = map_from_cam.transform_point(central).as_vec3().to_array();
    scene.splats.log_scales[1] = [-1.8, -1.6, -2.0];
    scene.splats.opacity_logits[1] = 7.0;
    let of_third = 2 * scene.splats.sh_stride();
    scene.splats.sh[of_third] = -3.0;
    scene
}

fn check_terms(sh_degree: u8, seed: u64) {
    for (name, weights) in [
        ("l1", L1),
        ("ssim", SSIM),
        ("depth", DEPTH),
        ("opacity", OPACITY),
        ("scale", SCALE),
        ("all", ALL),
    ] {
        let problem = Problem::new(eventful_scene(seed, sh_degree), weights, sh_degree);
        let claimed = problem.gradients(&problem.point);
        if let Err(reason) = problem.check(&claimed) {
            panic!("{name}, degree {sh_degree}, seed {seed}: {reason}");
        }
    }
}

#[test]
fn the_twins_gradients_agree_with_central_differences_at_sh_degree_0() {
    (0..4).for_each(|seed| check_terms(0, seed));
}

#[test]
fn the_twins_gradients_agree_with_central_differences_at_sh_degree_1() {
    (10..13).for_each(|seed| check_terms(1, seed));
}

#[test]
fn the_twins_gradients_agree_with_central_differences_at_sh_degree_2() {
    (20..22).for_each(|seed| check_terms(2, seed));
}

#[test]
fn the_twins_gradients_agree_with_central_differences_at_sh_degree_3() {
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
    let problem = Problem::new(eventful_scene(31, 1), ALL, 1);
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
        let camera = Camera::new(&problem.scene.view.intrinsics, &problem.point.cam_from_map);
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
