//! Time from a camera's bytes to a frame, 640x480 on one core: decoding, conversion to RGB, undistortion.
//!
//! The image is of a synthetic room with the noise of a cheap sensor, as JPEG of quality 85 with colour at half the
//! columns, as webcams send it, and of quality 90 with all colour, which is harder. The same JPEG through the crate
//! `image`, which decodes photos elsewhere, beside it.

use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use splat_image::jpeg::decoder::Jpeg;
use splat_image::limits::empty;
use splat_image::pixel_format::{PixelFormat, YuvColour};
use splat_image::undistort::Undistorter;
use splat_io::camera::driver::{Coding, Layout, decode};
use splat_io::intake::{Extras, Intake};
use splat_io::params::SourceParams;
use splat_mapper::params::settings::Settings;
use splat_synth::settings::SynthSettings;
use splat_synth::take::Take;
use splat_types::camera::{CameraModel, Distortion, Intrinsics};
use splat_types::image::RgbImage;
use splat_types::time::Stamp;

const WIDTH_PX: u32 = 640;
const HEIGHT_PX: u32 = 480;

criterion_group!(benches, frames, parts);
criterion_main!(benches);

fn test_image() -> RgbImage {
    let settings = SynthSettings::parse("room?frames=2&width=640&height=480&noise=3");
    let take = Take::new(settings.expect("a scene")).expect("a take");
    take.image(1)
}

/// As webcams send it: colour at half the columns.
fn webcam_jpeg_of(image: &RgbImage) -> Vec<u8> {
    jpeg_of(image, 85, SamplingFactor::R_4_2_2)
}

fn fine_jpeg_of(image: &RgbImage) -> Vec<u8> {
    jpeg_of(image, 90, SamplingFactor::R_4_4_4)
}

fn jpeg_of(image: &RgbImage, quality: u8, sampling: SamplingFactor) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(sampling);
    encoder
        .encode(
            &image.pixels,
            WIDTH_PX as u16,
            HEIGHT_PX as u16,
            ColorType::Rgb,
        )
        .expect("an RGB image");
    bytes
}

/// What an image's green would be as luma, and no colour: the time hangs on neither.
fn yuyv_of(image: &RgbImage) -> Vec<u8> {
    let pixels = image.pixels.as_chunks::<3>().0;
    pixels.iter().flat_map(|pixel| [pixel[1], 128]).collect()
}

fn layout(coding: Coding) -> Layout {
    Layout {
        width_px: WIDTH_PX,
        height_px: HEIGHT_PX,
        coding,
        step: 0,
        rate_hz: Some(30.0),
    }
}

fn lens() -> CameraModel {
    CameraModel {
        intrinsics: Intrinsics {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            fx: 500.0,
            fy: 500.0,
            cx: 322.0,
            cy: 239.0,
        },
        distortion: Distortion::PlumbBob([-0.28, 0.09, 0.0005, -0.0003, 0.0]),
    }
}

/// Bytes in, undistorted frame out, as the source's thread does it.
fn frames(c: &mut Criterion) {
    let params = Settings::shipped().params().expect("the defaults").source;
    let params = SourceParams {
        max_frames: 0,
        ..params
    };
    let raw = Coding::Raw(PixelFormat::Yuyv, YuvColour::default());
    let image = test_image();
    let mut group = c.benchmark_group("camera_frame_640x480");
    group.measurement_time(Duration::from_secs(4));
    for (name, coding, bytes) in [
        ("mjpeg", Coding::Mjpeg, webcam_jpeg_of(&image)),
        ("mjpeg_fine", Coding::Mjpeg, fine_jpeg_of(&image)),
        ("yuyv", raw, yuyv_of(&image)),
    ] {
        let mut intake = Intake::new(&params, Some(lens()));
        let mut jpeg = Jpeg::default();
        let layout = layout(coding);
        let mut nanos = 0;
        group.bench_function(name, |b| {
            b.iter(|| {
                nanos += 1;
                let arrival = intake.arrive(Stamp::from_nanos(nanos)).expect("in order");
                let mut image = intake.spare();
                decode(&layout, black_box(&bytes), &mut jpeg, &mut image).expect("an image");
                intake.frame(arrival, image, Extras::default())
            });
        });
    }
    group.finish();
}

fn parts(c: &mut Criterion) {
    let image = test_image();
    let bytes = webcam_jpeg_of(&image);
    let mut group = c.benchmark_group("camera_parts_640x480");
    group.measurement_time(Duration::from_secs(4));
    let mut out = empty();
    let mut jpeg = Jpeg::default();
    group.bench_function("jpeg", |b| {
        b.iter(|| jpeg.to_rgb(black_box(&bytes), &mut out));
    });
    group.bench_function("jpeg_by_image", |b| {
        b.iter(|| image::load_from_memory(black_box(&bytes)).map(image::DynamicImage::into_rgb8));
    });
    let rectifier = Undistorter::new(&lens()).expect("a lens");
    let mut source = image;
    group.bench_function("rectify", |b| {
        b.iter(|| rectifier.rectify_into(black_box(&mut source), &mut out));
    });
    group.finish();
}
