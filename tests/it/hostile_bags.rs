//! Damaged, lying and odd recordings: no panic, no memory beyond the bytes at hand, nothing false handed out.

use mcap::Compression;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::bags::{self, BagForm, BagWriter, Endian, tenth};
use crate::sources::{TOPIC, frames_of, params, sample_bag, saved};
use splat_io::frame_source::SourceCounts;
use splat_mapper::node::open_source;
use splat_msgs::ros::{CameraInfo, Image, Message};
use splat_types::frame::Frame;

/// Frames and fault of a recording; one that does not even open has no frames and its error as fault.
pub fn salvage(bytes: &[u8]) -> (Vec<Frame>, Option<String>) {
    let (_guard, path) = saved(bytes);
    match open_source::open(path.to_str().unwrap(), &params(), 0) {
        Ok(mut source) => {
            let frames = std::iter::from_fn(|| source.next()).collect();
            (frames, source.counts().fault)
        }
        Err(error) => (Vec::new(), Some(error.to_string())),
    }
}

pub fn small_chunks(compression: Option<Compression>) -> BagForm {
    BagForm {
        compression,
        chunk_bytes: 6000,
        ..BagForm::default()
    }
}

fn same_image(a: &Frame, b: &Frame) -> bool {
    a.stamp == b.stamp && a.image == b.image
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
                frames.iter().zip(&originals).all(|(a, b)| same_image(a, b)),
                "{form:?} cut at {cut}"
            );
            most = frames.len();
        }
        assert!(most >= 9, "{form:?}: {most} frames before the last byte");
    }
}

#[test]
fn flipped_bits_in_a_recording_with_checksums_never_change_a_image() {
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
                frames.iter().zip(&originals).all(|(a, b)| same_image(a, b)),
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
fn damaged_jpeg_and_png_are_undecodable_or_images_but_never_a_panic() {
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
            if let Ok(image) = splat_image::codec::compressed(&damaged) {
                assert_eq!(
                    image.pixels.len(),
                    (image.width_px * image.height_px * 3) as usize
                );
            }
            let cut = rng.random_range(0..whole.len() - 1);
            assert!(
                splat_image::codec::compressed(&whole[..cut]).is_err(),
                "cut at {cut} of {} decodes",
                whole.len()
            );
        }
    }
}

#[test]
fn odd_images_are_counted_and_the_rest_stays_in_use() {
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
            ..SourceCounts::default()
        }
    );
}

#[test]
fn a_image_of_one_pixel_is_a_frame() {
    let mut bag = BagWriter::new(BagForm::default());
    let dot = bags::image(tenth(0), "rgb8", (1, 1), vec![9, 8, 7]);
    bag.add(TOPIC, tenth(0), &dot);
    bag.add(
        "/camera/camera_info",
        tenth(0),
        &bags::camera_info((1, 1), "plumb_bob", &[-0.1]),
    );
    let (_guard, path) = saved(&bag.finish());
    let (frames, _) = frames_of(&path, &params());
    assert_eq!(frames[0].image.pixels, [9, 8, 7]);
    let mosaic = bags::image(tenth(0), "bayer_rggb8", (1, 1), vec![5]);
    assert_eq!(splat_io::ros_image::raw(&mosaic).unwrap().pixels.len(), 3);
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
