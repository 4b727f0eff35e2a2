//! Every backend's images against the reference's.

use crate::backends::{BACKENDS, Backend, ORDINARY};
use crate::reference::hostile::{KINDS, camera};
use crate::reference::random::{self, Recipe, SMALL, Scene};
use crate::reference::raster::Raster;
use crate::reference::{Params, doubt, render};
use splat_types::rendering::Rendering;

/// Half a step of an 8-bit image: nobody sees less.
const MAX_ERROR: f64 = 2e-3;
/// Of the norm of a parameter array.
const MAX_GRADIENT_ERROR: f64 = 1e-3;
/// A pixel that may change by so much hangs on a decision.
const UNDECIDED: f64 = 1e-3;
/// Expected depth means little where next to nothing was hit.
const MIN_DEPTH_ALPHA: f64 = 0.1;
/// Share of pixels that may hang on a decision which f32 may take otherwise; these are held to bar plus doubt.
const MAX_UNDECIDED: f64 = 0.005;
/// The same where f32 itself is short of digits: covariances of needles, splats some 30 map units away.
const MAX_UNDECIDED_OF: [(&str, f64); 2] = [("needles", 0.2), ("far from the origin", 0.03)];

#[derive(Debug, Default, Clone, Copy)]
struct Tally {
    n_pixels: usize,
    n_undecided: usize,
    /// Over decided pixels: colour and alpha absolute, depth relative.
    worst: [f64; 3],
}

impl Tally {
    fn add(&mut self, other: &Self) {
        self.n_pixels += other.n_pixels;
        self.n_undecided += other.n_undecided;
        for (worst, other) in self.worst.iter_mut().zip(other.worst) {
            *worst = worst.max(other);
        }
    }
}

fn compare(scene: &Scene, rendering: &Rendering, max_error: f64) -> Result<Tally, String> {
    let (params, camera) = (Params::from(&scene.splats), camera(scene));
    let reference = render(&params, &camera, 3);
    let doubts = doubt::doubt(&params, &camera, 3);
    let size = [
        scene.view.intrinsics.width_px,
        scene.view.intrinsics.height_px,
    ];
    let n = reference.alpha.len();
    if [rendering.width_px, rendering.height_px] != size
        || [
            rendering.rgb.len(),
            rendering.alpha.len(),
            rendering.depth.len(),
        ] != [3 * n, n, n]
    {
        return Err(format!(
            "rendering of {}x{} where {size:?} was asked for",
            rendering.width_px, rendering.height_px
        ));
    }
    let mut tally = Tally {
        n_pixels: n,
        ..Tally::default()
    };
    for (pixel, doubt) in doubts.iter().enumerate() {
        let mut errors = [(0.0, 0.0); 5];
        for (channel, error) in errors[..3].iter_mut().enumerate() {
            let at = 3 * pixel + channel;
            *error = (
                (f64::from(rendering.rgb[at]) - reference.rgb[at]).abs(),
                doubt.rgb[channel],
            );
        }
        errors[3] = (
            (f64::from(rendering.alpha[pixel]) - reference.alpha[pixel]).abs(),
            doubt.alpha,
        );
        if reference.alpha[pixel] > MIN_DEPTH_ALPHA {
            let depth = reference.depth(pixel);
            errors[4] = (
                (f64::from(rendering.depth[pixel]) - depth).abs() / depth,
                doubt.depth,
            );
        }
        let is_undecided = errors.iter().any(|&(_, doubt)| doubt > UNDECIDED);
        tally.n_undecided += usize::from(is_undecided);
        for (which, (error, doubt)) in errors.into_iter().enumerate() {
            if error.is_nan() || error > max_error + doubt {
                let (x, y) = (pixel % size[0] as usize, pixel / size[0] as usize);
                let what = ["r", "g", "b", "alpha", "depth"][which];
                return Err(format!(
                    "{what} at {x}, {y} is off by {error:.2e} where {doubt:.1e} is in doubt"
                ));
            }
            if !is_undecided {
                let group = [0, 0, 0, 1, 2][which];
                tally.worst[group] = error.max(tally.worst[group]);
            }
        }
    }
    Ok(tally)
}

/// All kinds of scenes through one backend; says all kinds that fail.
fn check(max_error: f64, mut backend: impl FnMut(&Scene) -> Rendering) -> Result<Tally, String> {
    let (mut total, mut failures) = (Tally::default(), String::new());
    for (name, n, make) in KINDS {
        let mut of_kind = Tally::default();
        for seed in 0..n {
            let scene = make(seed);
            match compare(&scene, &backend(&scene), max_error) {
                Ok(tally) => of_kind.add(&tally),
                Err(reason) => failures += &format!("{name}, seed {seed}: {reason}\n"),
            }
        }
        let limit = MAX_UNDECIDED_OF
            .iter()
            .find(|(of, _)| *of == name)
            .map_or(MAX_UNDECIDED, |&(_, limit)| limit);
        if of_kind.n_undecided as f64 > limit * of_kind.n_pixels as f64 {
            failures += &format!("{name}: too many pixels are undecided: {of_kind:?}\n");
        }
        eprintln!("{name}: {of_kind:?}");
        total.add(&of_kind);
    }
    if failures.is_empty() {
        Ok(total)
    } else {
        Err(failures)
    }
}

/// The reference implementation itself, rounded to f32: the best that a backend can be.
fn rounded_reference(scene: &Scene) -> Rendering {
    rounded(&render(&Params::from(&scene.splats), &camera(scene), 3))
}

fn rounded(raster: &Raster) -> Rendering {
    Rendering {
        width_px: raster.width_px as u32,
        height_px: raster.height_px as u32,
        depth: (0..raster.alpha.len())
            .map(|pixel| raster.depth(pixel) as f32)
            .collect(),
        rgb: raster.rgb.iter().map(|&value| value as f32).collect(),
        alpha: raster.alpha.iter().map(|&value| value as f32).collect(),
    }
}

#[test]
fn every_backends_images_are_the_references() {
    for backend in BACKENDS {
        assert!(backend.image_error <= MAX_ERROR && backend.gradient_error <= MAX_GRADIENT_ERROR);
        let mut engine = (backend.engine)();
        let render = |scene: &Scene| Backend::render(engine.as_mut(), scene);
        if let Err(failures) = check(backend.image_error, render) {
            panic!("{}:\n{failures}", backend.name);
        }
    }
}

#[test]
fn few_pixels_hang_on_a_decision_that_rounding_may_turn() {
    check(1e-6, rounded_reference).unwrap();
    assert_eq!(KINDS.iter().map(|kind| kind.1).sum::<u64>(), 200);
}

/// Every parameter off by up to half a rounding of f32, equal ones by equal amounts, otherwise exact.
fn shaken_reference(scene: &Scene) -> Rendering {
    let mut params = Params::from(&scene.splats);
    let means = params.means.as_flattened_mut().iter_mut();
    let shapes = params
        .log_scales
        .as_flattened_mut()
        .iter_mut()
        .chain(params.quats.as_flattened_mut());
    for value in means.chain(shapes).filter(|value| value.is_finite()) {
        *value *= 1.0 + 6e-8 * (*value * 1e7).sin();
    }
    rounded(&render(&params, &camera(scene), 3))
}

#[test]
fn rounding_of_the_parameters_stays_within_the_doubt() {
    check(MAX_ERROR, shaken_reference).unwrap();
}

/// Two broad splats of different colours before the same pixels, at one depth up to rounding.
fn ambiguous() -> Scene {
    let mut scene = random::scene(
        3,
        &Recipe {
            n_splats: 2,
            opacity_logit: [0.5, 1.0],
            size_px: [6.0, 8.0],
            ..SMALL
        },
    );
    for (ix, pixel) in [[7.0, 7.0], [11.0, 7.0]].into_iter().enumerate() {
        let mean_in_cam = scene.view.intrinsics.ray_in_cam(pixel.into()) * 2.0;
        let mean = scene
            .view
            .cam_from_world
            .inverse()
            .transform_point(mean_in_cam);
        scene.splats.means[ix] = mean.as_vec3().to_array();
    }
    scene
}

#[test]
fn splats_at_all_but_one_depth_are_in_doubt_by_what_their_swap_changes() {
    let scene = ambiguous();
    let camera = camera(&scene);
    let nominal = Params::from(&scene.splats);
    let with_second_nearer_by = |distance: f64| {
        let mut params = nominal.clone();
        for axis in 0..3 {
            params.means[1][axis] -= distance * camera.rotation[(2, axis)];
        }
        render(&params, &camera, 3).rgb
    };
    let (nearer, farther) = (with_second_nearer_by(2e-6), with_second_nearer_by(-2e-6));
    let doubts = doubt::doubt(&nominal, &camera, 3);
    let mut largest = 0.0_f64;
    for (at, (a, b)) in nearer.iter().zip(&farther).enumerate() {
        largest = largest.max((a - b).abs());
        assert!(
            (a - b).abs() <= doubts[at / 3].rgb[at % 3] + 1e-4,
            "{at}: {a} or {b}, {:?}",
            doubts[at / 3]
        );
    }
    assert!(largest > 0.05, "{largest}");
}

#[test]
fn a_splat_at_the_threshold_is_in_doubt_by_all_it_shows() {
    let mut scene = ambiguous();
    // 1/255 up to a few roundings: its middle is drawn or not.
    scene.splats.opacity_logits[1] = -(254.0_f32.ln());
    let (params, camera) = (Params::from(&scene.splats), camera(&scene));
    let mut without = params.clone();
    without.opacity_logits[1] = -10.0;
    let mut with = params.clone();
    with.opacity_logits[1] += 1e-6;
    with.log_scales[1] = [3.0; 3];
    let mut at_threshold = with.clone();
    at_threshold.opacity_logits[1] = params.opacity_logits[1];
    let doubts = doubt::doubt(&at_threshold, &camera, 3);
    let (with, without) = (render(&with, &camera, 3), render(&without, &camera, 3));
    for (pixel, doubt) in doubts.iter().enumerate() {
        let shown = (with.alpha[pixel] - without.alpha[pixel]).abs();
        assert!(shown <= 1.01 * doubt.alpha, "{pixel}: {shown}, {doubt:?}");
    }
    assert!(doubts.iter().any(|doubt| doubt.alpha > 1e-3));
}

#[test]
fn a_image_that_is_off_by_three_thousandths_in_one_pixel_is_refused() {
    let scene = (KINDS[0].2)(7);
    let honest = rounded_reference(&scene);
    compare(&scene, &honest, MAX_ERROR).unwrap();
    let brightest = (0..honest.alpha.len())
        .max_by(|&a, &b| honest.alpha[a].total_cmp(&honest.alpha[b]))
        .unwrap();
    for which in 0..3 {
        let mut wrong = honest.clone();
        match which {
            0 => wrong.rgb[3 * brightest + 1] += 3e-3,
            1 => wrong.alpha[brightest] -= 3e-3,
            _ => wrong.depth[brightest] *= 1.003,
        }
        assert!(compare(&scene, &wrong, MAX_ERROR).is_err(), "{which}");
    }
}

#[test]
fn splats_before_the_near_plane_are_not_drawn() {
    for backend in BACKENDS {
        let scene = random::scene(6, &ORDINARY);
        let to_cam = scene.view.cam_from_world;
        let near = 1.7;
        let is_behind = |mean: &[f32; 3]| {
            let mean = glam::DVec3::from(mean.map(f64::from));
            to_cam.transform_point(mean).z > f64::from(near)
        };
        let keep: Vec<bool> = scene.splats.means.iter().map(is_behind).collect();
        let n_kept = keep.iter().filter(|keeps| **keeps).count();
        assert!(0 < n_kept && n_kept < keep.len());
        let mut engine = (backend.engine)();
        engine.set_near(near);
        let found = Backend::render(&mut *engine, &scene);
        engine.set_near(0.0);
        engine.retain(&keep).unwrap();
        let wanted = engine.render(&scene.view.intrinsics, &to_cam, 3).unwrap();
        assert_eq!(found, wanted, "{}", backend.name);
    }
}
