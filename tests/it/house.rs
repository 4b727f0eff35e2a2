//! Two rooms and a door, mapped by structure from motion and stereo, beside exact depth from true poses.

use std::collections::VecDeque;

use glam::{DVec3, IVec2, IVec3};

use crate::grid::{beside_truth, decided, frame_of, is_near};
use splat_mapper::eval::alignment::align;
use splat_mapper::formats::planner_map;
use splat_ros::odometry::beginning_at;
use splat_synth::settings::SceneKind;
use splat_synth::take::Take;
use splat_types::transform::Rigid;
use splat_volume::field::{Distance, distances};
use splat_volume::grid::{FREE, Grid, OCCUPIED};
use splat_volume::mesh::mesh;
use splat_volume::params::GridParams;
use splat_volume::volume::Volume;

const VOXEL: f64 = 0.05;
/// Of a robot, in cells.
const RADIUS: i32 = 3;

/// Whether a robot of that radius may stand there, by one grid.
fn has_room(grid: &Grid, cell: IVec2) -> bool {
    let reach = -RADIUS..=RADIUS;
    let mut around = reach
        .clone()
        .flat_map(|x| reach.clone().map(move |y| IVec2::new(x, y)));
    around.all(|d| d.length_squared() > RADIUS * RADIUS || grid.cell(cell + d) == FREE)
}

/// Cells that the robot reaches from another one, where `is_open`.
fn reached(grid: &Grid, from: IVec2, is_open: &dyn Fn(IVec2) -> bool) -> Vec<IVec2> {
    let width = grid.extent.width;
    let at = |cell: IVec2| {
        let place = cell - grid.extent.first;
        (place.y * width + place.x) as usize
    };
    let mut is_seen = vec![false; grid.cells.len()];
    let mut found = Vec::new();
    let mut waiting = VecDeque::from([from]);
    while let Some(cell) = waiting.pop_front() {
        if std::mem::replace(&mut is_seen[at(cell)], true) {
            continue;
        }
        found.push(cell);
        let next = [IVec2::X, IVec2::NEG_X, IVec2::Y, IVec2::NEG_Y].map(|d| cell + d);
        waiting.extend(
            next.into_iter()
                .filter(|n| has_room(grid, *n) && is_open(*n)),
        );
    }
    found
}

/// By its own poses and depth, and by true ones; both begin at the first keyframe.
fn volumes() -> (Volume, Volume, Take) {
    let (map, truth, take) = beside_truth((SceneKind::House, "house"), 132, &[]);
    let volume = |map| planner_map::volume(map, &GridParams::default()).unwrap();
    (volume(&map), volume(&truth), take)
}

#[test]
fn two_rooms_are_mapped_and_the_door_between_them_is_a_way() {
    let (mut volume, mut truth, take) = volumes();
    let [found, wanted] = [&mut volume, &mut truth].map(|v| planner_map::grid_of(v).unwrap());
    // What is free is free; what stands there is seen.
    let [mut n_free, mut n_wrong, mut n_occupied, mut n_missed] = [0; 4];
    for (cell, own, other) in decided(&found, &wanted) {
        if own == FREE {
            n_free += 1;
            n_wrong += usize::from(!is_near(&wanted, cell, FREE));
        }
        if other == OCCUPIED {
            n_occupied += 1;
            n_missed += usize::from(!is_near(&found, cell, OCCUPIED));
        }
    }
    assert!(
        n_free > 3500 && n_wrong * 200 <= n_free,
        "{n_wrong} of {n_free}"
    );
    assert!(
        n_occupied > 1000 && n_missed * 100 <= n_occupied,
        "{n_missed} of {n_occupied}"
    );
    // One place in each room.
    let level = truth.in_level(&beginning_at(take.pose(0)).map_from_world(1.0));
    let cell_of = |ix: u32| {
        let place: DVec3 = level.transform_point(take.pose(ix).translation);
        (place / VOXEL).floor().truncate().as_ivec2()
    };
    let nearest = |cell: IVec2| {
        let around = (-10..=10).flat_map(|x| (-10..=10).map(move |y| cell + IVec2::new(x, y)));
        let open = around.filter(|c| has_room(&found, *c));
        open.min_by_key(|c| (*c - cell).length_squared())
            .expect("room for a robot")
    };
    // A round takes twelve seconds and is at the door at its middle.
    let [left, right, door] = [15, 105, 60].map(|ix| nearest(cell_of(ix)));
    let all = reached(&found, left, &|_| true);
    assert!(all.contains(&right), "no way through the door");
    // Where the door is shut there is none: nobody drives through walls.
    let is_open = |cell: IVec2| (cell - door).as_dvec2().length() > 0.75 / VOXEL;
    let shut = reached(&found, left, &is_open);
    assert!(!shut.contains(&right), "a way through the wall");
    surfaces_and_distances(&volume, &truth);
}

fn surfaces_and_distances(volume: &Volume, truth: &Volume) {
    // Vertices of the surface, by how far the true volume says that they are off.
    let vertices = mesh(volume.voxels()).vertices;
    let exact = truth.voxels();
    let mut off: Vec<f64> = vertices
        .iter()
        .filter_map(|v| {
            let at = DVec3::from_array(v.map(f64::from)) / VOXEL;
            exact
                .voxel(at.floor().as_ivec3())
                .distance(exact.truncation)
        })
        .map(f64::abs)
        .collect();
    off.sort_by(f64::total_cmp);
    let median = off[off.len() / 2];
    assert!(off.len() > 10_000 && median <= VOXEL, "{median} m");
    // Distances of points that both know to be free.
    let mut points = Vec::new();
    for block in exact.indices() {
        let at = block * 8 + IVec3::new(3, 5, 4);
        let is_free = |v: &Volume| {
            let distance = v.voxels().voxel(at).distance(v.voxels().truncation);
            distance.is_some_and(|d| d > VOXEL)
        };
        if is_free(volume) && is_free(truth) {
            points.push((at.as_dvec3() + 0.5) * VOXEL);
        }
    }
    // Asked about the same places: each map is a little turned and scaled against the other.
    let poses = |volume: &Volume| -> Vec<Rigid> {
        let places = volume.fused().into_iter().map(|k| k.level_from_cam);
        places
            .map(|p| Rigid::new(p.rotation, p.translation))
            .collect()
    };
    let aligned = align(&poses(truth), &poses(volume)).unwrap();
    let own_from_truth = aligned.reference_from_estimate;
    let places: Vec<DVec3> = points
        .iter()
        .map(|p| own_from_truth.transform_point(*p))
        .collect();
    let own = distances(volume.voxels(), &places, 0.6).unwrap();
    let wanted = distances(truth.voxels(), &points, 0.6).unwrap();
    // What stereo has not measured is missing, not misplaced: the nearest surface must be one that it knows of.
    let is_measured = |point: DVec3, wanted: &Distance| {
        let foot = own_from_truth.transform_point(point - wanted.gradient * wanted.metres);
        let voxel = volume.voxels().voxel((foot / VOXEL).floor().as_ivec3());
        voxel.distance(volume.voxels().truncation).is_some()
    };
    let pairs = own.iter().zip(&wanted).zip(&points);
    let mut errors: Vec<f64> = pairs
        .filter(|((_, wanted), point)| is_measured(**point, wanted))
        .map(|((own, wanted), _)| (own.metres / own_from_truth.scale - wanted.metres).abs())
        .collect();
    errors.sort_by(f64::total_cmp);
    let p95 = errors[errors.len() * 95 / 100];
    assert!(errors.len() > 300 && p95 <= 1.2 * VOXEL, "{p95} m");
}

#[test]
fn a_start_at_the_door_waits_for_the_keyframe_that_decides() {
    // As live: three keyframes at once. Most of what they show is one wall, which two motions explain about equally well; the wrong one put the first
    // keyframes off by half of the path.
    let small = ["select.batch_size=3", "select.batch_overlap=1"];
    let (map, _, take) = beside_truth((SceneKind::House, "house"), 40, &small);
    let poses = &map.snapshot.poses;
    let own: Vec<Rigid> = poses.iter().map(|pose| pose.world_from_cam).collect();
    let wanted: Vec<Rigid> = poses
        .iter()
        .map(|pose| take.pose(frame_of(&take, pose)))
        .collect();
    assert!(own.len() > 20, "{} keyframes", own.len());
    let aligned = align(&own, &wanted).unwrap().reference_from_estimate;
    let off = own.iter().zip(&wanted).map(|(own, wanted)| {
        aligned
            .transform_point(own.translation)
            .distance(wanted.translation)
    });
    let worst = off.fold(0.0, f64::max);
    assert!(worst < 0.03, "{worst} m");
}
