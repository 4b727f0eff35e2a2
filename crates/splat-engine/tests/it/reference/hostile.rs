//! Scenes that no camera ever sees but every backend must survive.

use glam::{DQuat, DVec3};
use rand::RngExt;

use super::Camera;
use super::random::{self, Recipe, SMALL, Scene};
use splat_types::transform::Rigid;

const PLAIN: Recipe = Recipe {
    width_px: 45,
    height_px: 37,
    n_splats: 60,
    size_px: [0.5, 9.0],
    opacity_logit: [-3.0, 4.0],
    ..SMALL
};

/// All kinds of scenes: what makes it special, how many of it, how it is made from a seed.
pub type Kind = (&'static str, u64, fn(u64) -> Scene);

pub const KINDS: [Kind; 19] = [
    ("plain", 44, |seed| {
        random::scene(
            seed,
            &Recipe {
                sh_degree: (seed % 4) as u8,
                ..PLAIN
            },
        )
    }),
    ("tiny image", 12, tiny_image),
    ("wider than a tile row", 6, |seed| {
        random::scene(
            seed,
            &Recipe {
                width_px: 100,
                height_px: 21,
                ..PLAIN
            },
        )
    }),
    ("huge splats", 10, |seed| {
        random::scene(
            seed,
            &Recipe {
                size_px: [30.0, 1e4],
                ..PLAIN
            },
        )
    }),
    ("specks", 10, |seed| {
        random::scene(
            seed,
            &Recipe {
                size_px: [1e-6, 0.1],
                ..PLAIN
            },
        )
    }),
    ("needles", 12, needles),
    ("at the near plane", 10, at_near_plane),
    ("behind the camera", 8, behind),
    ("not a number", 12, not_a_number),
    ("zero quaternions", 8, zero_quaternions),
    ("extreme opacities", 10, extreme_opacities),
    ("absurd colours", 6, absurd_colours),
    ("no splats", 3, |seed| {
        random::scene(
            seed,
            &Recipe {
                n_splats: 0,
                ..PLAIN
            },
        )
    }),
    ("many overlapping", 6, many_overlapping),
    ("one depth", 8, one_depth),
    ("copies of one splat", 5, copies),
    ("far from the origin", 10, far_from_origin),
    ("principal point outside", 10, principal_point_outside),
    ("wide angle", 10, wide_angle),
];

fn tiny_image(seed: u64) -> Scene {
    let (width_px, height_px) =
        [(1, 1), (1, 40), (40, 1), (2, 3), (16, 16), (17, 1)][seed as usize % 6];
    random::scene(
        seed,
        &Recipe {
            width_px,
            height_px,
            n_splats: 20,
            ..PLAIN
        },
    )
}

/// One axis some hundred times as long as the others, up to 45 px.
fn needles(seed: u64) -> Scene {
    let mut scene = random::scene(
        seed,
        &Recipe {
            n_splats: 30,
            size_px: [0.03, 0.3],
            ..PLAIN
        },
    );
    let mut rng = random::rng(seed ^ 1);
    for log_scale in &mut scene.splats.log_scales {
        log_scale[rng.random_range(0..3)] += rng.random_range(3.5..5.0);
    }
    scene
}

fn at_near_plane(seed: u64) -> Scene {
    let mut scene = random::scene(
        seed,
        &Recipe {
            depth: [0.0095, 0.03],
            ..PLAIN
        },
    );
    // Some map units from the origin f32 would keep only three digits of such depths.
    let world_from_cam = scene.view.cam_from_world.inverse();
    let turn = if seed.is_multiple_of(2) {
        scene.view.cam_from_world.rotation
    } else {
        DQuat::IDENTITY
    };
    for mean in &mut scene.splats.means {
        *mean = (turn * (DVec3::from(mean.map(f64::from)) - world_from_cam.translation))
            .as_vec3()
            .to_array();
    }
    scene.view.cam_from_world.translation = DVec3::ZERO;
    if seed.is_multiple_of(2) {
        // No rounding, so that all must agree on a splat exactly at the plane.
        scene.view.cam_from_world.rotation = DQuat::IDENTITY;
        scene.splats.means[0] = [0.0, 0.0, 0.01];
    }
    scene
}

fn behind(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let cam_from_world = scene.view.cam_from_world;
    for mean in scene.splats.means.iter_mut().step_by(2) {
        let mirrored = cam_from_world.transform_point(DVec3::from(mean.map(f64::from)))
            * DVec3::new(1.0, 1.0, -1.0);
        *mean = cam_from_world
            .inverse()
            .transform_point(mirrored)
            .as_vec3()
            .to_array();
    }
    // At the very centre of the camera.
    scene.splats.means[1] = cam_from_world.inverse().translation.as_vec3().to_array();
    scene
}

fn not_a_number(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let stride = scene.splats.sh_stride();
    for (ix, poison) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY]
        .into_iter()
        .enumerate()
    {
        scene.splats.means[5 * ix][seed as usize % 3] = poison;
        scene.splats.log_scales[5 * ix + 1][seed as usize % 3] = poison;
        scene.splats.quats[5 * ix + 2][seed as usize % 4] = poison;
        scene.splats.opacity_logits[5 * ix + 3] = poison;
        scene.splats.sh[(5 * ix + 4) * stride + seed as usize % stride] = poison;
    }
    scene
}

fn zero_quaternions(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    for quat in scene.splats.quats.iter_mut().step_by(2) {
        *quat = [0.0; 4];
    }
    scene.splats.quats[1] = scene.splats.quats[1].map(|q| q * 1e6);
    scene.splats.quats[3] = scene.splats.quats[3].map(|q| q * 1e-6);
    scene
}

/// From far below 1/255 to exactly 1 in f32.
fn extreme_opacities(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let logits = [-1e30, -200.0, -5.6, -5.54, -5.53, 5.0, 18.0, 100.0, 1e30];
    for (logit, extreme) in scene
        .splats
        .opacity_logits
        .iter_mut()
        .zip(logits.into_iter().cycle())
    {
        *logit = extreme;
    }
    scene
}

/// Too bright, too dark, and at the end of f32 in a band above 0.
fn absurd_colours(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let stride = scene.splats.sh_stride();
    for (ix, (coefficient, value)) in [(0, 6e4), (0, -6e4), (2, 1e20), (6, f32::MAX), (0, 5.0)]
        .into_iter()
        .enumerate()
    {
        scene.splats.sh[3 * ix * stride + 3 * coefficient] = value;
    }
    scene
}

fn many_overlapping(seed: u64) -> Scene {
    let faint = Recipe {
        opacity_logit: [-5.5, -2.0],
        n_splats: 1500,
        size_px: [5.0, 20.0],
        ..PLAIN
    };
    let dense = Recipe {
        opacity_logit: [0.0, 9.0],
        n_splats: 800,
        size_px: [3.0, 20.0],
        ..PLAIN
    };
    random::scene(
        seed,
        if seed.is_multiple_of(2) {
            &faint
        } else {
            &dense
        },
    )
}

/// All depths are equal as f32, so the index decides.
fn one_depth(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    scene.view.cam_from_world = Rigid::new(DQuat::IDENTITY, DVec3::new(0.25, -0.5, 1.0));
    let mut rng = random::rng(seed ^ 2);
    for mean in &mut scene.splats.means {
        *mean = [
            rng.random_range(-1.5..1.5),
            rng.random_range(-1.0..2.0),
            1.0,
        ];
    }
    scene
        .splats
        .log_scales
        .iter_mut()
        .for_each(|log_scale| *log_scale = [-1.5, -2.0, -2.5]);
    scene
}

/// Same place and shape, other colours and opacities.
fn copies(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let centre = scene.view.intrinsics.ray_in_cam([20.0, 20.0].into()) * 2.0;
    let mean = scene
        .view
        .cam_from_world
        .inverse()
        .transform_point(centre)
        .as_vec3()
        .to_array();
    scene.splats.means.fill(mean);
    scene.splats.log_scales.fill([-1.0, -1.5, -2.0]);
    scene
}

/// f32 keeps some 2e-6 of a map unit there.
fn far_from_origin(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let offset = DVec3::new(30.0, -20.0, 10.0);
    for mean in &mut scene.splats.means {
        *mean = (DVec3::from(mean.map(f64::from)) + offset)
            .as_vec3()
            .to_array();
    }
    scene.view.cam_from_world = scene.view.cam_from_world * Rigid::new(DQuat::IDENTITY, -offset);
    scene
}

fn principal_point_outside(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    let (centred, cam_from_world) = (scene.view.intrinsics, scene.view.cam_from_world);
    scene.view.intrinsics.cx = [-30.0, 80.0][seed as usize % 2];
    scene.view.intrinsics.cy = [90.0, -20.0][seed as usize / 2 % 2];
    // Each splat stays at its pixel.
    for mean in &mut scene.splats.means {
        let in_cam = cam_from_world.transform_point(DVec3::from(mean.map(f64::from)));
        let moved = scene
            .view
            .intrinsics
            .ray_in_cam(centred.project(in_cam).unwrap())
            * in_cam.z;
        *mean = cam_from_world
            .inverse()
            .transform_point(moved)
            .as_vec3()
            .to_array();
    }
    scene
}

/// Some 150 degrees: most splats lie beyond where the Jacobian is held.
fn wide_angle(seed: u64) -> Scene {
    let mut scene = random::scene(seed, &PLAIN);
    scene.view.intrinsics.fx = 6.0;
    scene.view.intrinsics.fy = 5.0;
    for log_scale in &mut scene.splats.log_scales {
        *log_scale = log_scale.map(|l| l + 1.0);
    }
    scene
}

pub fn camera(scene: &Scene) -> Camera {
    Camera::new(&scene.view.intrinsics, &scene.view.cam_from_world)
}
