//! Images, calibration and depth over zenoh, with rmw_zenoh's keys -> a map, live.
#![cfg(feature = "zenoh")]

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use crate::over_zenoh::{PATIENCE, client, free_endpoint};
use crate::scenes::scene;
use splat_msgs::type_hash::dds_name;
use splat_synth::record::write_recording;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_types::time::Stopwatch;

const N_FRAMES: usize = 60;
const IMAGES: &str = "/camera/image_raw/compressed";

/// Sends the messages of a recording as they were recorded, up to so many images. Any hash will do.
fn send(session: &Session, bag: &Path, n: usize) {
    let bytes = std::fs::read(bag).unwrap();
    let key = |topic: &str, type_name: &str| format!("0{topic}/{}/RIHS01_00", dds_name(type_name));
    let images = session.declare_publisher(key(IMAGES, "sensor_msgs/msg/CompressedImage"));
    let images = images.wait().unwrap();
    let started = Stopwatch::start();
    while !images.matching_status().wait().unwrap().matching() {
        assert!(started.elapsed() < PATIENCE, "nobody subscribes the images");
        std::thread::sleep(Duration::from_millis(50));
    }
    let (watch, mut first, mut n_images) = (Stopwatch::start(), None, 0);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let at = Duration::from_nanos(message.log_time);
        let due = at.saturating_sub(*first.get_or_insert(at));
        std::thread::sleep(due.saturating_sub(watch.elapsed()));
        let topic = &message.channel.topic;
        if topic.starts_with("/ground_truth") {
            continue;
        }
        let type_name = &message.channel.schema.as_ref().unwrap().name;
        session
            .put(key(topic, type_name), message.data.to_vec())
            // By default zenoh drops at the sender what a busy machine does not take.
            .congestion_control(CongestionControl::Block)
            .wait()
            .unwrap();
        n_images += usize::from(topic == IMAGES);
        if n_images > n {
            break;
        }
    }
}

#[test]
fn a_depth_camera_over_zenoh_is_mapped_in_metres() {
    let Some(scene) = scene("kitchen7s_rgbd") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let endpoint = free_endpoint();
    let session = client(&endpoint, "");
    let mapper = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["run", "--source", "zenoh:/camera/image_raw"])
        .args(["--set", &format!("publish.zenoh_connect={endpoint}")])
        .args(["--set", "publish.scouting=false"])
        .args(["--set", "source.depth_topic=/camera/depth/image_raw"])
        .args(["--set", &format!("source.max_frames={N_FRAMES}")])
        .args(["--set", "map.finish_secs=0", "--out"])
        .arg(folder.path())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    send(&session, &scene.join("rosbag2/rosbag2.mcap"), N_FRAMES);
    let output = mapper.wait_with_output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{log}");
    assert!(log.contains("geometry rgbd"), "{log}");
    let report = std::fs::read(folder.path().join("report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let frames = &report["frames"];
    let received = frames["received"].as_u64().unwrap();
    assert!(received >= N_FRAMES as u64, "{frames}");
    // A busy machine may drop some.
    assert!(frames["without_depth"].as_u64().unwrap() <= 6, "{frames}");
    assert!(
        report["keyframes"]["registered"].as_u64().unwrap() >= 10,
        "{log}"
    );
    assert_eq!(report["scale"]["source"], "depth");
    let metres = report["scale"]["metres_per_unit"].as_f64().unwrap();
    assert!((metres - 1.0).abs() < 0.02, "{metres}");
}

/// One camera and an IMU, which its parameter names: the map is in metres by what the IMU measured.
#[test]
fn an_imu_over_zenoh_gives_the_scale() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("room.mcap");
    let settings = SynthSettings {
        n_frames: 100,
        width_px: 240,
        height_px: 180,
        imu: Some(1.0),
        depth: false,
        ..SynthSettings::of(SceneKind::Room)
    };
    write_recording(&settings, &bag).unwrap();
    let endpoint = free_endpoint();
    let session = client(&endpoint, "");
    let mapper = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["run", "--source", "zenoh:/camera/image_raw"])
        .args(["--set", &format!("publish.zenoh_connect={endpoint}")])
        .args(["--set", "publish.scouting=false"])
        .args(["--set", "source.imu_topic=/imu/data_raw"])
        .args(["--set", "source.max_frames=70"])
        .args(["--set", "map.finish_secs=0", "--out"])
        .arg(folder.path().join("out"))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    send(&session, &bag, 95);
    let output = mapper.wait_with_output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{log}");
    let report = std::fs::read(folder.path().join("out/report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let without = report["frames"]["without_imu"].as_u64().unwrap();
    assert!(without <= 6, "{without} frames without samples: {log}");
    assert_eq!(report["scale"]["source"], "imu", "{log}");
    let [metres, std] = ["metres_per_unit", "std"].map(|of| report["scale"][of].as_f64().unwrap());
    assert!(std < 0.05 * metres, "{metres} +- {std}");
}

#[test]
fn a_topic_without_a_name_is_refused() {
    let output = Command::new(env!("CARGO_BIN_EXE_splat-mapper"))
        .args(["run", "--source", "zenoh:"])
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    assert!(text.contains("zenoh:/camera/image_raw"), "{text}");
}
