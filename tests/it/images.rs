//! Encodings of images -> their colours; working size and calibration follow each other.

use glam::{DVec2, DVec3};

use crate::bags::{self, BagForm, BagWriter, tenth};
use crate::sources::{TOPIC, check_pixel, params, pixel, replay};
use splat_io::params::SourceParams;
use splat_msgs::ros::Image;
use splat_types::camera::Intrinsics;

const SIZE: (u32, u32) = (8, 4);

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
            let image = splat_io::ros_image::raw(&message).unwrap();
            for y in 0..SIZE.1 {
                check_pixel(&image, (0, y), expected_left, 2, encoding);
                check_pixel(&image, (7, y), expected_right, 2, encoding);
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
        let image = splat_io::ros_image::raw(&message).unwrap();
        for y in 0..4 {
            check_pixel(&image, (0, y), [254, 0, 0], 2, "nv12");
            check_pixel(&image, (7, y), [0, 0, 255], 2, "nv12");
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
            let image = splat_io::ros_image::raw(&message).unwrap();
            if size.0 > 2 {
                for y in 1..size.1 - 1 {
                    (1..size.0 - 1).for_each(|x| check_pixel(&image, (x, y), colour, 1, name));
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
            let image = splat_image::codec::compressed(&message.data).unwrap();
            assert_eq!((image.width_px, image.height_px), (64, 48));
            check_pixel(&image, (30, 20), [180, 60, 20], 4, format);
        }
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
fn binning_and_cut_move_the_calibration_with_the_image() {
    let mut info = bags::camera_info((640, 480), "", &[]);
    info.k = [400.0, 0.0, 319.5, 0.0, 400.0, 239.5, 0.0, 0.0, 1.0];
    (info.binning_x, info.binning_y) = (2, 2);
    info.roi.x_offset = 40;
    (info.roi.width, info.roi.height) = (560, 480);
    let lens = splat_io::calibration::lens_of_camera_info(&info, false).unwrap();
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
fn a_large_image_is_scaled_down_and_its_intrinsics_follow() {
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
fn distorted_frames_come_out_rectified_unless_given_otherwise() {
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
        rectified[0].sensor_depth.as_ref().unwrap().depth,
        vec![3.0; 64 * 48]
    );
    assert_ne!(rectified[0].image.pixels, raw[0].image.pixels);
}
