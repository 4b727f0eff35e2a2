//! Grids of whole runs: what goes out is what Nav2 takes, and what they say of a room is so.

use std::path::Path;
use std::sync::Arc;

use glam::IVec2;

use crate::localise::run;
use splat_mapper::formats::planner_map;
use splat_mapper::node::open_source::open;
use splat_mapper::params::settings::Settings;
use splat_msgs::ros::navigation::{DistanceMapSlice, OccupancyGrid, OccupancyGridUpdate};
use splat_msgs::ros::{self, Header};
use splat_slam::mapper::keyframes::image_codec::Content;
use splat_slam::mapper::map_file::checkpoint::{self, Checkpoint};
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::depth::DepthMap;
use splat_types::frame::Frame;
use splat_types::snapshot::{KeyframePose, Scale};
use splat_volume::grid::{FREE, Grid, OCCUPIED, UNKNOWN};
use splat_volume::params::GridParams;

const SCENE: &str = "synthetic:room?frames=48&width=320&height=240";

pub(crate) fn take() -> Take {
    filmed(SceneKind::Room, 48)
}

pub(crate) fn replayed(input: &str, geometry: &str, out: &Path, more: &[&str]) {
    let mut args = vec!["replay", input, "--geometry", geometry, "--backend", "cpu"];
    args.extend(["--out", out.to_str().unwrap()]);
    args.extend(more);
    let output = run(&args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
}

/// The same of the room, with all that goes out recorded.
pub(crate) fn recorded(geometry: &str, out: &Path, sent: &Path, sets: &[&str]) {
    let record = format!("publish.record={}", sent.display());
    let mut more = vec!["--steps", "10", "--set", &record];
    more.extend(sets.iter().flat_map(|set| ["--set", set]));
    replayed(SCENE, geometry, out, &more);
}

/// Each message of a topic.
pub(crate) fn messages(sent: &Path, topic: &str) -> Vec<Vec<u8>> {
    let bytes = std::fs::read(sent).unwrap();
    let all = mcap::MessageStream::new(&bytes).unwrap();
    all.map(Result::unwrap)
        .filter(|message| message.channel.topic == format!("/splat_mapper/{topic}"))
        .map(|message| message.data.to_vec())
        .collect()
}

fn check_header(header: &Header) {
    assert!(!header.frame_id.is_empty());
    assert!(header.stamp.nanosec < 1_000_000_000);
}

/// What Nav2 1.4's `validateMsg` refuses, and what its static layer warns of or misreads (docs/NAVIGATION.md).
fn check_grid(grid: &OccupancyGrid) {
    check_header(&grid.header);
    let (info, turn) = (&grid.info, &grid.info.origin.orientation);
    assert!(info.resolution >= 1e-6);
    assert!((1..=32767).contains(&info.width) && (1..=32767).contains(&info.height));
    assert_eq!(grid.data.len(), info.width as usize * info.height as usize);
    assert_eq!((turn.x, turn.y, turn.z, turn.w), (0.0, 0.0, 0.0, 1.0));
    for start in [info.origin.position.x, info.origin.position.y] {
        let cells = start / f64::from(info.resolution);
        assert!((cells - cells.round()).abs() < 1e-3, "{cells}");
    }
    let known = [FREE, OCCUPIED, UNKNOWN];
    assert!(grid.data.iter().all(|cell| known.contains(cell)));
}

#[test]
fn what_goes_out_is_what_nav2_takes() {
    let folder = tempfile::tempdir().unwrap();
    let sent = folder.path().join("sent.mcap");
    let every = ["map.snapshot_secs=0.2", "grid.period=0.05"];
    recorded("ground_truth", &folder.path().join("out"), &sent, &every);
    let grids = messages(&sent, "grid");
    let grids: Vec<OccupancyGrid> = grids.iter().map(|m| ros::decode(m).unwrap()).collect();
    assert!(!grids.is_empty());
    grids.iter().for_each(check_grid);
    for pair in grids.windows(2) {
        // It grows in big steps, and never shrinks.
        let [before, after] = pair else {
            unreachable!()
        };
        assert!(after.info.width >= before.info.width && after.info.width % 128 == 0);
    }
    let updates = messages(&sent, "grid_updates");
    for update in &updates {
        let update: OccupancyGridUpdate = ros::decode(update).unwrap();
        check_header(&update.header);
        let last = &grids.last().unwrap().info;
        assert!(update.x >= 0 && update.y >= 0 && update.width > 0 && update.height > 0);
        assert!(update.x as u32 + update.width <= last.width);
        assert!(update.y as u32 + update.height <= last.height);
        let n = update.width as usize * update.height as usize;
        assert_eq!(update.data.len(), n);
    }
    let slices = messages(&sent, "distance_slice");
    let slice: DistanceMapSlice = ros::decode(slices.last().unwrap()).unwrap();
    check_header(&slice.header);
    let n = slice.width as usize * slice.height as usize;
    assert_eq!(slice.data.len(), n);
    let n_known = slice.data.iter().filter(|d| **d != slice.unknown_value);
    assert!(n_known.count() > 5000);
    assert!(slice.data.iter().all(|d| d.is_finite()));
}

#[test]
fn without_a_scale_there_is_no_grid_and_the_status_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let sent = folder.path().join("sent.mcap");
    let out = folder.path().join("out");
    recorded("sfm", &out, &sent, &["scale.source=off"]);
    assert!(messages(&sent, "grid").is_empty() && messages(&sent, "distance_slice").is_empty());
    let status = messages(&sent, "status").pop().unwrap();
    let text = String::from_utf8_lossy(&status);
    assert!(text.contains("no grid: the scale is unknown"), "{text}");
    // The file of the map says the same.
    let map = folder.path().join("out/map.splatmap");
    let yaml = folder.path().join("map.yaml");
    let output = run(&["export", map.to_str().unwrap(), yaml.to_str().unwrap()]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("scale is unknown"));
    assert!(!yaml.exists());
}

/// The same keyframes with other depth, units of the map.
fn with_depth(map: &Checkpoint, depth_of: impl Fn(&KeyframePose) -> DepthMap) -> Checkpoint {
    let mut map = map.clone();
    for view in &mut map.views {
        let mut poses = map.snapshot.poses.iter();
        let pose = poses.find(|p| p.keyframe_id == view.keyframe_id).unwrap();
        let k = pose.intrinsics;
        let (image, _) = view.unpacked((k.width_px, k.height_px)).unwrap();
        view.content = Content::InMemory {
            image: Arc::new(image),
            depth: Arc::new(depth_of(pose)),
        };
    }
    map
}

pub(crate) fn frame_of(take: &Take, pose: &KeyframePose) -> u32 {
    let mut frames = 0..take.settings().n_frames;
    frames.find(|ix| take.stamp(*ix) == pose.stamp).unwrap()
}

/// In metres.
pub(crate) fn exact(map: &Checkpoint, take: &Take) -> Checkpoint {
    with_depth(map, |pose| {
        take.depth(frame_of(take, pose), &pose.intrinsics)
    })
}

/// Of a depth camera, where a frame has it.
fn measured(map: &Checkpoint, frames: &[Frame]) -> Checkpoint {
    let unit = map.snapshot.scale.metres_per_unit.unwrap();
    with_depth(map, |pose| {
        let frame = frames.iter().find(|frame| frame.stamp == pose.stamp);
        let depth = frame.and_then(|frame| frame.sensor_depth.as_deref().cloned());
        let mut depth = depth.unwrap_or_else(DepthMap::none);
        depth.scale(1.0 / unit);
        depth
    })
}

fn grid_of(map: &Checkpoint) -> Grid {
    let mut volume = planner_map::volume(map, &GridParams::default()).unwrap();
    planner_map::grid_of(&mut volume).unwrap()
}

/// Of both grids where both decide.
pub(crate) fn decided<'a>(a: &'a Grid, b: &'a Grid) -> impl Iterator<Item = (IVec2, i8, i8)> + 'a {
    let (first, width) = (a.extent.first, a.extent.width);
    let cells = (0..a.cells.len() as i32).map(move |at| first + IVec2::new(at % width, at / width));
    let both = cells.map(|cell| (cell, a.cell(cell), b.cell(cell)));
    both.filter(|(_, a, b)| *a != UNKNOWN && *b != UNKNOWN)
}

#[test]
fn a_kitchen_from_stereo_is_that_of_a_depth_camera() {
    let Some(scene) = crate::scenes::scene("kitchen7s_rgbd") else {
        return;
    };
    let bag = scene.join("rosbag2");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let input = bag.to_str().unwrap();
    replayed(input, "sfm", &out, &["--max-side", "320", "--steps", "1"]);
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    let source = Settings::shipped().params().unwrap().source;
    let mut source = open(input, &source, 0).unwrap();
    let frames: Vec<Frame> = std::iter::from_fn(|| source.next()).collect();
    let (stereo, sensor) = (grid_of(&map), grid_of(&measured(&map, &frames)));
    let n_decided = decided(&stereo, &sensor).count();
    let agree =
        decided(&stereo, &sensor).filter(|(cell, found, _)| is_near(&sensor, *cell, *found));
    let n_agree = agree.count();
    let is_alike = n_agree as f64 >= 0.95 * n_decided as f64;
    assert!(n_decided > 1000 && is_alike, "{n_agree} of {n_decided}");
}

/// Whether a cell near this one, or itself, has the value.
pub(crate) fn is_near(grid: &Grid, cell: IVec2, value: i8) -> bool {
    (-1..=1).any(|x| (-1..=1).any(|y| grid.cell(cell + IVec2::new(x, y)) == value))
}

#[test]
fn a_grid_from_stereo_is_the_grid_from_exact_depth() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sent) = (folder.path().join("out"), folder.path().join("sent.mcap"));
    recorded("ground_truth", &out, &sent, &["grid.enabled=false"]);
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    let truth = exact(&map, &take());
    for map in [&map, &truth] {
        let volume = planner_map::volume(map, &GridParams::default()).unwrap();
        let ground = volume.ground().unwrap();
        // Above the floor, of the camera where the map frame begins.
        let frame = map.map_frame.unwrap();
        let height = frame.world_from_cam.translation.z;
        assert!(
            (ground.height + height).abs() < 0.02,
            "{ground:?}, {height}"
        );
    }
    let (stereo, wanted) = (grid_of(&map), grid_of(&truth));
    let [mut n_decided, mut n_agree, mut n_free, mut n_wrong] = [0; 4];
    for (cell, found, _) in decided(&stereo, &wanted) {
        n_decided += 1;
        n_agree += i32::from(is_near(&wanted, cell, found));
        if found == FREE {
            n_free += 1;
            n_wrong += i32::from(!is_near(&wanted, cell, FREE));
        }
    }
    assert!(n_decided > 5000 && n_free > 4000);
    assert!(
        f64::from(n_agree) >= 0.99 * f64::from(n_decided),
        "{n_agree} of {n_decided}"
    );
    assert!(
        f64::from(n_wrong) <= 0.005 * f64::from(n_free),
        "{n_wrong} of {n_free}"
    );
}

/// What a camera films that walks through a scene.
pub(crate) fn filmed(scene: SceneKind, n_frames: u32) -> Take {
    let settings = SynthSettings {
        n_frames,
        width_px: 320,
        height_px: 240,
        ..SynthSettings::of(scene)
    };
    Take::new(settings).unwrap()
}

/// A scene by structure from motion and stereo, and the same keyframes with true poses and exact depth; both begin at the first one.
pub(crate) fn beside_truth(
    (kind, name): (SceneKind, &str),
    n_frames: u32,
    sets: &[&str],
) -> (Checkpoint, Checkpoint, Take) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let scene = format!("synthetic:{name}?frames={n_frames}&width=320&height=240");
    let mut more = vec!["--steps", "1"];
    more.extend(sets.iter().flat_map(|set| ["--set", set]));
    replayed(&scene, "sfm", &out, &more);
    let map = checkpoint::read(&out.join("map.splatmap")).unwrap();
    assert_eq!(map.map_frame, None);
    let take = filmed(kind, n_frames);
    let mut truth = exact(&map, &take);
    for pose in &mut truth.snapshot.poses {
        pose.world_from_cam = take.pose(frame_of(&take, pose));
    }
    truth.snapshot.scale = Scale::GIVEN;
    (map, truth, take)
}

/// Walls of four corridors, mapped by the map's own poses and depth, beside those of the true poses and exact depth.
#[test]
fn after_a_loop_there_is_one_wall_and_it_is_where_it_was() {
    let (map, truth, _) = beside_truth((SceneKind::Corridor, "corridor"), 220, &[]);
    let (found, wanted) = (grid_of(&map), grid_of(&truth));
    // Both begin at the first keyframe; what is left is the scale's error and the poses'. A cell counts as met by one beside it.
    let count = |a: &Grid, b: &Grid| {
        let occupied: Vec<IVec2> = decided(a, b)
            .filter(|(_, own, _)| *own == OCCUPIED)
            .map(|(cell, ..)| cell)
            .collect();
        let met = occupied.iter().filter(|cell| is_near(b, **cell, OCCUPIED));
        (met.count(), occupied.len())
    };
    let (met, n_found) = count(&found, &wanted);
    let (known, n_wanted) = count(&wanted, &found);
    assert!(
        n_found > 1500 && met as f64 >= 0.95 * n_found as f64,
        "{met} of {n_found}"
    );
    assert!(
        n_wanted > 1500 && known as f64 >= 0.95 * n_wanted as f64,
        "{known} of {n_wanted}"
    );
}
