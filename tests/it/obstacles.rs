//! What planners in three dimensions get of a whole run: ellipsoids, voxels, a coloured mesh.

use std::collections::HashSet;

use glam::{DVec2, DVec3, IVec2, IVec3};

use crate::grid::{exact, messages, recorded, take};
use crate::localise::run;
use splat_mapper::formats::planner_map;
use splat_msgs::ellipsoid_message::EllipsoidArray;
use splat_msgs::ros;
use splat_msgs::ros::navigation::OccupancyGrid;
use splat_msgs::ros::standard::PointCloud2;
use splat_slam::mapper::map_file::checkpoint;
use splat_volume::blocks::SIDE;
use splat_volume::ellipsoids::Ellipsoid;
use splat_volume::grid::{Grid, UNKNOWN};
use splat_volume::params::GridParams;
use splat_volume::voxels::{State, Voxels};

fn vector(values: &[f32], ix: usize) -> DVec3 {
    DVec3::new(
        f64::from(values[3 * ix]),
        f64::from(values[3 * ix + 1]),
        f64::from(values[3 * ix + 2]),
    )
}

fn ellipsoid(array: &EllipsoidArray, ix: usize) -> Ellipsoid {
    let [x, y, z, w] = [0, 1, 2, 3].map(|k| f64::from(array.rotations[4 * ix + k]));
    Ellipsoid {
        splat_id: array.ids[ix],
        mean: vector(&array.means, ix),
        rotation: glam::DQuat::from_xyzw(x, y, z, w).normalize(),
        semi_axes: vector(&array.semi_axes, ix),
        opacity: f64::from(array.opacities[ix]),
        observations: array.observations[ix],
        last_keyframe: array.last_keyframes[ix],
        position_sigma: f64::from(array.position_sigmas[ix]),
    }
}

/// Middles of surface voxels.
fn surface(voxels: &Voxels) -> Vec<DVec3> {
    let mut found = Vec::new();
    for block in voxels.indices() {
        let view = voxels.block(block).unwrap();
        for (x, y) in (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| (x, y))) {
            let states = view.states(x, y).into_iter();
            let surface = states.enumerate().filter(|(_, s)| *s == State::Surface);
            let at = |(z, _)| block * SIDE + IVec3::new(x, y, z as i32);
            found.extend(surface.map(at).map(|v| (v.as_dvec3() + 0.5) * voxels.size));
        }
    }
    found
}

#[test]
fn ellipsoids_and_voxels_of_a_room_are_where_the_room_is() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sent) = (folder.path().join("out"), folder.path().join("sent.mcap"));
    recorded("ground_truth", &out, &sent, &["map.steps=150"]);
    let array = messages(&sent, "ellipsoids").pop().unwrap();
    let array: EllipsoidArray = ros::decode(&array).unwrap();
    let n = array.ids.len();
    assert!(n > 3000 && array.ids.is_sorted(), "{n} ellipsoids");
    assert_eq!((array.means.len(), array.semi_axes.len()), (3 * n, 3 * n));
    assert_eq!(array.rotations.len(), 4 * n);
    assert!(array.opacities.iter().all(|o| *o >= array.min_opacity));
    let least = array.observations.iter().min().unwrap();
    assert!(*least >= array.min_observations);
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    let exact = exact(&map, &take());
    let truth = planner_map::volume(&exact, &GridParams::default()).unwrap();
    let truth = truth.voxels();
    // No ellipsoid's middle is in free space, farther from all surfaces than two voxels.
    let floating = (0..n).filter(|ix| {
        let at = (vector(&array.means, *ix) / truth.size).floor().as_ivec3();
        let distance = truth.voxel(at).distance(truth.truncation);
        distance.is_some_and(|metres| metres > 2.0 * truth.size)
    });
    let floating = floating.count();
    assert!(floating * 200 <= n, "{floating} of {n} float");
    // Surfaces lie within an ellipsoid, or a voxel beside one.
    let cell = |p: DVec3| (p / 0.25).floor().as_ivec3();
    let mut near: std::collections::HashMap<IVec3, Vec<Ellipsoid>> =
        std::collections::HashMap::new();
    for ix in 0..n {
        let ellipsoid = ellipsoid(&array, ix);
        let reach = ellipsoid.semi_axes.max_element().min(1.0) + truth.size;
        let (low, high) = (cell(ellipsoid.mean - reach), cell(ellipsoid.mean + reach));
        for x in low.x..=high.x {
            for y in low.y..=high.y {
                for z in low.z..=high.z {
                    let all = near.entry(IVec3::new(x, y, z)).or_default();
                    all.push(ellipsoid.clone());
                }
            }
        }
    }
    let surface = surface(truth);
    let middle = (DVec3::from_array(array.low.map(f64::from))
        + DVec3::from_array(array.high.map(f64::from)))
        / 2.0;
    let complete = f64::from(array.complete_within) - 0.3;
    assert!(array.n_left_out > 0 && complete > 1.0, "{complete} m");
    let near_surface: Vec<DVec3> = surface
        .iter()
        .copied()
        .filter(|p| p.distance(middle) < complete)
        .collect();
    let is_met = |p: &&DVec3| {
        let near = near.get(&cell(**p));
        near.is_some_and(|all| all.iter().any(|e| e.distance(**p) <= truth.size))
    };
    let n_met = near_surface.iter().filter(is_met).count();
    // Some were seen once or twice only.
    assert!(
        n_met as f64 >= 0.85 * near_surface.len() as f64,
        "{n_met} of {} voxels of surfaces within {complete} m",
        near_surface.len()
    );
    let cloud = messages(&sent, "voxels").pop().unwrap();
    check_voxels(&ros::decode(&cloud).unwrap(), &surface, truth.size);
}

/// Nearly all lie where a surface is, or beside it.
fn check_voxels(cloud: &PointCloud2, surface: &[DVec3], voxel: f64) {
    assert_eq!(cloud.data.len(), (cloud.width * cloud.point_step) as usize);
    let points: Vec<DVec3> = cloud
        .data
        .chunks_exact(12)
        .map(|c| {
            let value = |k: usize| f32::from_le_bytes(c[4 * k..4 * k + 4].try_into().unwrap());
            DVec3::new(
                f64::from(value(0)),
                f64::from(value(1)),
                f64::from(value(2)),
            )
        })
        .collect();
    let voxel_of = |p: &DVec3| (*p / voxel).floor().as_ivec3();
    let wanted: HashSet<IVec3> = surface.iter().map(voxel_of).collect();
    let is_near = |p: &&DVec3| {
        let at = voxel_of(p);
        (-1..=1).any(|x| {
            (-1..=1).any(|y| (-1..=1).any(|z| wanted.contains(&(at + IVec3::new(x, y, z)))))
        })
    };
    let n_right = points.iter().filter(is_near).count();
    assert!(
        points.len() > 5000 && n_right as f64 >= 0.97 * points.len() as f64,
        "{n_right} of {} voxels",
        points.len()
    );
}

#[test]
fn a_mesh_of_a_saved_map_has_colours_in_both_files() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sent) = (folder.path().join("out"), folder.path().join("sent.mcap"));
    recorded("ground_truth", &out, &sent, &["grid.enabled=false"]);
    let map = out.join("map.splatmap");
    let export = |name: &str| {
        let file = folder.path().join(name);
        let output = run(&["export", map.to_str().unwrap(), file.to_str().unwrap()]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        std::fs::read(file).unwrap()
    };
    let (ply, glb) = (export("a.mesh.ply"), export("a.mesh.glb"));
    let text = String::from_utf8_lossy(&ply[..400]).into_owned();
    assert!(text.contains("property uchar red"), "{text}");
    let n_of = |name: &str| -> usize {
        let line = text.lines().find(|l| l.starts_with(name)).unwrap();
        line.rsplit(' ').next().unwrap().parse().unwrap()
    };
    let (n_vertices, n_faces) = (n_of("element vertex"), n_of("element face"));
    let start = text.find("end_header\n").unwrap() + 11;
    assert_eq!(ply.len(), start + 15 * n_vertices + 13 * n_faces);
    let vertices = ply[start..start + 15 * n_vertices].chunks_exact(15);
    let n_grey = vertices.filter(|v| v[12..] == [128; 3]).count();
    assert!(
        n_grey * 5 < n_vertices,
        "{n_grey} of {n_vertices} without a colour"
    );
    let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap());
    assert_eq!((&glb[..4], word(8) as usize), (&b"glTF"[..], glb.len()));
    let n_json = word(12) as usize;
    let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + n_json]).unwrap();
    let primitive = &json["meshes"][0]["primitives"][0];
    let count = |accessor: &serde_json::Value| {
        let at = accessor.as_u64().unwrap() as usize;
        json["accessors"][at]["count"].as_u64().unwrap() as usize
    };
    assert_eq!(count(&primitive["attributes"]["POSITION"]), n_vertices);
    assert_eq!(count(&primitive["attributes"]["COLOR_0"]), n_vertices);
    assert_eq!(count(&primitive["indices"]), 3 * n_faces);
    assert_eq!(json["materials"][0]["doubleSided"], true);
}

/// Cells that both know: how many, and how many differ from all around them in the other.
fn compared(published: &OccupancyGrid, grid: &Grid) -> (usize, usize) {
    let info = &published.info;
    let first = DVec2::new(info.origin.position.x, info.origin.position.y) / grid.resolution;
    let first = first.round().as_ivec2();
    let (mut n_both, mut n_off) = (0, 0);
    for (at, own) in published.data.iter().enumerate() {
        let (x, y) = (at % info.width as usize, at / info.width as usize);
        let cell = first + IVec2::new(x as i32, y as i32);
        let other = grid.cell(cell);
        if *own == UNKNOWN || other == UNKNOWN {
            continue;
        }
        n_both += 1;
        let around = (-1..=1).flat_map(|x| (-1..=1).map(move |y| IVec2::new(x, y)));
        let is_near = around.map(|d| grid.cell(cell + d)).any(|near| near == *own);
        n_off += usize::from(!is_near);
    }
    (n_both, n_off)
}

#[test]
fn a_saved_map_keeps_the_frame_that_was_published() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sent) = (folder.path().join("out"), folder.path().join("sent.mcap"));
    // By structure from motion, whose first frame with a pose is not its first keyframe.
    recorded("sfm", &out, &sent, &[]);
    let published = |sent: &std::path::Path| {
        let grid = messages(sent, "grid").pop().unwrap();
        ros::decode::<OccupancyGrid>(&grid).unwrap()
    };
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    let frame = map.map_frame.expect("it was published");
    assert!(frame.world_from_cam.translation.length() > 0.01);
    let mut volume = planner_map::volume(&map, &GridParams::default()).unwrap();
    let exported = planner_map::grid_of(&mut volume).unwrap();
    let (n_both, n_off) = compared(&published(&sent), &exported);
    assert!(n_both > 5000 && n_off * 100 < n_both, "{n_off} of {n_both}");
    // A run that goes on from the map speaks of the same places.
    let (again, sent) = (
        folder.path().join("again"),
        folder.path().join("again.mcap"),
    );
    let resume = format!("map.resume={}", out.join("map.splatmap").display());
    recorded("sfm", &again, &sent, &[&resume]);
    let (n_both, n_off) = compared(&published(&sent), &exported);
    assert!(n_both > 5000 && n_off * 100 < n_both, "{n_off} of {n_both}");
    let map = checkpoint::read(&again.join("map.splatmap")).unwrap();
    assert_eq!(map.map_frame, Some(frame));
}
