//! Recordings and folders of pictures -> frames: colours, stamps, calibration, truth.

use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use mcap::Compression;
use splat_mapper::camera::Intrinsics;
use splat_mapper::clock::{Stamp, Stopwatch};
use splat_mapper::config::{Settings, SourceParams};
use splat_mapper::frame::{Frame, RgbImage};
use splat_mapper::ros::{Header, Image, Pose, TfMessage, TransformStamped};
use splat_mapper::source::mcap::McapSource;
use splat_mapper::source::{self, Source, SourceCounts};

use crate::bags::{self, BagForm, BagWriter, Endian, tenth};
use crate::scenes::scene;

const TOPIC: &str = "/camera/image_raw";
const SIZE: (u32, u32) = (8, 4);

pub fn params() -> SourceParams {
    Settings::shipped().params().unwrap().source
}

/// A bag in a folder of its own, which lives as long as the guard.
pub fn saved(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

pub fn frames_of(path: &Path, params: &SourceParams) -> (Vec<Frame>, SourceCounts) {
    let mut source = source::open(path.to_str().unwrap(), params, 0).unwrap();
    let frames: Vec<Frame> = std::iter::from_fn(|| source.next()).collect();
    (frames, source.counts())
}

fn replay(bag: BagWriter, params: &SourceParams) -> (Vec<Frame>, SourceCounts) {
    let (_guard, path) = saved(&bag.finish());
    frames_of(&path, params)
}

pub fn pixel(image: &RgbImage, x: u32, y: u32) -> [u8; 3] {
    let ix = (y * image.width_px + x) as usize * 3;
    image.pixels[ix..ix + 3].try_into().unwrap()
}

fn check_pixel(image: &RgbImage, (x, y): (u32, u32), expected: [u8; 3], tolerance: u8, what: &str) {
    let found = pixel(image, x, y);
    let fits = found
        .iter()
        .zip(expected)
        .all(|(&f, e)| f.abs_diff(e) <= tolerance);
    assert!(fits, "{what} at {x},{y}: {found:?}, expected {expected:?}");
}

/// Left half one colour, right half another, `row_pad` junk bytes behind each row.
fn halves(pixel_bytes: usize, left: &[u8], right: &[u8], row_pad: usize) -> Image {
    let unit = left.len();
    let per_side = SIZE.0 as usize / 2 * pixel_bytes / unit;
    let mut data = Vec::new();
    for _ in 0..SIZE.1 {
        data.extend(left.repeat(per_side));
        data.extend(right.repeat(per_side));
        data.extend(vec![0xab; row_pad]);
    }
    bags::image(tenth(0), "", SIZE, data)
}

#[test]
fn every_encoding_decodes_to_its_colours_with_and_without_row_padding() {
    let (red, sky) = ([200, 30, 10], [20, 90, 250]);
    let grey = |v: u8| [v, v, v];
    // (encoding, bytes per pixel, bytes of a left and a right unit, expected left and right).
    type Case = (
        &'static str,
        usize,
        &'static [u8],
        &'static [u8],
        [u8; 3],
        [u8; 3],
    );
    let cases: [Case; 11] = [
        ("rgb8", 3, &[200, 30, 10], &[20, 90, 250], red, sky),
        ("bgr8", 3, &[10, 30, 200], &[250, 90, 20], red, sky),
        ("8UC3", 3, &[10, 30, 200], &[250, 90, 20], red, sky),
        ("rgba8", 4, &[200, 30, 10, 7], &[20, 90, 250, 7], red, sky),
        ("bgra8", 4, &[10, 30, 200, 7], &[250, 90, 20, 7], red, sky),
        ("mono8", 1, &[77], &[201], grey(77), grey(201)),
        // Expected RGB by OpenCV 5.0 (COLOR_YUV2RGB_YUY2): BT.601, limited range.
        (
            "yuyv",
            2,
            &[81, 90, 81, 240],
            &[120, 100, 120, 160],
            [254, 0, 0],
            [172, 106, 65],
        ),
        (
            "yuv422_yuy2",
            2,
            &[145, 54, 145, 34],
            &[41, 240, 41, 110],
            [0, 255, 1],
            [0, 0, 255],
        ),
        (
            "uyvy",
            2,
            &[90, 81, 240, 81],
            &[100, 120, 160, 120],
            [254, 0, 0],
            [172, 106, 65],
        ),
        (
            "yuv422",
            2,
            &[128, 235, 128, 235],
            &[240, 41, 110, 41],
            [255, 255, 255],
            [0, 0, 255],
        ),
        ("8UC1", 1, &[0], &[255], grey(0), grey(255)),
    ];
    for (encoding, pixel_bytes, left, right, expected_left, expected_right) in cases {
        for row_pad in [0, 5] {
            let mut message = halves(pixel_bytes, left, right, row_pad);
            message.encoding = encoding.to_owned();
            let picture = source::decode::raw(&message).unwrap();
            for y in 0..SIZE.1 {
                check_pixel(&picture, (0, y), expected_left, 2, encoding);
                check_pixel(&picture, (7, y), expected_right, 2, encoding);
            }
        }
    }
}

#[test]
fn nv12_decodes_to_its_colours_with_and_without_row_padding() {
    for pad in [0, 3] {
        let mut data = Vec::new();
        let mut row = |values: &[u8]| {
            data.extend_from_slice(values);
            data.extend(vec![0xcd; pad]);
        };
        for _ in 0..4 {
            row(&[81, 81, 81, 81, 41, 41, 41, 41]);
        }
        for _ in 0..2 {
            row(&[90, 240, 90, 240, 240, 110, 240, 110]);
        }
        let mut message = bags::image(tenth(0), "nv12", SIZE, data);
        message.step = 8 + pad as u32;
        let picture = source::decode::raw(&message).unwrap();
        for y in 0..4 {
            check_pixel(&picture, (0, y), [254, 0, 0], 2, "nv12");
            check_pixel(&picture, (7, y), [0, 0, 255], 2, "nv12");
        }
    }
}

/// A mosaic of one colour must come out as that colour wherever both neighbours exist.
#[test]
fn each_bayer_pattern_puts_its_colours_where_they_belong() {
    let colour = [200_u8, 120, 40];
    let patterns = [
        ("rggb", [0, 1, 1, 2]),
        ("bggr", [2, 1, 1, 0]),
        ("grbg", [1, 0, 2, 1]),
        ("gbrg", [1, 2, 0, 1]),
    ];
    for (name, cell) in patterns {
        for size in [(8, 6), (7, 5), (2, 2)] {
            let at = |x: u32, y: u32| colour[cell[(y % 2 * 2 + x % 2) as usize]];
            let data = (0..size.1)
                .flat_map(|y| (0..size.0).map(move |x| (x, y)))
                .map(|(x, y)| at(x, y))
                .collect();
            let message = bags::image(tenth(0), &format!("bayer_{name}8"), size, data);
            let picture = source::decode::raw(&message).unwrap();
            if size.0 > 2 {
                for y in 1..size.1 - 1 {
                    (1..size.0 - 1).for_each(|x| check_pixel(&picture, (x, y), colour, 1, name));
                }
            }
        }
    }
}

#[test]
fn jpeg_and_png_messages_decode_whatever_their_format_text_says() {
    let rgb: Vec<u8> = (0..64 * 48).flat_map(|_| [180_u8, 60, 20]).collect();
    for format in ["jpeg", "rgb8; jpeg compressed bgr8", "png", "", "garbage"] {
        for compress in [bags::jpeg, bags::png] {
            let mut message = compress(tenth(0), (64, 48), &rgb);
            message.format = format.to_owned();
            let picture = source::decode::compressed(&message.data).unwrap();
            assert_eq!((picture.width_px, picture.height_px), (64, 48));
            check_pixel(&picture, (30, 20), [180, 60, 20], 4, format);
        }
    }
}

/// Ten frames whose red value is their number, CameraInfo behind the first one, poses between.
pub fn sample_bag(form: BagForm) -> BagWriter {
    let mut bag = BagWriter::new(form);
    for n in 0..10 {
        let data = [n as u8 * 20, 50, 90].repeat(32 * 24);
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), "rgb8", (32, 24), data),
        );
        bag.add(
            "/camera/camera_info",
            tenth(n),
            &bags::camera_info((32, 24), "plumb_bob", &[0.0; 5]),
        );
        bag.add(
            "/ground_truth/pose",
            tenth(n),
            &bags::pose(tenth(n), n as f64),
        );
    }
    bag
}

#[test]
fn bags_of_every_form_and_byte_order_give_the_same_frames() {
    let mut forms = Vec::new();
    for endian in [Endian::Little, Endian::Big] {
        for is_indexed in [true, false] {
            for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
                forms.push(BagForm {
                    compression,
                    is_indexed,
                    endian,
                    chunk_bytes: 5000,
                    ..BagForm::default()
                });
            }
            forms.push(BagForm {
                is_chunked: false,
                is_indexed,
                endian,
                ..BagForm::default()
            });
        }
    }
    forms.push(BagForm {
        schema_encoding: "ros2idl",
        ..BagForm::default()
    });
    for form in forms {
        let (frames, counts) = replay(sample_bag(form), &params());
        assert_eq!(
            counts,
            SourceCounts {
                received: 10,
                ..SourceCounts::default()
            },
            "{form:?}"
        );
        for (n, frame) in frames.iter().enumerate() {
            assert_eq!(
                (frame.seq, frame.stamp),
                (n as u64, tenth(n as i64)),
                "{form:?}"
            );
            assert_eq!(
                pixel(&frame.image, 5, 5),
                [n as u8 * 20, 50, 90],
                "{form:?}"
            );
            assert_eq!(
                frame.truth.unwrap().translation,
                DVec3::new(n as f64, 0.0, 0.0)
            );
            let expected = Intrinsics {
                width_px: 32,
                height_px: 24,
                fx: 100.0,
                fy: 100.0,
                cx: 16.0,
                cy: 12.0,
            };
            assert_eq!(frame.intrinsics, Some(expected));
        }
        assert_eq!(frames.len(), 10, "{form:?}");
    }
}

#[test]
fn the_hint_counts_down_and_max_frames_ends_the_input() {
    let (_guard, path) = saved(&sample_bag(BagForm::default()).finish());
    let mut source = McapSource::open(
        &path,
        &SourceParams {
            max_frames: 4,
            ..params()
        },
    )
    .unwrap();
    assert_eq!(source.len_hint(), Some(4));
    let n = std::iter::from_fn(|| source.next()).count();
    assert_eq!((n, source.len_hint()), (4, Some(0)));
}

#[test]
fn a_split_recording_is_read_in_the_order_of_its_metadata() {
    let folder = tempfile::tempdir().unwrap();
    let part = |from: i64| {
        let mut bag = BagWriter::new(BagForm::default());
        for n in from..from + 3 {
            bag.add(
                TOPIC,
                tenth(n),
                &bags::image(tenth(n), "mono8", (4, 4), vec![n as u8; 16]),
            );
        }
        bag.finish()
    };
    std::fs::write(folder.path().join("z.mcap"), part(0)).unwrap();
    std::fs::write(folder.path().join("a.mcap"), part(3)).unwrap();
    let metadata = "rosbag2_bagfile_information:\n  relative_file_paths:\n  - z.mcap\n  - a.mcap\n";
    std::fs::write(folder.path().join("metadata.yaml"), metadata).unwrap();
    let reds = |frames: &[Frame]| {
        frames
            .iter()
            .map(|f| pixel(&f.image, 0, 0)[0])
            .collect::<Vec<_>>()
    };
    let (frames, counts) = frames_of(folder.path(), &params());
    assert_eq!(
        (reds(&frames), counts.fault),
        (vec![0, 1, 2, 3, 4, 5], None)
    );
    // Without usable metadata the names decide, and late stamps are left out.
    std::fs::write(folder.path().join("metadata.yaml"), "[: not yaml").unwrap();
    let (frames, counts) = frames_of(folder.path(), &params());
    assert_eq!((reds(&frames), counts.out_of_order), (vec![3, 4, 5], 3));
}

#[test]
fn a_named_topic_wins_and_depth_topics_are_no_pictures() {
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
        let depth = frame.truth_depth.as_ref().unwrap();
        assert!(
            (depth.depth[5] - (n as f32 + 1.0) - 0.005).abs() < 1e-5,
            "frame {n}: {:?}",
            depth.depth
        );
    }
}

#[test]
fn depth_that_comes_later_than_its_picture_still_finds_it() {
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
        .map(|f| f.truth_depth.as_ref().map(|d| d.depth[0]))
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
    let depth = frames[0].truth_depth.as_ref().unwrap();
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
            transform: Pose::from(splat_mapper::pose::Rigid::new(turn, at)),
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
        let world_from_cam = frame.truth.unwrap();
        let ahead = world_from_cam.transform_point(DVec3::Z);
        // The base is turned left, so what is ahead of the camera lies along the world's y.
        let expected = DVec3::new(n as f64, 1.2, 0.1);
        assert!((ahead - expected).length() < 1e-9, "frame {n}: {ahead}");
    }
}

#[test]
fn a_rectified_topic_is_described_by_p_and_not_undistorted_again() {
    let mut bag = BagWriter::new(BagForm::default());
    let mut info = bags::camera_info((32, 24), "plumb_bob", &[-0.3, 0.1, 0.0, 0.0, 0.0]);
    info.p[0] = 90.0;
    let data: Vec<u8> = (0..32 * 24).map(|i| (i % 251) as u8).collect();
    bag.add(
        "/camera/image_rect",
        tenth(0),
        &bags::image(tenth(0), "mono8", (32, 24), data.clone()),
    );
    bag.add("/camera/camera_info", tenth(0), &info);
    let (frames, _) = replay(bag, &params());
    assert_eq!(frames[0].intrinsics.unwrap().fx, 90.0);
    assert_eq!(
        frames[0]
            .image
            .pixels
            .iter()
            .step_by(3)
            .copied()
            .collect::<Vec<_>>(),
        data
    );
}

#[test]
fn binning_and_cut_move_the_calibration_with_the_picture() {
    let mut info = bags::camera_info((640, 480), "", &[]);
    info.k = [400.0, 0.0, 319.5, 0.0, 400.0, 239.5, 0.0, 0.0, 1.0];
    (info.binning_x, info.binning_y) = (2, 2);
    info.roi.x_offset = 40;
    (info.roi.width, info.roi.height) = (560, 480);
    let lens = source::calibration::lens_of_camera_info(&info, false).unwrap();
    let expected = Intrinsics {
        width_px: 280,
        height_px: 240,
        fx: 200.0,
        fy: 200.0,
        cx: 140.0,
        cy: 120.0,
    };
    assert_eq!(lens.intrinsics, expected);
}

#[test]
fn a_large_picture_is_scaled_down_and_its_intrinsics_follow() {
    // A bright square whose centre is known in both sizes.
    let (w, h) = (300_u32, 200_u32);
    let is_inside = |x: u32, y: u32| (90..120).contains(&x) && (60..90).contains(&y);
    let data = (0..w * h)
        .map(|i| if is_inside(i % w, i / w) { 255 } else { 0 })
        .collect();
    let mut bag = BagWriter::new(BagForm::default());
    bag.add(
        TOPIC,
        tenth(0),
        &bags::image(tenth(0), "mono8", (w, h), data),
    );
    bag.add(
        "/camera/camera_info",
        tenth(0),
        &bags::camera_info((w, h), "plumb_bob", &[]),
    );
    let (frames, _) = replay(
        bag,
        &SourceParams {
            max_side: 128,
            ..params()
        },
    );
    let (image, intrinsics) = (&frames[0].image, frames[0].intrinsics.unwrap());
    assert_eq!((image.width_px, image.height_px), (128, 85));
    let (mut sum, mut centre) = (0.0, DVec2::ZERO);
    for y in 0..image.height_px {
        for x in 0..image.width_px {
            let weight = f64::from(pixel(image, x, y)[0]);
            sum += weight;
            centre += weight * DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        }
    }
    // The centre of the square, 105 and 75 px from the corner of the first pixel, as a ray.
    let ray = DVec3::new((105.0 - 150.0) / 100.0, (75.0 - 100.0) / 100.0, 1.0);
    let expected = intrinsics.project(ray).unwrap();
    assert!(
        (centre / sum - expected).length() < 0.02,
        "{} against {expected}",
        centre / sum
    );
}

#[test]
fn distorted_frames_come_out_rectified_unless_told_otherwise() {
    let size = (64, 48);
    let d = [-0.2, 0.05, 0.0, 0.0, 0.0];
    let make = || {
        let mut bag = BagWriter::new(BagForm::default());
        bag.add(
            TOPIC,
            tenth(0),
            &bags::image(
                tenth(0),
                "mono8",
                size,
                (0..64 * 48).map(|i| (i % 64) as u8).collect(),
            ),
        );
        bag.add(
            "/depth",
            tenth(0),
            &bags::image(
                tenth(0),
                "32FC1",
                size,
                3.0_f32.to_le_bytes().repeat(64 * 48),
            ),
        );
        bag.add(
            "/camera/camera_info",
            tenth(0),
            &bags::camera_info(size, "plumb_bob", &d),
        );
        bag
    };
    let (raw, _) = replay(
        make(),
        &SourceParams {
            rectify: false,
            ..params()
        },
    );
    assert_eq!(raw[0].intrinsics.unwrap().fx, 100.0);
    assert_eq!(pixel(&raw[0].image, 10, 3), [10; 3]);
    let (rectified, _) = replay(make(), &params());
    let pinhole = rectified[0].intrinsics.unwrap();
    assert!(pinhole.fx > 90.0 && pinhole.fx < 100.0, "{pinhole:?}");
    assert_eq!(
        rectified[0].truth_depth.as_ref().unwrap().depth,
        vec![3.0; 64 * 48]
    );
    assert_ne!(rectified[0].image.pixels, raw[0].image.pixels);
}

#[test]
fn a_paced_replay_takes_as_long_as_the_recording() {
    let (_guard, path) = saved(&sample_bag(BagForm::default()).finish());
    let watch = Stopwatch::start();
    let (frames, _) = frames_of(
        &path,
        &SourceParams {
            rate: 5.0,
            ..params()
        },
    );
    // 0.9 s of recording at five times its speed.
    assert!(
        frames.len() == 10 && watch.secs() > 0.179,
        "{} s",
        watch.secs()
    );
}

#[test]
fn a_plain_folder_of_pictures_is_read_in_natural_order() {
    let folder = tempfile::tempdir().unwrap();
    for n in [2_u8, 10, 1] {
        let rgb = vec![n; 4 * 3 * 3];
        std::fs::write(
            folder.path().join(format!("f{n}.png")),
            bags::png(tenth(0), (4, 3), &rgb).data,
        )
        .unwrap();
    }
    let (frames, _) = frames_of(folder.path(), &params());
    let reds: Vec<_> = frames.iter().map(|f| pixel(&f.image, 0, 0)[0]).collect();
    let stamps: Vec<_> = frames.iter().map(|f| f.stamp.nanos).collect();
    assert_eq!(
        (reds, stamps),
        (vec![1, 2, 10], vec![0, 100_000_000, 200_000_000])
    );
    assert!(
        frames
            .iter()
            .all(|f| f.intrinsics.is_none() && f.truth.is_none())
    );
}

#[test]
fn the_fox_recording_gives_fifty_frames_with_truth() {
    let Some(folder) = scene("fox") else { return };
    let (frames, counts) = frames_of(&folder.join("rosbag2"), &params());
    assert_eq!(
        counts,
        SourceCounts {
            received: 50,
            ..SourceCounts::default()
        }
    );
    assert_eq!(frames.len(), 50);
    assert!(frames.iter().all(|f| f.truth.is_some()));
    let i = frames[0].intrinsics.unwrap();
    assert_eq!((i.width_px, i.height_px), (360, 640));
    // intrinsics.json says 276.779, 482.134 at 540x960 with centres at integers.
    let scale = 640.0 / 960.0;
    assert!(
        (i.cx - (276.779 + 0.5) * scale).abs() < 1e-6
            && (i.cy - (482.134 + 0.5) * scale).abs() < 1e-6,
        "{i:?}"
    );
    // The bag and the folder of pictures hold the same frames; only their stamps differ.
    let (pictures, _) = frames_of(&folder, &params());
    assert_eq!(pictures.len(), 50);
    assert_eq!(pictures[7].image, frames[7].image);
    let gap = pictures[7].truth.unwrap().translation - frames[7].truth.unwrap().translation;
    assert!(gap.length() < 1e-6);
}

#[test]
fn the_resting_drone_gives_twenty_frames_from_its_folder() {
    let Some(folder) = scene("static_euroc") else {
        return;
    };
    let (frames, counts) = frames_of(
        &folder,
        &SourceParams {
            max_side: 752,
            ..params()
        },
    );
    assert_eq!((frames.len(), counts.received), (20, 20));
    assert_eq!(
        frames[0].stamp,
        Stamp::from_nanos(1_403_715_273_262_143_000)
    );
    assert!(frames.iter().all(|f| f.truth.is_some()));
    assert_eq!(
        (
            frames[0].intrinsics.unwrap().cx,
            frames[0].intrinsics.unwrap().cy
        ),
        (376.0, 240.0)
    );
}

#[test]
fn every_second_frame_of_the_kitchen_has_truth() {
    let Some(folder) = scene("kitchen7s") else {
        return;
    };
    // Its images.txt lists pictures that are only in the recording.
    let (frames, counts) = frames_of(
        &folder,
        &SourceParams {
            max_frames: 40,
            ..params()
        },
    );
    assert_eq!((frames.len(), counts.undecodable), (40, 0));
    let with_truth = frames.iter().filter(|f| f.truth.is_some()).count();
    assert_eq!(with_truth, 20);
}
