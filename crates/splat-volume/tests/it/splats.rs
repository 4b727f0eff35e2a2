//! Splats on surfaces, splats that float, and what planners and meshes take of them.

use glam::{DQuat, DVec2, DVec3, IVec3};

use crate::world::{CAMERA, World};
use crate::{METRES, fused, keyframes, round};
use splat_types::splats::splats::Splats;
use splat_types::transform::Similarity;
use splat_volume::ellipsoids::{
    Ellipsoid, K_SIGMA, MIN_OBSERVATIONS, Region, Scene, ellipsoids, keep_nearest,
};
use splat_volume::field::{box_distances, distances};
use splat_volume::mesh::{mesh, mesh_in};
use splat_volume::mesh_colour::colours;
use splat_volume::params::GridParams;
use splat_volume::volume::Volume;

const SH_0: f32 = 0.282_094_8;
const VOXEL: f64 = 0.05;

/// The level frame from one that has `METRES` a unit, turned and moved.
fn level_from_world() -> Similarity {
    Similarity {
        scale: METRES,
        rotation: DQuat::from_rotation_z(0.7) * DQuat::from_rotation_x(-1.2),
        translation: DVec3::new(2.0, -1.0, 0.5),
    }
}

/// In the level frame, metres.
struct Blob {
    mean: DVec3,
    sigmas: DVec3,
    opacity: f64,
}

fn small(mean: DVec3) -> Blob {
    Blob {
        mean,
        sigmas: DVec3::splat(0.02),
        opacity: 0.8,
    }
}

/// Red grows along x, green along y, blue with the height.
fn colour_at(p: DVec3) -> DVec3 {
    p / DVec3::new(6.0, 5.0, 2.5)
}

fn splats(blobs: &[Blob]) -> Splats {
    let world_from_level = level_from_world().inverse();
    let log = |s: f64| (s / METRES).ln() as f32;
    let q = world_from_level.rotation;
    Splats {
        means: blobs
            .iter()
            .map(|b| {
                let mean = world_from_level.transform_point(b.mean);
                mean.as_vec3().to_array()
            })
            .collect(),
        log_scales: blobs.iter().map(|b| b.sigmas.to_array().map(log)).collect(),
        quats: vec![[q.w, q.x, q.y, q.z].map(|v| 1.7 * v as f32); blobs.len()],
        opacity_logits: blobs
            .iter()
            .map(|b| (b.opacity / (1.0 - b.opacity)).ln() as f32)
            .collect(),
        sh: blobs
            .iter()
            .flat_map(|b| {
                let dc = (colour_at(b.mean).as_vec3() - 0.5) / SH_0;
                dc.to_array()
            })
            .collect(),
        sh_degree: 0,
        anchors: vec![0; blobs.len()],
    }
}

/// On the surfaces, as cameras see them: every ninth pixel of every third keyframe.
fn on_surfaces(world: &World) -> Vec<Blob> {
    let mut blobs = Vec::new();
    for pose in round().iter().step_by(3) {
        for row in (4..CAMERA.height_px).step_by(9) {
            for column in (4..CAMERA.width_px).step_by(9) {
                let pixel = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let along = pose.rotation * CAMERA.ray_in_cam(pixel);
                let z = world.ray(pose.translation, along);
                if z < 4.5 {
                    blobs.push(small(pose.translation + along * z));
                }
            }
        }
    }
    blobs
}

fn all() -> Region {
    Region {
        low: DVec3::splat(-10.0),
        high: DVec3::splat(20.0),
    }
}

fn found(volume: &Volume, blobs: &[Blob], region: &Region) -> Vec<Ellipsoid> {
    let keyframes = volume.fused();
    let scene = Scene {
        voxels: volume.voxels(),
        keyframes: &keyframes,
        max_range: GridParams::default().max_range,
    };
    let ids: Vec<u32> = (0..blobs.len() as u32).collect();
    ellipsoids(&scene, &splats(blobs), &ids, &level_from_world(), region)
}

#[test]
fn ellipsoids_hold_the_surfaces_and_nothing_that_floats() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let mut blobs = on_surfaces(&world);
    let n_real = blobs.len();
    // Floaters: farther than a voxel and the agreement of depth from any surface.
    for i in 0..500 {
        let at = |k: i32| f64::from(i * k % 1000) / 1000.0;
        let place = DVec3::new(
            0.3 + 5.4 * at(137),
            0.3 + 4.4 * at(389),
            0.2 + 2.1 * at(613),
        );
        if world.distance(place) > 0.15 {
            blobs.push(small(place));
        }
    }
    let n_floating = blobs.len() - n_real;
    assert!(n_floating > 200, "{n_floating}");
    let found = found(&volume, &blobs, &all());
    let floating = found.iter().filter(|e| e.splat_id as usize >= n_real);
    assert_eq!(floating.count(), 0);
    assert!(
        found.len() as f64 >= 0.97 * n_real as f64,
        "{} of {n_real} splats on surfaces",
        found.len()
    );
    for ellipsoid in &found {
        let blob = &blobs[ellipsoid.splat_id as usize];
        assert!(ellipsoid.mean.distance(blob.mean) < 1e-4);
        assert!(ellipsoid.observations >= MIN_OBSERVATIONS && ellipsoid.last_keyframe < 60);
        assert!(ellipsoid.position_sigma < 0.1, "{ellipsoid:?}");
        let wanted = K_SIGMA * (0.02_f64.powi(2) + ellipsoid.position_sigma.powi(2)).sqrt();
        assert!((ellipsoid.semi_axes - wanted).abs().max_element() < 1e-5);
        assert!((ellipsoid.opacity - 0.8).abs() < 1e-5);
    }
    assert!(found.is_sorted_by_key(|ellipsoid| ellipsoid.splat_id));
}

#[test]
fn what_is_faint_seldom_seen_or_too_long_is_no_obstacle() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    // A place on the far wall that many keyframes see, and one that none does: behind it.
    let wall = DVec3::new(6.0, 2.5, 0.9);
    let wide = |mean: DVec3, sigmas: DVec3| Blob {
        mean,
        sigmas,
        opacity: 0.9,
    };
    let blobs = [
        small(wall),
        Blob {
            opacity: 0.25,
            ..small(wall)
        },
        small(wall + DVec3::X * 0.4),
        // A beam across the room, and a part of the wall as long as that.
        wide(wall, DVec3::new(0.6, 0.01, 0.01)),
        wide(wall, DVec3::new(0.01, 0.6, 0.01)),
    ];
    let all_found = found(&volume, &blobs, &all());
    let ids: Vec<u32> = all_found.iter().map(|e| e.splat_id).collect();
    assert_eq!(ids, [0, 4]);
    let elsewhere = found(&volume, &blobs, &Region::around(wall, 0.1));
    assert_eq!(elsewhere.len(), 2);
    let elsewhere = found(&volume, &blobs, &Region::around(DVec3::ZERO, 0.5));
    assert_eq!(elsewhere, []);
    // Nobody has looked three times: nothing is confirmed.
    let volume = fused(&keyframes(&world, &round()[..2]));
    assert_eq!(found(&volume, &blobs, &all()), []);
    // Numbers that are none.
    let mut broken = splats(&blobs);
    broken.means[0] = [f32::NAN; 3];
    broken.quats[4] = [0.0; 4];
    let volume = fused(&keyframes(&world, &round()));
    let keyframes = volume.fused();
    let scene = Scene {
        voxels: volume.voxels(),
        keyframes: &keyframes,
        max_range: 5.0,
    };
    let ids = [0, 1, 2, 3, 4];
    let found = ellipsoids(&scene, &broken, &ids, &level_from_world(), &all());
    assert!(
        found
            .iter()
            .all(|e| e.rotation.is_finite() && e.splat_id > 0)
    );
}

#[test]
fn the_nearest_are_kept() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let mut ellipsoids = found(&volume, &on_surfaces(&world), &all());
    let place = DVec3::new(5.0, 3.5, 0.5);
    let mut wanted: Vec<f64> = ellipsoids.iter().map(|e| e.mean.distance(place)).collect();
    wanted.sort_by(f64::total_cmp);
    let n = ellipsoids.len();
    let left_out = keep_nearest(&mut ellipsoids, place, 100);
    assert_eq!(left_out.n, n - 100);
    assert!((left_out.from - wanted[100]).abs() < 1e-12);
    let farthest = ellipsoids.iter().map(|e| e.mean.distance(place));
    let farthest = farthest.fold(0.0, f64::max);
    assert!((farthest - wanted[99]).abs() < 1e-12);
    assert!(ellipsoids.is_sorted_by_key(|e| e.splat_id));
    let none = keep_nearest(&mut ellipsoids, place, 100);
    assert_eq!((none.n, none.from), (0, f64::INFINITY));
}

#[test]
fn a_mesh_has_the_colours_of_the_splats() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let whole = mesh(volume.voxels());
    let splats = splats(&on_surfaces(&world));
    let found = colours(&whole, VOXEL, &splats, &level_from_world());
    assert_eq!(found.len(), whole.vertices.len());
    let (mut n_coloured, mut n_off) = (0, 0);
    for (vertex, colour) in whole.vertices.iter().zip(&found) {
        if *colour == [128; 3] {
            continue;
        }
        n_coloured += 1;
        let wanted = 255.0 * colour_at(DVec3::from_array(vertex.map(f64::from)));
        let off = wanted.clamp(DVec3::ZERO, DVec3::splat(255.0))
            - DVec3::from_array(colour.map(f64::from));
        // Splats are up to two decimetres apart.
        n_off += usize::from(off.abs().max_element() > 255.0 * 0.2 / 2.5 + 1.0);
    }
    assert!(n_coloured * 2 > whole.vertices.len(), "{n_coloured}");
    assert!(n_off * 100 < n_coloured, "{n_off} of {n_coloured}");
    let ply = whole.ply(&found);
    assert!(ply.len() > whole.vertices.len() * 15 + whole.triangles.len() * 13);
    // A part is a part of the whole, and holds all vertices within the box.
    let (low, high) = (DVec3::new(4.0, 3.0, 0.0), DVec3::new(6.0, 5.0, 1.0));
    let part = mesh_in(volume.voxels(), low, high);
    let key = |v: &[f32; 3]| v.map(f32::to_bits);
    let known: std::collections::HashSet<_> = whole.vertices.iter().map(key).collect();
    assert!(part.vertices.iter().all(|v| known.contains(&key(v))));
    let within = |v: &&[f32; 3]| {
        let v = DVec3::from_array(v.map(f64::from));
        v.cmpge(low).all() && v.cmple(high).all()
    };
    let n = whole.vertices.iter().filter(within).count();
    assert!(n > 500 && part.vertices.iter().filter(within).count() == n);
    assert!(part.vertices.len() < whole.vertices.len() / 2);
}

#[test]
fn a_box_of_distances_is_that_of_its_points() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let (low, size) = (IVec3::new(90, 60, 4), IVec3::new(7, 5, 9));
    let found = box_distances(volume.voxels(), low, size, 1.5).unwrap();
    let middle = |at: IVec3| ((low + at).as_dvec3() + 0.5) * VOXEL;
    let points = [IVec3::ZERO, IVec3::new(6, 0, 0), IVec3::new(2, 3, 8)].map(middle);
    let wanted = distances(volume.voxels(), &points, 1.5).unwrap();
    for (at, wanted) in [0, 6, (8 * 5 + 3) * 7 + 2].into_iter().zip(wanted) {
        assert_eq!(found[at], wanted);
    }
    assert_eq!(found.len(), 7 * 5 * 9);
}
