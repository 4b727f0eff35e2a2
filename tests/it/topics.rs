//! Which topics a recording is read from, and how depth and ground truth find their frames.

use glam::DVec3;

use crate::bags::{self, BagForm, BagWriter, tenth};
use crate::sources::{TOPIC, frames_of, params, pixel, replay, saved};
use splat_io::params::SourceParams;
use splat_msgs::ros::{Header, Image, Pose, TfMessage, TransformStamped};
use splat_types::time::Stamp;

#[test]
fn a_named_topic_wins_and_depth_topics_are_no_images() {
    let mut bag = BagWriter::new(BagForm::default());
    for n in 0..4 {
        let stamp = tenth(n);
        let millimetres: Vec<u8> = (0..16)
            .flat_map(|i| (1000_u16 * (n as u16 + 1) + i).to_le_bytes())
            .collect();
        bag.add(
            "/a_depth/image_raw",
            stamp,
            &bags::image(stamp, "16UC1", (4, 4), millimetres),
        );
        bag.add(
            "/b/image_raw",
            stamp,
            &bags::image(stamp, "mono8", (4, 4), vec![1; 16]),
        );
        bag.add(
            "/c/image_raw",
            stamp,
            &bags::image(stamp, "mono8", (4, 4), vec![2; 16]),
        );
        bag.add(
            "/c/camera_info",
            stamp,
            &bags::camera_info((4, 4), "plumb_bob", &[]),
        );
    }
    let (_guard, path) = saved(&bag.finish());
    let red = |params: &SourceParams| pixel(&frames_of(&path, params).0[0].image, 0, 0)[0];
    assert_eq!(red(&params()), 2, "the one with a CameraInfo beside it");
    assert_eq!(
        red(&SourceParams {
            image_topic: "/b/image_raw".to_owned(),
            ..params()
        }),
        1
    );
    let (frames, _) = frames_of(&path, &params());
    for (n, frame) in frames.iter().enumerate() {
        let depth = frame.sensor_depth.as_ref().unwrap();
        assert!(
            (depth.depth[5] - (n as f32 + 1.0) - 0.005).abs() < 1e-5,
            "frame {n}: {:?}",
            depth.depth
        );
    }
}

#[test]
fn depth_that_comes_later_than_its_image_still_finds_it() {
    let mut bag = BagWriter::new(BagForm::default());
    for n in 0..8 {
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), "mono8", (4, 2), vec![1; 8]),
        );
        if n >= 3 && n != 5 {
            let stamp = tenth(n - 3);
            let values = [n as f32, f32::NAN, -1.0, f32::INFINITY, 2.0, 2.0, 2.0, 2.0];
            let data = values.iter().flat_map(|v| v.to_be_bytes()).collect();
            let message = Image {
                is_bigendian: 1,
                ..bags::image(stamp, "32FC1", (4, 2), data)
            };
            bag.add("/depth", tenth(n), &message);
        }
    }
    let (frames, _) = replay(bag, &params());
    let first: Vec<_> = frames
        .iter()
        .map(|f| f.sensor_depth.as_ref().map(|d| d.depth[0]))
        .collect();
    let expected = [
        Some(3.0),
        Some(4.0),
        None,
        Some(6.0),
        Some(7.0),
        None,
        None,
        None,
    ];
    assert_eq!(first, expected);
    let depth = frames[0].sensor_depth.as_ref().unwrap();
    assert_eq!(
        (&depth.depth[1..4], &depth.confidence[..5]),
        (&[0.0; 3][..], &[1.0, 0.0, 0.0, 0.0, 1.0][..])
    );
}

#[test]
fn truth_is_the_nearest_pose_within_half_a_frame() {
    let mut bag = BagWriter::new(BagForm::default());
    for n in 0..6 {
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), "mono8", (4, 4), vec![1; 16]),
        );
    }
    let off = |n: i64, millis: i64| Stamp::from_nanos(tenth(n).nanos + millis * 1_000_000);
    for (n, stamp) in [off(0, 40), off(2, -30), off(2, 20), off(4, 70)]
        .into_iter()
        .enumerate()
    {
        bag.add("/pose", stamp, &bags::pose(stamp, n as f64));
    }
    let (frames, _) = replay(bag, &params());
    let found: Vec<_> = frames
        .iter()
        .map(|f| f.truth.map(|t| t.translation.x))
        .collect();
    assert_eq!(found, [Some(0.0), None, Some(2.0), None, None, Some(3.0)]);
}

#[test]
fn tf_gives_the_truth_when_no_pose_topic_does() {
    let mut bag = BagWriter::new(BagForm::default());
    let link = |parent: &str, child: &str, stamp: Stamp, at: DVec3, turn: glam::DQuat| TfMessage {
        transforms: vec![TransformStamped {
            header: Header {
                stamp: stamp.into(),
                frame_id: parent.to_owned(),
            },
            child_frame_id: child.to_owned(),
            transform: Pose::from(splat_types::transform::Rigid::new(turn, at)),
        }],
    };
    // base looks along its x; the optical frame has z there, x to the right, y down (REP-103).
    let optical = glam::DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
    bag.add(
        "/tf_static",
        tenth(0),
        &link(
            "base",
            "camera_optical",
            tenth(0),
            DVec3::new(0.2, 0.0, 0.1),
            optical,
        ),
    );
    for n in 0..3 {
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), "mono8", (4, 4), vec![1; 16]),
        );
        let turn = glam::DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        bag.add(
            "/tf",
            tenth(n),
            &link(
                "map",
                "base",
                tenth(n),
                DVec3::new(n as f64, 0.0, 0.0),
                turn,
            ),
        );
    }
    let (frames, _) = replay(bag, &params());
    for (n, frame) in frames.iter().enumerate() {
        let gt_from_cam = frame.truth.unwrap();
        let ahead = gt_from_cam.transform_point(DVec3::Z);
        // The base is turned left, so what is ahead of the camera lies along the world's y.
        let expected = DVec3::new(n as f64, 1.2, 0.1);
        assert!((ahead - expected).length() < 1e-9, "frame {n}: {ahead}");
    }
}
