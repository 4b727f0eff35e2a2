//! Damaged, lying and odd recordings: no panic, no memory beyond the bytes at hand, nothing false handed out.

use std::path::Path;

use mcap::Compression;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use splat_mapper::config::SourceParams;
use splat_mapper::frame::Frame;
use splat_mapper::ros::{CameraInfo, CompressedImage, Image, Message, TfMessage};
use splat_mapper::source::{self, SourceCounts, SourceError};

use crate::bags::{self, BagForm, BagWriter, Endian, tenth};
use crate::sources::{frames_of, params, sample_bag, saved};

const TOPIC: &str = "/camera/image_raw";

/// Frames and fault of a recording; one that does not even open has no frames and its error as fault.
fn salvage(bytes: &[u8]) -> (Vec<Frame>, Option<String>) {
    let (_guard, path) = saved(bytes);
    match source::open(path.to_str().unwrap(), &params(), 0) {
        Ok(mut source) => {
            let frames = std::iter::from_fn(|| source.next()).collect();
            (frames, source.counts().fault)
        }
        Err(error) => (Vec::new(), Some(error.to_string())),
    }
}

fn open_error(path: &Path, params: &SourceParams) -> SourceError {
    source::open(path.to_str().unwrap(), params, 0)
        .err()
        .unwrap_or_else(|| panic!("{} opened", path.display()))
}

fn small_chunks(compression: Option<Compression>) -> BagForm {
    BagForm {
        compression,
        chunk_bytes: 6000,
        ..BagForm::default()
    }
}

fn same_picture(a: &Frame, b: &Frame) -> bool {
    a.stamp == b.stamp && a.image == b.image
}

/// The sample with one message that is not an image: `edit` changes its bytes.
fn bag_with(type_name: &str, topic: &str, payload: &[u8]) -> BagWriter {
    let mut bag = BagWriter::new(BagForm::default());
    bag.add_payload(topic, type_name, tenth(0), payload);
    for n in 1..4 {
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), "mono8", (4, 4), vec![1; 16]),
        );
    }
    bag
}

#[test]
fn a_truncated_recording_gives_the_frames_before_the_cut_and_says_so() {
    let mut rng = Pcg32::seed_from_u64(1);
    let whole = BagForm {
        compression: Some(Compression::Zstd),
        ..BagForm::default()
    };
    let unchunked = BagForm {
        is_chunked: false,
        ..BagForm::default()
    };
    for form in [
        small_chunks(None),
        small_chunks(Some(Compression::Lz4)),
        whole,
        unchunked,
    ] {
        let bytes = sample_bag(form).finish();
        let (originals, fault) = salvage(&bytes);
        assert_eq!((originals.len(), fault), (10, None));
        let mut cuts: Vec<usize> = (0..50).map(|_| rng.random_range(0..bytes.len())).collect();
        cuts.extend([0, 1, 8, 9, bytes.len() - 1]);
        cuts.sort_unstable();
        let mut most = 0;
        for cut in cuts {
            let (frames, fault) = salvage(&bytes[..cut]);
            assert!(fault.is_some(), "{form:?} cut at {cut}: no fault");
            assert!(
                frames.len() >= most,
                "{form:?} cut at {cut}: {} frames after {most}",
                frames.len()
            );
            assert!(
                frames
                    .iter()
                    .zip(&originals)
                    .all(|(a, b)| same_picture(a, b)),
                "{form:?} cut at {cut}"
            );
            most = frames.len();
        }
        assert!(most >= 9, "{form:?}: {most} frames before the last byte");
    }
}

#[test]
fn flipped_bits_in_a_recording_with_checksums_never_change_a_picture() {
    let mut rng = Pcg32::seed_from_u64(2);
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        let bytes = sample_bag(small_chunks(compression)).finish();
        let (originals, _) = salvage(&bytes);
        let mut n_faults = 0;
        for _ in 0..250 {
            let mut damaged = bytes.clone();
            let at = rng.random_range(0..damaged.len());
            damaged[at] ^= 1 << rng.random_range(0..8_u32);
            let (frames, fault) = salvage(&damaged);
            n_faults += usize::from(fault.is_some());
            assert!(
                frames
                    .iter()
                    .zip(&originals)
                    .all(|(a, b)| same_picture(a, b)),
                "byte {at} of {}",
                bytes.len()
            );
        }
        assert!(n_faults > 30, "{compression:?}: {n_faults} faults noticed");
    }
}

#[test]
fn many_flipped_bytes_without_checksums_end_without_panic() {
    let mut rng = Pcg32::seed_from_u64(3);
    let unchunked = sample_bag(BagForm {
        is_chunked: false,
        ..BagForm::default()
    })
    .finish();
    let big = sample_bag(BagForm {
        is_chunked: false,
        endian: Endian::Big,
        ..BagForm::default()
    })
    .finish();
    for bytes in [unchunked, big] {
        for _ in 0..250 {
            let mut damaged = bytes.clone();
            for _ in 0..rng.random_range(1..40_usize) {
                let at = rng.random_range(8..damaged.len());
                damaged[at] = rng.random();
            }
            let (frames, _) = salvage(&damaged);
            assert!(frames.len() <= 10);
        }
    }
}

#[test]
fn damaged_jpeg_and_png_are_undecodable_or_pictures_but_never_a_panic() {
    let mut rng = Pcg32::seed_from_u64(4);
    let rgb: Vec<u8> = (0..48 * 32 * 3).map(|i| (i * 7 % 256) as u8).collect();
    for whole in [
        bags::jpeg(tenth(0), (48, 32), &rgb).data,
        bags::png(tenth(0), (48, 32), &rgb).data,
    ] {
        for _ in 0..300 {
            let mut damaged = whole.clone();
            let at = rng.random_range(0..damaged.len());
            damaged[at] ^= 1 << rng.random_range(0..8_u32);
            if let Ok(picture) = source::decode::compressed(&damaged) {
                assert_eq!(
                    picture.pixels.len(),
                    (picture.width_px * picture.height_px * 3) as usize
                );
            }
            let cut = rng.random_range(0..whole.len() - 1);
            assert!(
                source::decode::compressed(&whole[..cut]).is_err(),
                "cut at {cut} of {} decodes",
                whole.len()
            );
        }
    }
}

#[test]
fn odd_pictures_are_counted_and_the_rest_stays_in_use() {
    let mut bag = BagWriter::new(BagForm::default());
    let good = |n: i64| bags::image(tenth(n), "mono8", (4, 4), vec![n as u8; 16]);
    bag.add(
        TOPIC,
        tenth(0),
        &bags::image(tenth(0), "mono8", (0, 0), Vec::new()),
    );
    bag.add(
        TOPIC,
        tenth(1),
        &Image {
            data: vec![1; 15],
            ..good(1)
        },
    );
    bag.add(TOPIC, tenth(2), &Image { step: 2, ..good(2) });
    bag.add(
        TOPIC,
        tenth(3),
        &Image {
            encoding: "rgb16".to_owned(),
            ..good(3)
        },
    );
    bag.add(
        TOPIC,
        tenth(4),
        &Image {
            width: 5,
            encoding: "yuyv".to_owned(),
            ..good(4)
        },
    );
    bag.add_payload(TOPIC, Image::TYPE_NAME, tenth(5), &[0, 1, 0]);
    bag.add_payload(TOPIC, Image::TYPE_NAME, tenth(5), &[]);
    bag.add_payload(
        TOPIC,
        Image::TYPE_NAME,
        tenth(6),
        &[0, 9, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8],
    );
    bag.add(TOPIC, tenth(7), &good(7));
    bag.add(
        TOPIC,
        tenth(8),
        &bags::image(tenth(8), "mono8", (5, 4), vec![1; 20]),
    );
    bag.add(TOPIC, tenth(7), &good(7));
    bag.add(TOPIC, tenth(9), &good(9));
    let (_guard, path) = saved(&bag.finish());
    let (frames, counts) = frames_of(&path, &params());
    assert_eq!(frames.iter().map(|f| f.seq).collect::<Vec<_>>(), [8, 11]);
    assert_eq!(
        counts,
        SourceCounts {
            received: 12,
            undecodable: 9,
            out_of_order: 1,
            fault: None
        }
    );
}

#[test]
fn a_picture_of_one_pixel_is_a_frame() {
    let mut bag = BagWriter::new(BagForm::default());
    for (n, encoding, data) in [(0, "rgb8", vec![9, 8, 7])] {
        bag.add(
            TOPIC,
            tenth(n),
            &bags::image(tenth(n), encoding, (1, 1), data),
        );
    }
    bag.add(
        "/camera/camera_info",
        tenth(0),
        &bags::camera_info((1, 1), "plumb_bob", &[-0.1]),
    );
    let (_guard, path) = saved(&bag.finish());
    let (frames, _) = frames_of(&path, &params());
    assert_eq!(frames[0].image.pixels, [9, 8, 7]);
    let mosaic = bags::image(tenth(0), "bayer_rggb8", (1, 1), vec![5]);
    assert_eq!(source::decode::raw(&mosaic).unwrap().pixels.len(), 3);
}

#[test]
fn a_calibration_that_cannot_be_one_counts_as_none() {
    let size = (64, 48);
    let plain = || bags::camera_info(size, "plumb_bob", &[-0.1, 0.0, 0.0, 0.0, 0.0]);
    let with_k = |ix: usize, value: f64| {
        let mut info = plain();
        info.k[ix] = value;
        info
    };
    let mut cases: Vec<CameraInfo> = [f64::NAN, 0.0, -100.0, f64::INFINITY, 1e9]
        .map(|v| with_k(0, v))
        .to_vec();
    cases.push(with_k(2, 1e6));
    cases.push(CameraInfo {
        width: 0,
        ..plain()
    });
    cases.push(CameraInfo {
        height: 20,
        ..plain()
    });
    cases.push(CameraInfo {
        binning_x: u32::MAX,
        ..plain()
    });
    cases.push(CameraInfo {
        d: vec![f64::NAN; 5],
        ..plain()
    });
    cases.push(CameraInfo {
        d: vec![1e12, -1e9, 3.0, 4.0, 5.0],
        ..plain()
    });
    cases.push(CameraInfo {
        d: vec![1.0; 9],
        ..plain()
    });
    cases.push(CameraInfo {
        distortion_model: "fancy".to_owned(),
        ..plain()
    });
    for info in cases {
        let mut bag = BagWriter::new(BagForm::default());
        bag.add("/camera/camera_info", tenth(0), &info);
        bag.add(
            TOPIC,
            tenth(0),
            &bags::image(tenth(0), "mono8", size, vec![3; 64 * 48]),
        );
        let (_guard, path) = saved(&bag.finish());
        let (frames, counts) = frames_of(&path, &params());
        assert_eq!((frames.len(), counts.undecodable), (1, 0), "{info:?}");
        assert_eq!(frames[0].intrinsics, None, "{info:?}");
        assert_eq!(frames[0].image.pixels, vec![3; 64 * 48 * 3], "{info:?}");
    }
}

#[test]
fn a_zero_stamp_is_replaced_by_the_time_of_recording() {
    let mut bag = BagWriter::new(BagForm::default());
    for n in 0..3 {
        let mut message = bags::image(tenth(n), "mono8", (4, 4), vec![1; 16]);
        message.header.stamp = Default::default();
        bag.add(TOPIC, tenth(n), &message);
    }
    let (_guard, path) = saved(&bag.finish());
    let (frames, _) = frames_of(&path, &params());
    assert_eq!(
        frames.iter().map(|f| f.stamp).collect::<Vec<_>>(),
        [0, 1, 2].map(tenth)
    );
}

#[test]
fn errors_on_opening_name_what_was_found_and_the_way_out() {
    let check = |path: &Path, params: &SourceParams, words: &[&str]| {
        let text = open_error(path, params).to_string();
        for word in words {
            assert!(text.contains(word), "{text:?} lacks {word:?}");
        }
        assert!(text.lines().count() == 1, "{text:?}");
    };
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    check(
        &root.join("absent"),
        &params(),
        &["no source URI", "absent"],
    );
    check(root, &params(), &["no .mcap file is in it"]);
    std::fs::create_dir(root.join("folder.mcap")).unwrap();
    check(root, &params(), &["not a regular file", "folder.mcap"]);
    std::fs::remove_dir(root.join("folder.mcap")).unwrap();
    std::fs::write(root.join("empty.mcap"), "").unwrap();
    check(
        &root.join("empty.mcap"),
        &params(),
        &["is empty", "ros2 bag record"],
    );
    std::fs::write(root.join("text.mcap"), "SQLite format 3").unwrap();
    check(
        &root.join("text.mcap"),
        &params(),
        &["begins with", "mcap convert"],
    );
    std::fs::write(root.join("magic.mcap"), mcap::MAGIC).unwrap();
    check(
        &root.join("magic.mcap"),
        &params(),
        &["no messages", "without an end record"],
    );
    let mut bag = BagWriter::new(BagForm::default());
    bag.add_payload("/cam", "foo_msgs/msg/Image", tenth(0), &[0, 1, 0, 0]);
    std::fs::write(root.join("wrong.mcap"), bag.finish()).unwrap();
    check(
        &root.join("wrong.mcap"),
        &params(),
        &["/cam (foo_msgs/msg/Image)", "--set source.image_topic"],
    );
    let named = |topic: &str| SourceParams {
        image_topic: topic.to_owned(),
        ..params()
    };
    check(
        &root.join("wrong.mcap"),
        &named("/cam"),
        &["\"/cam\" carries foo_msgs/msg/Image"],
    );
    check(&root.join("wrong.mcap"), &named("/other"), &["found /cam"]);
    for uri in ["v4l2:/dev/video0", "webcam:0", "ros2:/camera", "zenoh:key"] {
        check(
            Path::new(uri),
            &params(),
            &["not in this build", "ros2 bag record"],
        );
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_is_refused_and_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe.mcap");
    assert!(
        std::process::Command::new("mkfifo")
            .arg(&pipe)
            .status()
            .unwrap()
            .success()
    );
    assert!(
        open_error(folder.path(), &params())
            .to_string()
            .contains("not a regular file")
    );
    let list = format!(
        "0.0 {}\n0.1 ../../etc/hostname\n",
        pipe.file_name().unwrap().display()
    );
    let pictures = tempfile::tempdir().unwrap();
    std::fs::rename(&pipe, pictures.path().join("pipe.mcap")).unwrap();
    std::fs::write(pictures.path().join("images.txt"), list).unwrap();
    let uri = format!("images:{}", pictures.path().display());
    assert!(
        source::open(&uri, &params(), 0)
            .err()
            .unwrap()
            .to_string()
            .contains("none of the 1 pictures")
    );
}

/// Runs a test of this file again in a process whose address space is 1.5 GiB: taking 10^9 bytes there, even untouched, on
/// top of what a test binary maps for its threads, ends it.
fn in_little_memory(test: &str, body: impl Fn()) {
    const CHILD: &str = "SPLAT_MAPPER_LITTLE_MEMORY";
    if std::env::var_os(CHILD).is_some() {
        return body();
    }
    let script = "ulimit -v 1500000 && exec \"$0\" --exact \"$1\" --test-threads 1";
    let mut child = std::process::Command::new("sh");
    child
        .args(["-c", script])
        .arg(std::env::current_exe().unwrap())
        .arg(format!("hostile_bags::{test}"));
    let output = child
        .env(CHILD, "1")
        .env("RAYON_NUM_THREADS", "2")
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned()
        + &String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && text.contains("1 passed"),
        "{text}"
    );
}

const BILLION: u32 = 1_000_000_000;

/// Every aligned place in the message where a length may stand, set to a billion in turn.
fn with_billions(payload: &[u8]) -> impl Iterator<Item = Vec<u8>> + '_ {
    (4..payload.len().saturating_sub(3).min(120))
        .step_by(4)
        .map(|at| {
            let mut lying = payload.to_vec();
            lying[at..at + 4].copy_from_slice(&BILLION.to_le_bytes());
            lying
        })
}

#[test]
fn lengths_of_a_billion_in_messages_take_no_memory() {
    in_little_memory("lengths_of_a_billion_in_messages_take_no_memory", || {
        let little = Endian::Little;
        let raw = bags::payload_of(&bags::image(tenth(0), "mono8", (4, 4), vec![1; 16]), little);
        let packed = bags::payload_of(&bags::png(tenth(0), (4, 4), &[1; 48]), little);
        let info = bags::payload_of(&bags::camera_info((4, 4), "plumb_bob", &[0.0; 5]), little);
        let tf = bags::payload_of(
            &TfMessage {
                transforms: vec![Default::default()],
            },
            little,
        );
        let types = [
            (Image::TYPE_NAME, TOPIC, raw),
            (CompressedImage::TYPE_NAME, "/a/compressed", packed),
            (CameraInfo::TYPE_NAME, "/camera/camera_info", info),
            (TfMessage::TYPE_NAME, "/tf", tf),
        ];
        for (type_name, topic, payload) in types {
            for lying in with_billions(&payload) {
                let (frames, fault) = salvage(&bag_with(type_name, topic, &lying).finish());
                // A lie in the stamp of the first picture may put the three others before it.
                assert!(
                    frames.len() <= 4 && fault.is_none(),
                    "{type_name}: {fault:?}"
                );
            }
        }
    });
}

#[test]
fn pictures_that_claim_huge_sizes_take_no_memory() {
    in_little_memory("pictures_that_claim_huge_sizes_take_no_memory", || {
        let rgb = vec![50; 48 * 32 * 3];
        let jpeg = bags::jpeg(tenth(0), (48, 32), &rgb).data;
        let start_of_frame = jpeg
            .windows(2)
            .position(|pair| pair == [0xff, 0xc0])
            .unwrap();
        for side in [16_000_u16, 40_000, 65_535] {
            let mut lying = jpeg.clone();
            lying[start_of_frame + 5..start_of_frame + 7].copy_from_slice(&side.to_be_bytes());
            lying[start_of_frame + 7..start_of_frame + 9].copy_from_slice(&side.to_be_bytes());
            assert!(
                source::decode::compressed(&lying).is_err(),
                "JPEG of {side}"
            );
        }
        for encoding in [
            "rgb8",
            "mono8",
            "bayer_rggb8",
            "yuyv",
            "nv12",
            "16UC1",
            "32FC1",
        ] {
            for (width, height) in [
                (BILLION, BILLION),
                (16384, 16384),
                (u32::MAX, 1),
                (2, u32::MAX),
            ] {
                for step in [0, 1, u32::MAX] {
                    let small = bags::image(tenth(0), encoding, (4, 4), vec![1; 64]);
                    let message = Image {
                        width,
                        height,
                        step,
                        ..small
                    };
                    assert!(
                        source::decode::raw(&message).is_err(),
                        "{encoding} {width}x{height} step {step}"
                    );
                    assert!(
                        source::decode::depth(&message).is_err(),
                        "{encoding} {width}x{height} step {step}"
                    );
                }
            }
        }
    });
}

#[test]
fn lengths_of_a_billion_in_records_take_no_memory() {
    in_little_memory("lengths_of_a_billion_in_records_take_no_memory", || {
        let unchunked = BagForm {
            is_chunked: false,
            ..BagForm::default()
        };
        let forms = [None, Some(Compression::Zstd), Some(Compression::Lz4)].map(small_chunks);
        for form in forms.into_iter().chain([unchunked]) {
            let bytes = sample_bag(form).finish();
            let mut heads = vec![];
            let mut at = mcap::MAGIC.len();
            while at + 9 < bytes.len() {
                heads.push(at);
                at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
            }
            for head in heads {
                // The length of the record, and what stands in its first bytes: lengths of names, sizes of chunks.
                for (offset, n_bytes) in [
                    (1, 8),
                    (9, 4),
                    (13, 4),
                    (25, 8),
                    (33, 4),
                    (37, 4),
                    (41, 8),
                    (45, 8),
                    (49, 8),
                ] {
                    for value in [u64::from(BILLION), 1 << 62, u64::MAX] {
                        let mut lying = bytes.clone();
                        let Some(field) = lying.get_mut(head + offset..head + offset + n_bytes)
                        else {
                            continue;
                        };
                        field.copy_from_slice(&value.to_le_bytes()[..n_bytes]);
                        assert!(salvage(&lying).0.len() <= 10);
                    }
                }
            }
        }
    });
}

/// A chunk whose checksum is zero, that is, not recorded: lengths inside it are all that protects.
#[test]
fn records_that_reach_out_of_their_chunk_are_a_fault() {
    in_little_memory("records_that_reach_out_of_their_chunk_are_a_fault", || {
        for length in [20, 500, u64::from(BILLION), u64::MAX - 8, u64::MAX] {
            let mut records = vec![5];
            records.extend(length.to_le_bytes());
            records.extend([0; 40]);
            for claimed in [records.len() as u64, 3, u64::from(BILLION)] {
                let mut chunk = vec![0; 16];
                chunk.extend(claimed.to_le_bytes());
                chunk.extend([0; 4 + 4]);
                chunk.extend(claimed.to_le_bytes());
                chunk.extend(&records);
                let good = sample_bag(BagForm {
                    is_chunked: false,
                    ..BagForm::default()
                })
                .finish();
                let mut bytes = mcap::MAGIC.to_vec();
                bytes.push(6);
                bytes.extend((chunk.len() as u64).to_le_bytes());
                bytes.extend(chunk);
                bytes.extend(&good[8..]);
                assert!(
                    salvage(&bytes).1.is_some(),
                    "length {length}, claimed {claimed}"
                );
            }
        }
    });
}
