//! Lengths that lie, in messages, records and images: no memory beyond the bytes at hand.

use mcap::Compression;

use crate::bags::{self, BagForm, BagWriter, Endian, tenth};
use crate::hostile_bags::{salvage, small_chunks};
use crate::sources::{TOPIC, sample_bag};
use splat_msgs::ros::{CameraInfo, CompressedImage, Image, Message, TfMessage};

/// One message of any bytes, then three good images.
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

/// Runs a test, named with its module, again in a process whose address space is 1.5 GiB: taking 10^9 bytes there, even untouched, on
/// top of what a test binary maps for its threads, ends it.
pub fn in_little_memory(test: &str, body: impl Fn()) {
    const CHILD: &str = "SPLAT_MAPPER_LITTLE_MEMORY";
    if std::env::var_os(CHILD).is_some() {
        return body();
    }
    let script = "ulimit -v 1500000 && exec \"$0\" --exact \"$1\" --test-threads 1";
    let mut child = std::process::Command::new("sh");
    child
        .args(["-c", script])
        .arg(std::env::current_exe().unwrap())
        .arg(test);
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
    in_little_memory(
        "declared_lengths::lengths_of_a_billion_in_messages_take_no_memory",
        || {
            let little = Endian::Little;
            let raw =
                bags::payload_of(&bags::image(tenth(0), "mono8", (4, 4), vec![1; 16]), little);
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
                    // A lie in the stamp of the first image may put the three others before it.
                    assert!(
                        frames.len() <= 4 && fault.is_none(),
                        "{type_name}: {fault:?}"
                    );
                }
            }
        },
    );
}

#[test]
fn images_that_claim_huge_sizes_take_no_memory() {
    in_little_memory(
        "declared_lengths::images_that_claim_huge_sizes_take_no_memory",
        || {
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
                    splat_image::codec::compressed(&lying).is_err(),
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
                            splat_io::ros_image::raw(&message).is_err(),
                            "{encoding} {width}x{height} step {step}"
                        );
                        assert!(
                            splat_io::ros_image::depth(&message).is_err(),
                            "{encoding} {width}x{height} step {step}"
                        );
                    }
                }
            }
        },
    );
}

#[test]
fn lengths_of_a_billion_in_records_take_no_memory() {
    in_little_memory(
        "declared_lengths::lengths_of_a_billion_in_records_take_no_memory",
        || {
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
                    at +=
                        9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
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
        },
    );
}

/// A chunk whose checksum is zero, that is, not recorded: lengths inside it are all that protects.
#[test]
fn records_that_reach_out_of_their_chunk_are_a_fault() {
    in_little_memory(
        "declared_lengths::records_that_reach_out_of_their_chunk_are_a_fault",
        || {
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
        },
    );
}
