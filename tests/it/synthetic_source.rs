//! The source of synthetic frames, its options, and the recordings written of them.

use std::collections::BTreeMap;

use glam::DVec2;

use crate::synthetic::{colour, median};
use splat_io::frame_source::Source;
use splat_io::params::SourceParams;
use splat_mapper::node::open_source::open;
use splat_mapper::params::settings::Settings;
use splat_msgs::ros::{self, CameraInfo, CompressedImage, PoseStamped, TfMessage};
use splat_synth::record::{truth_tum, write_recording};
use splat_synth::settings::{LensKind, SynthSettings};
use splat_synth::source::SyntheticSource;
use splat_synth::take::Take;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::Stopwatch;

fn source_params() -> SourceParams {
    Settings::shipped().params().unwrap().source
}

#[test]
fn the_source_hands_out_frames_with_truth() {
    let params = SourceParams {
        max_side: 160,
        max_frames: 3,
        ..source_params()
    };
    let mut source = SyntheticSource::open("room", &params, 5).unwrap();
    assert_eq!(source.len_hint(), Some(3));
    let frames: Vec<_> = std::iter::from_fn(|| source.next()).collect();
    assert_eq!(
        (frames.len(), source.counts().received, source.len_hint()),
        (3, 3, Some(0))
    );
    assert!(
        frames
            .windows(2)
            .all(|pair| pair[1].stamp.nanos - pair[0].stamp.nanos == 100_000_000)
    );
    let frame = &frames[2];
    let intrinsics = frame.intrinsics.unwrap();
    assert_eq!(
        (
            frame.image.width_px,
            frame.image.height_px,
            intrinsics.width_px
        ),
        (160, 120, 160)
    );
    assert!(intrinsics.is_plausible());
    let depth = frame.sensor_depth.as_ref().unwrap();
    assert_eq!(
        (depth.width_px, depth.height_px, depth.confidence.len()),
        (80, 60, 4800)
    );
    assert!(
        depth.depth.iter().all(|d| (0.2..8.0).contains(d)),
        "all of the room is near"
    );
    assert!(frame.truth.is_some());
}

#[test]
fn a_rate_changes_when_frames_are_taken_and_not_how_the_camera_moves() {
    let film = |rate: &str| {
        let scene = format!("room?frames=31&width=32&height=24&exposure=0.5{rate}");
        let mut source = SyntheticSource::open(&scene, &source_params(), 3).unwrap();
        std::iter::from_fn(|| source.next()).collect::<Vec<Frame>>()
    };
    let (shipped, ten, fast) = (film(""), film("&rate=10"), film("&rate=30"));
    let is_same = |a: &Frame, b: &Frame| {
        (a.stamp, a.truth, &a.image.pixels) == (b.stamp, b.truth, &b.image.pixels)
    };
    assert!(shipped.iter().zip(&ten).all(|(a, b)| is_same(a, b)));
    // 30 frames later it is one second later, whatever frames lie between.
    assert_eq!(fast[30].stamp, shipped[10].stamp);
    assert_eq!(
        fast[1].stamp.nanos - fast[0].stamp.nanos,
        33_333_333,
        "1/30 s"
    );
    for ix in 0..=10 {
        let (slow, fast) = (&shipped[ix], &fast[3 * ix]);
        let (a, b) = (slow.truth.unwrap(), fast.truth.unwrap());
        assert!(a.translation.distance(b.translation) < 1e-12 && a.angle_to(&b) < 1e-9);
        let pixels = slow.image.pixels.iter().zip(&fast.image.pixels);
        assert!(
            pixels.into_iter().all(|(a, b)| a.abs_diff(*b) <= 1),
            "frame {ix}: motion and exposure by time"
        );
    }
}

#[test]
fn a_rate_is_kept_to_live_alone() {
    let secs = |scene: &str, rate: f64| {
        let params = SourceParams {
            rate,
            ..source_params()
        };
        let mut source = open(&format!("synthetic:{scene}"), &params, 0).unwrap();
        let watch = Stopwatch::start();
        assert_eq!(std::iter::from_fn(|| source.next()).count(), 16);
        watch.secs()
    };
    for scene in [
        "room?frames=16&width=16&height=16&rate=",
        "endless?frames=16&width=16&height=16&rate=",
    ] {
        // The last frame is half a second behind the first.
        let live = secs(&format!("{scene}30"), 1.0);
        assert!(live > 0.499, "{scene}: {live} s");
        // At this rate it would take 15 s, in a replay it takes what drawing takes.
        let replayed = secs(&format!("{scene}1"), 0.0);
        assert!(replayed < 7.0, "{scene}: {replayed} s");
    }
    // Without a rate frames come as soon as they are drawn, live, too: at this speed they would take 15 s.
    let unpaced = secs("room?frames=16&width=16&height=16", 0.1);
    assert!(unpaced < 7.0, "{unpaced} s");
}

#[test]
fn the_source_straightens_lenses_when_asked() {
    let params = SourceParams {
        max_side: 320,
        ..source_params()
    };
    let mut raw = SyntheticSource::open(
        "room?lens=radial",
        &SourceParams {
            rectify: false,
            ..params.clone()
        },
        0,
    )
    .unwrap();
    let raw = raw.next().unwrap();
    assert!(
        raw.intrinsics.is_none() && raw.sensor_depth.is_none(),
        "a distorted image fits no pinhole"
    );
    let undistorted = SyntheticSource::open("room?lens=radial", &params, 0)
        .unwrap()
        .next()
        .unwrap();
    let straight = SyntheticSource::open("room", &params, 0)
        .unwrap()
        .next()
        .unwrap();
    let (from, to) = (
        undistorted.intrinsics.unwrap(),
        straight.intrinsics.unwrap(),
    );
    // Both look from the same place, so a pixel of one is a pixel of the other.
    let difference = |image: &RgbImage| {
        let mut differences = Vec::new();
        for y in (1..239).step_by(3) {
            for x in (1..319).step_by(3) {
                let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                if let Some(there) = to
                    .project(from.ray_in_cam(pixel))
                    .and_then(|at| colour(&straight.image, at))
                {
                    differences.push((colour(image, pixel).unwrap() - there).abs().max_element());
                }
            }
        }
        assert!(differences.len() > 5000);
        median(differences)
    };
    let (after, before) = (difference(&undistorted.image), difference(&raw.image));
    assert!(
        after < 8.0 && after < 0.4 * before,
        "{after} undistorted, {before} raw"
    );
}

#[test]
fn a_wrong_scene_or_option_is_refused_with_what_would_be_right() {
    for (text, hint) in [
        ("rooom", "room, facade, corridor, hallway or house"),
        ("room?frame=3", "frames, width"),
        ("room?frames=0", "[1, 100000]"),
        ("room?frames=1e99", "[1, 100000]"),
        ("room?frames=2.5", "whole number"),
        ("room?width=nan", "[16, 4096]"),
        ("room?fov=120", "unless the lens is fisheye"),
        ("room?lens=zoom", "pinhole, radial or fisheye"),
        ("room?noise=-1", "[0, 64]"),
        ("room?rate=0", "[1, 1000]"),
        ("room?rate=-30", "[1, 1000]"),
        ("room?rate=NaN", "[1, 1000]"),
        ("room?rate=inf", "[1, 1000]"),
        ("room?rate=1e9", "[1, 1000]"),
        ("room?rate=", "[1, 1000]"),
        ("room?seed=-1", "2^64"),
        ("room?depth", "true or false"),
        ("room?=&&?", "unknown option"),
    ] {
        let message = SyntheticSource::open(text, &source_params(), 0)
            .unwrap_err()
            .to_string();
        assert!(message.contains(hint), "{text}: {message}");
    }
    let settings =
        SynthSettings::parse("facade?frames=9&lens=fisheye&fov=120&noise=1.5&depth=false").unwrap();
    assert_eq!(
        (settings.n_frames, settings.lens, settings.fov_deg),
        (9, LensKind::Fisheye, 120.0)
    );
    assert!(!settings.depth);
}

fn by_topic(bytes: &[u8]) -> BTreeMap<String, Vec<(u64, Vec<u8>)>> {
    let mut topics: BTreeMap<String, Vec<(u64, Vec<u8>)>> = BTreeMap::new();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.clone().unwrap();
        assert_eq!(
            (
                schema.encoding.as_str(),
                message.channel.message_encoding.as_str()
            ),
            ("ros2msg", "cdr")
        );
        let key = format!("{} {}", message.channel.topic, schema.name);
        topics
            .entry(key)
            .or_default()
            .push((message.log_time, message.data.to_vec()));
    }
    topics
}

const TOPICS: [&str; 5] = [
    "/camera/camera_info sensor_msgs/msg/CameraInfo",
    "/camera/depth sensor_msgs/msg/Image",
    "/camera/image_raw/compressed sensor_msgs/msg/CompressedImage",
    "/ground_truth/pose geometry_msgs/msg/PoseStamped",
    "/tf tf2_msgs/msg/TFMessage",
];

#[test]
fn a_recording_holds_every_message_with_its_schema() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("small.mcap");
    let settings =
        SynthSettings::parse("room?width=160&height=120&frames=6&lens=fisheye&seed=3").unwrap();
    let summary = write_recording(&settings, &out).unwrap();
    let bytes = std::fs::read(&out).unwrap();
    assert_eq!(
        (summary.n_frames, summary.n_messages, summary.bytes),
        (6, 30, bytes.len() as u64)
    );
    let mut names: Vec<_> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    names.sort();
    assert_eq!(names, ["small.mcap", "small.tum"]);
    let index = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert!(!index.chunk_indexes.is_empty() && index.stats.unwrap().message_count == 30);

    let topics = by_topic(&bytes);
    assert_eq!(
        topics.keys().map(String::as_str).collect::<Vec<_>>(),
        TOPICS
    );
    assert!(topics.values().all(|messages| messages.len() == 6));
    let payload = |n: usize, ix: usize| topics[TOPICS[n]][ix].1.as_slice();
    check_messages(&settings, payload);

    let tum = std::fs::read_to_string(out.with_extension("tum")).unwrap();
    assert_eq!(tum, truth_tum(&settings).unwrap());
    assert_eq!(tum.lines().filter(|line| !line.starts_with('#')).count(), 6);
    assert!(
        tum.lines()
            .nth(1)
            .unwrap()
            .starts_with("1700000000.000000000 ")
    );
}

/// What the fifth message of every topic says.
fn check_messages<'a>(settings: &SynthSettings, payload: impl Fn(usize, usize) -> &'a [u8]) {
    let take = Take::new(settings.clone()).unwrap();
    let lens = settings.lens();
    let info: CameraInfo = ros::decode(payload(0, 0)).unwrap();
    assert_eq!(
        (info.distortion_model.as_str(), info.d.len(), info.k[2]),
        ("equidistant", 4, lens.intrinsics.cx - 0.5)
    );
    let depth: ros::Image = ros::decode(payload(1, 4)).unwrap();
    assert_eq!(
        (
            depth.width,
            depth.height,
            depth.step,
            depth.encoding.as_str()
        ),
        (32, 24, 64, "16UC1")
    );
    let image: CompressedImage = ros::decode(payload(2, 4)).unwrap();
    let decoded = image::load_from_memory(&image.data).unwrap().to_rgb8();
    let filmed = take.image(4);
    let error = decoded
        .as_raw()
        .iter()
        .zip(&filmed.pixels)
        .map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2))
        .sum::<f64>();
    let psnr = 10.0 * (255.0_f64.powi(2) * filmed.pixels.len() as f64 / error).log10();
    assert!(psnr > 25.0, "{psnr} dB");
    let pose: PoseStamped = ros::decode(payload(3, 4)).unwrap();
    let rigid = pose.pose.to_rigid().unwrap();
    assert!(
        rigid.translation.distance(take.pose(4).translation) < 1e-12
            && rigid.angle_to(&take.pose(4)) < 1e-9
    );
    let tf: TfMessage = ros::decode(payload(4, 4)).unwrap();
    assert_eq!(
        (
            tf.transforms[0].transform,
            tf.transforms[0].header.frame_id.as_str()
        ),
        (pose.pose, "map")
    );
    assert_eq!(
        (
            tf.transforms[0].child_frame_id.as_str(),
            info.header.frame_id.as_str()
        ),
        ("camera_optical", "camera_optical")
    );
    assert_eq!(pose.header.stamp, image.header.stamp);
}

#[test]
fn recorded_depth_is_exact_to_half_a_millimetre() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("depth.mcap");
    let settings = SynthSettings::parse("facade?width=320&height=240&frames=2").unwrap();
    write_recording(&settings, &out).unwrap();
    let topics = by_topic(&std::fs::read(&out).unwrap());
    let depth: ros::Image =
        ros::decode(&topics["/camera/depth sensor_msgs/msg/Image"][1].1).unwrap();
    let exact = Take::new(settings.clone())
        .unwrap()
        .depth(1, &settings.lens().intrinsics.resized(64, 48));
    let recorded = depth
        .data
        .chunks(2)
        .map(|mm| f32::from(u16::from_le_bytes([mm[0], mm[1]])) / 1000.0);
    let worst = recorded
        .zip(&exact.depth)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(worst < 0.000_51, "{worst} m");
}

#[test]
fn a_recording_that_cannot_be_written_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("missing/out.mcap");
    let settings = SynthSettings::parse("room?width=32&height=24&frames=1").unwrap();
    let message = write_recording(&settings, &out).unwrap_err().to_string();
    assert!(message.ends_with("missing/out.mcap"), "{message}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
