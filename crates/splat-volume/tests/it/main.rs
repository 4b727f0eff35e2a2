//! The volume and its grid in a world of boxes whose geometry is exact.

mod memory;
mod splats;
mod world;

use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3, IVec2, IVec3};

use splat_types::depth::DepthMap;
use splat_types::transform::Similarity;
use splat_volume::distance::{UNKNOWN_DISTANCE, signed_distances};
use splat_volume::field::{FieldError, distances};
use splat_volume::grid::{FREE, Grid, OCCUPIED, UNKNOWN, grid};
use splat_volume::mesh::mesh;
use splat_volume::params::GridParams;
use splat_volume::volume::{KeyframeDepth, Volume};
use splat_volume::voxels::State;
use world::{CAMERA, World, forward};

/// Metres a unit of the map.
const METRES: f64 = 2.5;

fn keyframes(world: &World, poses: &[Similarity]) -> Vec<KeyframeDepth> {
    let keyframe = |(id, pose): (usize, &Similarity)| KeyframeDepth {
        id: id as u32,
        map_from_camera: *pose,
        intrinsics: CAMERA,
        depth: Arc::new(world.depth(pose)),
    };
    poses.iter().enumerate().map(keyframe).collect()
}

/// Round the room at 0.4 m above the floor, looking outwards and across.
fn round() -> Vec<Similarity> {
    (0..60)
        .map(|i| {
            let angle = f64::from(i) * 0.21;
            let eye = DVec3::new(3.0 + 1.2 * angle.cos(), 2.5 + 1.0 * angle.sin(), 0.4);
            let yaw = angle + if i % 2 == 0 { 0.3 } else { 2.6 };
            forward(eye, yaw, -0.12, METRES)
        })
        .collect()
}

fn fused(keyframes: &[KeyframeDepth]) -> Volume {
    let mut volume = Volume::new(&GridParams::default());
    assert_eq!(volume.set_keyframes(keyframes), []);
    assert_eq!(volume.fuse(usize::MAX), (0, vec![]));
    volume
}

fn grid_of(volume: &mut Volume) -> Grid {
    grid(volume, None, IVec2::ZERO).expect("a ground")
}

/// Cells whose middle was seen, and the world's own word on them.
fn cells(grid: &Grid) -> impl Iterator<Item = (IVec2, i8)> + '_ {
    let width = grid.extent.width;
    let place = move |at: usize| IVec2::new(at as i32 % width, at as i32 / width);
    let cells = grid.cells.iter().enumerate();
    cells.map(move |(at, cell)| (grid.extent.first + place(at), *cell))
}

#[test]
fn the_grid_of_a_room_is_the_room() {
    let world = World::room();
    let poses = round();
    let keyframes = keyframes(&world, &poses);
    let mut volume = fused(&keyframes);
    let ground = volume.ground().unwrap();
    assert!(ground.height.abs() < 0.01, "{ground:?}");
    assert_eq!(volume.level_from_map(), DQuat::IDENTITY);
    let grid = grid_of(&mut volume);

    // Free precision: no obstacle within a free cell, and nothing free beyond the walls.
    let [mut n_free, mut n_wrong, mut n_occupied, mut n_ghosts] = [0.0; 4];
    for (cell, found) in cells(&grid) {
        let middle = (cell.as_dvec2() + 0.5) * 0.05;
        match found {
            FREE => {
                n_free += 1.0;
                n_wrong += f64::from(world.is_obstructed(middle, 0.024));
            }
            OCCUPIED => {
                n_occupied += 1.0;
                n_ghosts += f64::from(!world.is_obstructed(middle, 0.09));
            }
            _ => assert_eq!(found, UNKNOWN),
        }
    }
    assert!(n_free > 0.75 * 6.0 * 5.0 / 0.0025, "{n_free} free cells");
    assert!(n_wrong <= 0.005 * n_free, "{n_wrong} of {n_free}");
    assert!(n_ghosts <= 0.01 * n_occupied, "{n_ghosts} of {n_occupied}");

    // Obstacles that two keyframes have seen are there, within a cell.
    let seen = world.seen_obstacles(&poses, 5.0);
    let near = |cell: IVec2| {
        (-1..=1).any(|x| (-1..=1).any(|y| grid.cell(cell + IVec2::new(x, y)) == OCCUPIED))
    };
    let n_found = seen.iter().filter(|cell| near(**cell)).count();
    assert!(seen.len() > 300);
    assert!(
        n_found as f64 >= 0.99 * seen.len() as f64,
        "{n_found} of {}",
        seen.len()
    );

    // Distances, where they are known.
    let distances = signed_distances(&grid, 2.0);
    let mut errors: Vec<f64> = cells(&grid)
        .zip(&distances)
        .filter(|((_, found), distance)| *found == FREE && **distance < 1.9)
        .map(|((cell, _), distance)| {
            let wanted = world.clearance((cell.as_dvec2() + 0.5) * 0.05);
            (f64::from(*distance) - wanted).abs()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    let at_95 = errors[errors.len() * 95 / 100];
    assert!(at_95 <= 0.05, "{at_95}");
    let n_unknown = grid.cells.iter().filter(|c| **c == UNKNOWN).count();
    let marked = distances
        .iter()
        .filter(|d| **d > UNKNOWN_DISTANCE / 2.0)
        .count();
    assert_eq!(n_unknown, marked);
}

#[test]
fn distances_in_space_are_those_to_the_world() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let points: Vec<DVec3> = (0..4000)
        .map(|i| {
            let share = |p: f64| (f64::from(i) * p).fract();
            DVec3::new(
                6.4 * share(0.7548) - 0.2,
                5.4 * share(0.5698) - 0.2,
                1.8 * share(0.4302),
            )
        })
        .collect();
    let found = distances(volume.voxels(), &points, 2.0).unwrap();
    let [mut errors, mut slopes] = [Vec::new(), Vec::new()];
    for (point, found) in points
        .iter()
        .zip(&found)
        .filter(|(_, found)| found.is_known)
    {
        let wanted = world.distance(*point);
        // The nearest surface is one that a keyframe has seen.
        let uphill = DVec3::from_array(
            DVec3::AXES.map(|axis| (world.distance(*point + axis * 1e-4) - wanted) / 1e-4),
        );
        let nearest = *point - uphill * (wanted + 0.01);
        let voxel = volume.voxels().voxel((nearest / 0.05).floor().as_ivec3());
        if !matches!(volume.voxels().state(voxel), State::Surface) {
            continue;
        }
        errors.push((found.metres - wanted.clamp(-2.0, 2.0)).abs());
        // Far from where two surfaces are equally near.
        let ahead = world.distance(*point + found.gradient * 0.1);
        if found.metres > 0.2 && found.metres < 1.5 {
            slopes.push((ahead - wanted) / 0.1);
        }
    }
    errors.sort_by(f64::total_cmp);
    slopes.sort_by(f64::total_cmp);
    assert!(errors.len() > 1000 && slopes.len() > 500);
    let at_95 = errors[errors.len() * 95 / 100];
    assert!(at_95 <= 0.05, "{at_95}");
    // Ridges, where two surfaces are equally near, have less.
    let (median, at_10) = (slopes[slopes.len() / 2], slopes[slopes.len() / 10]);
    assert!(median > 0.95 && at_10 > 0.6, "{median} {at_10}");
    // What is asked of the outside is answered, or refused in words.
    let far = distances(volume.voxels(), &[DVec3::splat(50.0)], 2.0).unwrap()[0];
    assert_eq!(
        (far.metres, far.gradient, far.is_known),
        (2.0, DVec3::ZERO, false)
    );
    let apart = [DVec3::ZERO, DVec3::splat(1e4)];
    let refused = distances(volume.voxels(), &apart, 2.0);
    assert!(matches!(refused, Err(FieldError::TooFarApart { .. })));
    let nowhere = distances(volume.voxels(), &[DVec3::NAN], 2.0);
    assert!(matches!(
        nowhere,
        Err(FieldError::NotFinite { index: 0, .. })
    ));
    assert_eq!(distances(volume.voxels(), &[], 2.0), Ok(vec![]));
}

#[test]
fn surfaces_lie_within_a_voxel() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let mesh = mesh(volume.voxels());
    let mut errors: Vec<f64> = mesh
        .vertices
        .iter()
        .map(|v| world.distance(DVec3::from_array(v.map(f64::from))).abs())
        .collect();
    errors.sort_by(f64::total_cmp);
    let (median, at_95) = (errors[errors.len() / 2], errors[errors.len() * 95 / 100]);
    assert!(errors.len() > 5000 && mesh.triangles.len() > 8000);
    assert!(median <= 0.01 && at_95 <= 0.05, "{median} {at_95}");
    // Faces look into the room: their normals point to the eye's side.
    let mut n_inwards = 0;
    for triangle in &mesh.triangles {
        let [a, b, c] =
            triangle.map(|i| DVec3::from_array(mesh.vertices[i as usize].map(f64::from)));
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let before = world.distance((a + b + c) / 3.0 + normal * 0.03);
        n_inwards += usize::from(before > 0.0);
    }
    assert!(n_inwards as f64 > 0.97 * mesh.triangles.len() as f64);
}

#[test]
fn nothing_that_no_ray_has_crossed_is_free() {
    let world = World::room();
    let poses = [forward(DVec3::new(3.0, 2.5, 0.4), 0.0, -0.1, METRES)];
    let mut volume = fused(&keyframes(&world, &poses));
    let columns = volume.columns();
    let mut n_free = 0;
    for tile in columns.tiles() {
        for (at, column) in columns.tile(tile).unwrap().iter().enumerate() {
            for bit in (0..128).filter(|bit| column.free >> bit & 1 == 1) {
                let cell = tile * 8 + IVec2::new(at as i32 % 8, at as i32 / 8);
                let voxel = IVec3::new(cell.x, cell.y, columns.foot + bit);
                let middle = (voxel.as_dvec3() + 0.5) * 0.05;
                let eye = poses[0].translation;
                let free = world.ray(eye, middle - eye);
                assert!(free > 0.97, "{middle}: the ray ends at {free}");
                n_free += 1;
            }
        }
    }
    assert!(n_free > 10_000);
}

#[test]
fn a_corrected_trajectory_gives_the_volume_of_the_right_one() {
    let world = World::room();
    let poses = round();
    let right = keyframes(&world, &poses);
    let mut wanted = fused(&right);
    // The second half is off by a drift, as before a loop closes.
    let mut wrong = right.clone();
    for keyframe in &mut wrong[30..] {
        keyframe.map_from_camera.translation += DVec3::new(0.4, -0.3, 0.0);
        keyframe.map_from_camera.rotation =
            DQuat::from_rotation_z(0.1) * keyframe.map_from_camera.rotation;
    }
    let mut volume = fused(&wrong);
    let doubled = grid_of(&mut volume);
    assert_eq!(volume.set_keyframes(&right), []);
    // A few at a time.
    while volume.fuse(4).0 > 0 {}
    assert_eq!(volume.voxels().indices(), wanted.voxels().indices());
    for block in wanted.voxels().indices() {
        for i in 0..512 {
            let at = block * 8 + IVec3::new(i % 8, i / 8 % 8, i / 64);
            assert_eq!(volume.voxels().voxel(at), wanted.voxels().voxel(at));
        }
    }
    assert_eq!(grid_of(&mut volume), grid_of(&mut wanted));
    assert_ne!(doubled, grid_of(&mut wanted));
    // Keyframes that are gone leave nothing.
    assert_eq!(volume.set_keyframes(&[]), []);
    assert_eq!(volume.voxels().n_blocks(), 0);
    assert!(volume.columns().tiles().is_empty());
}

#[test]
fn what_has_moved_away_fades() {
    let poses: Vec<Similarity> = (0..10)
        .map(|i| {
            forward(
                DVec3::new(1.5, 2.0 + 0.1 * f64::from(i), 0.4),
                0.0,
                -0.1,
                METRES,
            )
        })
        .collect();
    let mut with = World::room();
    with.add_box(DVec3::new(3.0, 2.2, 0.0), DVec3::new(3.3, 2.8, 1.2));
    let mut all = keyframes(&with, &poses[..4]);
    let before = grid_of(&mut fused(&all));
    let cell = IVec2::new(60, 50);
    assert_eq!(before.cell(cell), OCCUPIED);
    let mut later = keyframes(&World::room(), &poses);
    for keyframe in &mut later {
        keyframe.id += 4;
    }
    all.extend(later);
    let after = grid_of(&mut fused(&all));
    assert_eq!(after.cell(cell), FREE);
}

#[test]
fn a_tilted_map_is_levelled() {
    let world = World::room();
    let tilt = DQuat::from_rotation_x(0.15);
    let mut tilted = keyframes(&world, &round());
    for keyframe in &mut tilted {
        let pose = &mut keyframe.map_from_camera;
        pose.rotation = tilt * pose.rotation;
        pose.translation = tilt * pose.translation;
    }
    let mut volume = fused(&tilted);
    let up = volume.level_from_map() * (tilt * DVec3::Z);
    assert!(up.angle_between(DVec3::Z) < 0.005, "{up}");
    let grid = grid_of(&mut volume);
    let n = |wanted: i8| grid.cells.iter().filter(|c| **c == wanted).count();
    assert!(
        n(FREE) > 9000 && n(OCCUPIED) > 500,
        "{} {}",
        n(FREE),
        n(OCCUPIED)
    );
}

#[test]
fn hostile_keyframes_stay_out() {
    let world = World::room();
    let poses = round();
    let mut all = keyframes(&world, &poses[..20]);
    let good = all.len();
    let mut bad = |change: &dyn Fn(&mut KeyframeDepth)| {
        let mut keyframe = all[0].clone();
        keyframe.id = all.len() as u32 + 100;
        change(&mut keyframe);
        all.push(keyframe);
    };
    bad(&|k| k.map_from_camera.translation.x = f64::NAN);
    bad(&|k| k.map_from_camera.scale = 0.0);
    bad(&|k| k.map_from_camera.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 3.0));
    bad(&|k| k.intrinsics.fx = 0.0);
    bad(&|k| k.map_from_camera.translation = DVec3::splat(1e15));
    bad(&|k| k.depth = Arc::new(DepthMap::none()));
    bad(&|k| {
        let mut depth = (*k.depth).clone();
        depth.depth.fill(f32::NAN);
        k.depth = Arc::new(depth);
    });
    let mut volume = Volume::new(&GridParams::default());
    let faults = volume.set_keyframes(&all);
    assert_eq!(faults.len(), 4, "{faults:?}");
    let (n_left, faults) = volume.fuse(usize::MAX);
    assert_eq!((n_left, faults.len()), (0, 1), "{faults:?}");
    let wanted = fused(&all[..good]);
    assert_eq!(volume.voxels().n_blocks(), wanted.voxels().n_blocks());
    // A kilometre away is far, but no fault; the grid stays bounded.
    let mut away = all[0].clone();
    away.id = 50;
    away.map_from_camera.translation.x += 1000.0;
    let mut with: Vec<KeyframeDepth> = all[..good].to_vec();
    with.push(away);
    let mut volume = fused(&with);
    let grid = grid_of(&mut volume);
    assert!(grid.is_cropped && grid.cells.len() <= 4096 * 4096);
    assert_eq!(grid.cell(IVec2::new(60, 50)), FREE);
}

#[test]
fn beyond_the_budget_old_keyframes_stand_still() {
    let world = World::room();
    let params = GridParams {
        max_mib: 1,
        ..GridParams::default()
    };
    let mut volume = Volume::new(&params);
    let all = keyframes(&world, &round());
    volume.set_keyframes(&all);
    volume.fuse(usize::MAX);
    assert!(volume.n_keyframes() < all.len());
    let n_blocks = volume.voxels().n_blocks();
    // They do not come in again.
    volume.set_keyframes(&all);
    volume.fuse(usize::MAX);
    assert_eq!(volume.voxels().n_blocks(), n_blocks);
}

#[test]
fn states_say_what_a_voxel_is() {
    let world = World::room();
    let volume = fused(&keyframes(&world, &round()));
    let voxels = volume.voxels();
    let state = |p: DVec3| voxels.state(voxels.voxel((p / 0.05).floor().as_ivec3()));
    assert_eq!(state(DVec3::new(3.0, 2.5, 0.6)), State::Free);
    assert_eq!(state(DVec3::new(2.2, 1.4, 0.01)), State::Surface);
    assert_eq!(state(DVec3::new(3.0, 2.5, -0.5)), State::Unknown);
    assert_eq!(state(DVec3::new(5.0, 2.5, 90.0)), State::Unknown);
    let _: DVec2 = world.size();
}

#[test]
fn a_floor_that_few_pixels_show_is_found() {
    // A camera held at eye level in a corridor: walls fill its images, and stereo has measured one pixel of seven of a plain floor.
    let world = World::corridor();
    let poses: Vec<Similarity> = (0..24)
        .map(|i| {
            forward(
                DVec3::new(0.5 + 0.35 * f64::from(i), 0.9, 1.55),
                0.0,
                -0.03,
                METRES,
            )
        })
        .collect();
    let mut keyframes = keyframes(&world, &poses);
    for (keyframe, pose) in keyframes.iter_mut().zip(&poses) {
        let mut depth = world.depth(pose);
        for at in 0..depth.depth.len() {
            let (x, y) = (at as u32 % CAMERA.width_px, at as u32 / CAMERA.width_px);
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let place = CAMERA.ray_in_cam(pixel) * f64::from(depth.depth[at]);
            let is_floor = pose.transform_point(place).z < 0.01;
            if is_floor && at % 7 != 0 {
                depth.confidence[at] = 0.0;
            }
        }
        keyframe.depth = Arc::new(depth);
    }
    let ground = fused(&keyframes).ground().expect("a ground");
    assert!(ground.height.abs() < 0.01, "{ground:?}");
}
