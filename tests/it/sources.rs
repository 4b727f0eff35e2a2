//! Recordings and folders of images -> frames: colours, stamps, calibration, truth.

use std::path::{Path, PathBuf};

use glam::DVec3;
use mcap::Compression;

use crate::bags::{self, BagForm, BagWriter, Endian, tenth};
use crate::scenes::scene;
use splat_io::frame_source::{Source, SourceCounts};
use splat_io::mcap::McapSource;
use splat_io::params::SourceParams;
use splat_mapper::node::open_source;
use splat_mapper::params::settings::Settings;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::{Stamp, Stopwatch};

pub const TOPIC: &str = "/camera/image_raw";

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
    let mut source = open_source::open(path.to_str().unwrap(), params, 0).unwrap();
    let frames: Vec<Frame> = std::iter::from_fn(|| source.next()).collect();
    (frames, source.counts())
}

pub fn replay(bag: BagWriter, params: &SourceParams) -> (Vec<Frame>, SourceCounts) {
    let (_guard, path) = saved(&bag.finish());
    frames_of(&path, params)
}

pub fn pixel(image: &RgbImage, x: u32, y: u32) -> [u8; 3] {
    let ix = (y * image.width_px + x) as usize * 3;
    image.pixels[ix..ix + 3].try_into().unwrap()
}

pub fn check_pixel(
    image: &RgbImage,
    (x, y): (u32, u32),
    expected: [u8; 3],
    tolerance: u8,
    what: &str,
) {
    let found = pixel(image, x, y);
    let fits = found
        .iter()
        .zip(expected)
        .all(|(&f, e)| f.abs_diff(e) <= tolerance);
    assert!(fits, "{what} at {x},{y}: {found:?}, expected {expected:?}");
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
fn a_plain_folder_of_images_is_read_in_natural_order() {
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
    // The bag and the folder of images hold the same frames; only their stamps differ.
    let (images, _) = frames_of(&folder, &params());
    assert_eq!(images.len(), 50);
    assert_eq!(images[7].image, frames[7].image);
    let gap = images[7].truth.unwrap().translation - frames[7].truth.unwrap().translation;
    assert!(gap.length() < 1e-6);
}

#[test]
fn the_still_drone_gives_twenty_frames_from_its_folder() {
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
    // Its images.txt lists images that are only in the recording.
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
