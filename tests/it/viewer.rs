//! The viewer's server: clients hold what was published, whatever they do, and nobody is held up by them.

use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use crate::deltas::{next, whole};
use crate::formats::{Dice, random_snapshot};
use crate::view_client::ViewClient;
use splat_mapper::view::followed::FollowedMap;
use splat_msgs::correction_message;
use splat_msgs::map_messages::payload;
use splat_msgs::ros::navigation::{OccupancyGrid, OccupancyGridUpdate};
use splat_msgs::ros::odometry::PoseWithCovariance;
use splat_msgs::ros::standard::{self, PoseWithCovarianceStamped};
use splat_msgs::ros::{Header, PoseStamped, TfMessage, TransformStamped};
use splat_msgs::type_hash::dds_type_name;
use splat_ros::odometry::forward_camera;
use splat_ros::params::PublishParams;
use splat_ros::transport::{Event, Transport};
use splat_types::correction::{MapCorrection, Reason};
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::time::Stopwatch;
use splat_types::transform::{Rigid, Similarity};
use splat_view::record;
use splat_view::settings::{Tls, ViewSettings};
use splat_view::transport::ViewTransport;

pub fn settings() -> ViewSettings {
    ViewSettings {
        address: "127.0.0.1:0".parse().unwrap(),
        may_take_another_port: false,
        token: None,
        tls: Tls::Off,
        max_clients: 8,
        sh_degree: 1,
        source: "live",
        title: "test".to_owned(),
        map_frame: "map".to_owned(),
    }
}

pub fn started() -> ViewTransport {
    ViewTransport::start(&settings()).unwrap()
}

pub fn publish(viewer: &ViewTransport, snapshot: &Arc<Snapshot>) {
    viewer.observe(&Event::Map {
        snapshot,
        map_from_world: Similarity::IDENTITY,
    });
}

/// A server with a map, and a client that holds it.
pub fn watched(n: usize, n_keyframes: usize) -> (ViewTransport, Arc<Snapshot>, ViewClient) {
    let viewer = started();
    let newest = Arc::new(snapshot(n, n_keyframes, 1));
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    (viewer, newest, client)
}

/// Splats hang on the keyframes in turn.
fn spread(mut snapshot: Snapshot) -> Snapshot {
    let mut splats = (*snapshot.splats).clone();
    let keyframes = snapshot.poses.iter().map(|pose| pose.keyframe_id);
    let keyframes: Vec<u32> = keyframes.collect();
    let of = |id: &u32| keyframes[*id as usize % keyframes.len()];
    splats.anchors = snapshot.splat_ids.iter().map(of).collect();
    snapshot.splats = Arc::new(splats);
    snapshot
}

pub fn snapshot(n: usize, n_keyframes: usize, seed: u32) -> Snapshot {
    spread(random_snapshot(n, n_keyframes, 1, seed))
}

pub fn holds(client: &ViewClient, snapshot: &Snapshot) {
    assert_eq!(client.map["revision"], json!(snapshot.revision));
    assert_eq!(client.ids(), *snapshot.splat_ids);
}

#[test]
fn after_a_thousand_revisions_and_a_break_clients_hold_the_published_map() {
    let mut dice = Dice(3);
    let (viewer, mut newest, mut client) = watched(30_000, 12);
    holds(&client, &newest);
    assert_eq!(client.keyframes.len(), 12);
    assert_eq!(client.welcome["source"], json!("live"));
    for revision in 2..=1000 {
        newest = Arc::new(spread(next(&newest, &mut dice)));
        publish(&viewer, &newest);
        if revision % 10 == 0 {
            client.follow_to(revision);
            holds(&client, &newest);
        }
    }
    // Away for a while, and back: what is the same is not sent again.
    let whole = client
        .chunks
        .values()
        .map(|c| c.splats.len() * 28)
        .sum::<usize>();
    let mut changed = (*newest.splats).clone();
    changed.means[0][0] += 1.0;
    newest = Arc::new(Snapshot {
        revision: 1001,
        splats: Arc::new(changed),
        ..(*newest).clone()
    });
    client.socket.close(None).ok();
    publish(&viewer, &newest);
    let mut client = ViewClient::connect(viewer.url(), Some(client), &json!({}));
    client.follow_to(1001);
    holds(&client, &newest);
    assert!(
        client.n_bytes < whole / 3,
        "{} of {whole} bytes",
        client.n_bytes
    );
    assert!(client.n_bytes > 0);
    // A late joiner gets it all, and little more than it has.
    let mut late = ViewClient::connect(viewer.url(), None, &json!({}));
    late.follow_to(1001);
    assert_eq!(late.chunks, client.chunks);
    assert!(
        late.n_bytes as f64 <= 1.2 * whole as f64,
        "{} of {whole}",
        late.n_bytes
    );
}

#[test]
fn corrections_resets_and_another_map_begin_anew() {
    let (viewer, mut newest, mut client) = watched(2000, 6);
    // A loop: keyframes and splats move.
    let mut moved = (*newest).clone();
    (moved.epoch, moved.revision) = (moved.epoch + 1, 2);
    moved.poses[5].world_from_cam.translation.x += 1.0;
    let mut splats = (*moved.splats).clone();
    splats.means.iter_mut().for_each(|mean| mean[0] += 1.0);
    moved.splats = Arc::new(splats);
    newest = Arc::new(moved);
    publish(&viewer, &newest);
    client.follow_to(2);
    holds(&client, &newest);
    assert_eq!(client.map["epoch"], json!(newest.epoch));
    let x = client.keyframes[&u64::from(newest.poses[5].keyframe_id)][6].as_f64();
    assert_eq!(x, Some(newest.poses[5].world_from_cam.translation.x));
    // Another map, smaller, by a client that was away.
    let mut other = snapshot(500, 2, 9);
    (other.map_id, other.revision) = ([9; 16], 3);
    client.socket.close(None).ok();
    publish(&viewer, &Arc::new(other.clone()));
    let mut client = ViewClient::connect(viewer.url(), Some(client), &json!({}));
    client.follow_to(3);
    holds(&client, &other);
    assert_eq!(client.keyframes.len(), 2);
    // Who says that it holds nothing gets everything.
    client.chunks.clear();
    client.say(&json!({"type": "resync"}));
    client.follow_to(3);
    holds(&client, &other);
}

#[test]
fn a_small_device_gets_what_is_near() {
    let viewer = started();
    let all = Arc::new(snapshot(40_000, 10, 1));
    publish(&viewer, &all);
    let mut client = ViewClient::connect(
        viewer.url(),
        None,
        &json!({"max_splats": 15_000, "sh_degree": 0}),
    );
    client.follow_to(1);
    assert!(
        (1..=15_000).contains(&client.n_splats()),
        "{}",
        client.n_splats()
    );
    assert_eq!(client.map["sh_degree"], json!(0));
    let far = *viewer
        .hub()
        .newest()
        .chunks
        .iter()
        .find(|(key, _)| !client.chunks.contains_key(key))
        .unwrap()
        .0;
    let place = viewer.hub().newest().chunks[&far].origin;
    client.say(&json!({"type": "eye", "position": place}));
    while !client.chunks.contains_key(&far) {
        while !client.take() {}
    }
    assert!(client.n_splats() <= 15_000);
}

#[test]
fn who_never_reads_holds_nobody_up() {
    let viewer = started();
    let mut dice = Dice(5);
    let mut newest = Arc::new(snapshot(20_000, 8, 1));
    publish(&viewer, &newest);
    let deaf: Vec<ViewClient> = (0..3)
        .map(|_| ViewClient::connect(viewer.url(), None, &json!({})))
        .collect();
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    for revision in 2..=60 {
        newest = Arc::new(spread(next(&newest, &mut dice)));
        publish(&viewer, &newest);
        client.follow_to(revision);
    }
    holds(&client, &newest);
    assert_eq!(viewer.hub().n_clients(), 4);
    drop(deaf);
}

#[test]
fn nothing_is_made_while_nobody_looks() {
    let viewer = started();
    publish(&viewer, &Arc::new(snapshot(100, 2, 1)));
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(viewer.hub().newest().version, 0);
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    assert_eq!(viewer.hub().newest().version, 1);
    client.socket.close(None).ok();
    while client.socket.read().is_ok() {}
    let patience = Stopwatch::start();
    while viewer.hub().n_clients() > 0 {
        assert!(patience.secs() < 10.0, "it stays");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_mapper_elsewhere_is_shown_as_its_messages_say() {
    let viewer = started();
    let mut followed = FollowedMap::new(Arc::clone(viewer.hub()), &PublishParams::default());
    assert!(!followed.has_map());
    let mut all = random_snapshot(3000, 6, 1, 1);
    all.scale = Scale::GIVEN;
    for (dds_type, payload) in whole(&all) {
        assert!(!followed.take(&dds_type, &payload));
        followed.take(&dds_type, &payload[..payload.len() / 2]);
        followed.take("no::such::Type_", &payload);
    }
    assert!(followed.has_map());
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    client.follow_to(1);
    holds(&client, &all);
    assert_eq!(client.keyframes.len(), 6);
    // The robot stands a metre ahead of where the map frame begins, its camera looks ahead, too.
    let message = PoseWithCovarianceStamped {
        pose: PoseWithCovariance {
            pose: Rigid::new(glam::DQuat::IDENTITY, glam::DVec3::X).into(),
            ..PoseWithCovariance::default()
        },
        ..PoseWithCovarianceStamped::default()
    };
    let sent = payload(&message).unwrap();
    followed.take(&dds_type_name::<PoseWithCovarianceStamped>(), &sent);
    while client.events.is_empty() {
        client.take();
    }
    let pose = &client.events[0]["pose"];
    let number = |k: usize| pose[k].as_f64().unwrap();
    assert!(
        (number(6) - 1.0).abs() < 1e-9 && number(4).abs() < 1e-9,
        "{pose}"
    );
    assert!((number(3).abs() - 1.0).abs() < 1e-9, "{pose}");
    // Where the splats lie is said behind the pose: it counts for it all the same.
    let transform = TfMessage {
        transforms: vec![TransformStamped {
            header: header("map"),
            child_frame_id: "splat_map".to_owned(),
            transform: Rigid::new(forward_camera().rotation, glam::DVec3::new(0.25, 0.0, 0.0))
                .into(),
        }],
    };
    client.events.clear();
    let sent = payload(&transform).unwrap();
    followed.take(&dds_type_name::<TfMessage>(), &sent);
    while client.events.is_empty() {
        client.take();
    }
    let ahead = client.events[0]["pose"][6].as_f64().unwrap();
    assert!((ahead - 0.75).abs() < 1e-9, "{ahead}");
}

fn header(frame: &str) -> Header {
    Header {
        frame_id: frame.to_owned(),
        ..Header::default()
    }
}

#[test]
fn grids_and_plans_of_a_mapper_elsewhere_are_shown() {
    let viewer = started();
    let mut followed = FollowedMap::new(Arc::clone(viewer.hub()), &PublishParams::default());
    let mut client = ViewClient::connect(viewer.url(), None, &json!({}));
    let mut grid = OccupancyGrid {
        header: header("map_level"),
        data: vec![0; 16],
        ..OccupancyGrid::default()
    };
    (grid.info.resolution, grid.info.width, grid.info.height) = (0.05, 4, 4);
    grid.info.origin.position.z = -1.25;
    let plan = |frame: &str| {
        let pose = PoseStamped {
            header: header(frame),
            pose: Rigid::new(glam::DQuat::IDENTITY, glam::DVec3::new(0.5, 0.25, 0.0)).into(),
        };
        let path = standard::Path {
            header: header(frame),
            poses: vec![pose.clone(), pose],
        };
        payload(&path).unwrap()
    };
    // Nobody knows yet how that frame lies.
    followed.take_plan(&plan("map_level"));
    followed.take(&dds_type_name::<OccupancyGrid>(), &payload(&grid).unwrap());
    let turn = glam::DQuat::from_rotation_x(0.5);
    let transform = TfMessage {
        transforms: vec![TransformStamped {
            header: header("map"),
            child_frame_id: "map_level".to_owned(),
            transform: Rigid::new(turn, glam::DVec3::ZERO).into(),
        }],
    };
    followed.take(&dds_type_name::<TfMessage>(), &payload(&transform).unwrap());
    followed.take(&dds_type_name::<OccupancyGrid>(), &payload(&grid).unwrap());
    followed.take_plan(&plan("elsewhere"));
    followed.take_plan(&plan("map_level"));
    while client.events.len() < 2 {
        client.take();
    }
    assert_eq!(
        (&client.events[0]["type"], &client.events[1]["type"]),
        (&json!("grid"), &json!("path"))
    );
    assert_eq!(client.events[0]["width"], 4);
    let place = &client.events[1]["points"][0];
    let found = glam::DVec3::from_array([0, 1, 2].map(|k| place[k].as_f64().unwrap()));
    // A plan of the plane is drawn just above the ground.
    let wanted = turn * glam::DVec3::new(0.5, 0.25, -1.2);
    assert!((found - wanted).length() < 1e-9, "{found}");
    // An update changes what is drawn.
    let update = OccupancyGridUpdate {
        header: header("map_level"),
        x: 1,
        y: 1,
        width: 1,
        height: 1,
        data: vec![100],
    };
    let before = client.events[0]["png"].clone();
    client.events.clear();
    followed.take(
        &dds_type_name::<OccupancyGridUpdate>(),
        &payload(&update).unwrap(),
    );
    while client.events.is_empty() {
        client.take();
    }
    assert_ne!(client.events[0]["png"], before);
}

#[test]
fn corrections_come_back_from_their_messages() {
    let moved = MapCorrection {
        epoch: 3,
        revision: 9,
        new_world_from_old_world: Similarity {
            scale: 1.5,
            rotation: glam::DQuat::from_rotation_y(0.5),
            translation: glam::DVec3::new(1.0, 2.0, 3.0),
        },
        translation: 0.5,
        rotation_rad: 0.1,
        reason: Reason::Merge,
    };
    let mut shown = random_snapshot(10, 1, 0, 9);
    (shown.epoch, shown.revision) = (3, 9);
    let mut message = correction_message::message(&moved, &shown, "splat_map");
    let back = message.to_correction().unwrap();
    let (new, old) = (
        back.new_world_from_old_world,
        moved.new_world_from_old_world,
    );
    // Rotations are normalised on their way.
    assert!(new.rotation.angle_between(old.rotation) < 1e-12);
    assert_eq!((new.scale, new.translation), (old.scale, old.translation));
    assert_eq!((back.reason, back.epoch), (moved.reason, moved.epoch));
    message.reason = 77;
    assert_eq!(message.to_correction(), None);
    message.reason = 0;
    message.scale = f64::NAN;
    assert_eq!(message.to_correction(), None);
}

#[test]
fn records_hold_splats_within_their_steps() {
    let splats = random_snapshot(500, 2, 3, 4).splats;
    let origin = [0.5, -0.25, 1.0];
    for ix in 0..splats.len() {
        let [w0, w1, w2, w3] = record::record(&splats, ix, origin);
        let byte = |word: u32, k: u32| (word >> (8 * k)) as u8;
        for c in 0..3 {
            let value = 0.5 + SH_C0 * splats.sh[ix * splats.sh_stride() + c as usize];
            let found = f32::from(byte(w0, c)) / 255.0 * 2.0 - 0.5;
            assert!(
                (found - value.clamp(-0.5, 1.5)).abs() < 0.005,
                "{found} {value}"
            );
        }
        let opacity = 1.0 / (1.0 + (-splats.opacity_logits[ix]).exp());
        assert!((f32::from(byte(w0, 3)) / 255.0 - opacity).abs() < 0.003);
        for (k, bits) in [w1 as u16, (w1 >> 16) as u16, w2 as u16]
            .into_iter()
            .enumerate()
        {
            let found = half::f16::from_bits(bits).to_f32() + origin[k];
            let wanted = splats.means[ix][k];
            let step = 1e-3 * (wanted - origin[k]).abs() + 1e-6;
            assert!((found - wanted).abs() < step, "{found} {wanted}");
        }
        for k in 0..3 {
            let found = (f32::from(byte(w3, k)) - 1.0) * 21.0 / 254.0 - 12.0;
            let wanted = splats.log_scales[ix][k as usize].clamp(-12.0, 9.0);
            assert!((found - wanted).abs() < 0.042, "{found} {wanted}");
        }
        assert!(angle_between(&splats, ix, w2, w3) < 0.035, "splat {ix}");
    }
}

/// Between a splat's rotation and that of its record, rad.
fn angle_between(splats: &Splats, ix: usize, w2: u32, w3: u32) -> f32 {
    let at = |k: u32| ((w2 >> k) & 255) as f32 / 255.0 * 2.0 - 1.0;
    let (u, v) = (at(16), at(24));
    let z = 1.0 - u.abs() - v.abs();
    let fold = (-z).max(0.0);
    let axis = glam::Vec3::new(u - fold * u.signum(), v - fold * v.signum(), z).normalize_or_zero();
    let angle = (w3 >> 24) as f32 / 255.0 * std::f32::consts::PI;
    let found = glam::Quat::from_axis_angle(axis, angle);
    let [w, x, y, z] = splats.quats[ix];
    let wanted = glam::Quat::from_xyzw(x, y, z, w).normalize();
    2.0 * found.dot(wanted).abs().min(1.0).acos()
}
