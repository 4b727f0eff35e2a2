//! Time from a camera's bytes to a frame, 640x480 on one core: decoding, conversion to RGB, undistortion.
//!
//! The picture is of a made-up room with the noise of a cheap sensor, as JPEG of quality 85 with colour at half the
//! columns, as webcams send it, and of quality 90 with all colour, which is harder. The same JPEG through the crate
//! `image`, which decodes photos elsewhere, beside it.

use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use splat_mapper::camera::{Distortion, Intrinsics, Lens};
use splat_mapper::clock::Stamp;
use splat_mapper::config::{Settings, SourceParams};
use splat_mapper::frame::RgbImage;
use splat_mapper::source::camera::{Coding, Layout, decode};
use splat_mapper::source::decode::empty;
use splat_mapper::source::intake::{Extras, Intake};
use splat_mapper::source::jpeg::Jpeg;
use splat_mapper::source::pixels::{PixelFormat, YuvColour};
use splat_mapper::source::rectify::Rectifier;
use splat_mapper::source::synthetic::SynthSettings;
use splat_mapper::source::synthetic::take::Take;

const WIDTH_PX: u32 = 640;
const HEIGHT_PX: u32 = 480;

criterion_group!(benches, frames, parts);
criterion_main!(benches);

fn picture() -> RgbImage {
    let settings = SynthSettings::parse("room?frames=2&width=640&height=480&noise=3");
    let take = Take::new(settings.expect("a scene")).expect("a take");
    take.picture(1)
}

/// As webcams send it: colour at half the columns.
fn webcam_jpeg_of(picture: &RgbImage) -> Vec<u8> {
    jpeg_of(picture, 85, SamplingFactor::R_4_2_2)
}

fn fine_jpeg_of(picture: &RgbImage) -> Vec<u8> {
    jpeg_of(picture, 90, SamplingFactor::R_4_4_4)
}

fn jpeg_of(picture: &RgbImage, quality: u8, sampling: SamplingFactor) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(sampling);
    encoder
        .encode(
            &picture.pixels,
            WIDTH_PX as u16,
            HEIGHT_PX as u16,
            ColorType::Rgb,
        )
        .expect("an RGB picture");
    bytes
}

/// What a picture's green would be as luma, and no colour: the time hangs on neither.
fn yuyv_of(picture: &RgbImage) -> Vec<u8> {
    let pixels = picture.pixels.as_chunks::<3>().0;
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

fn lens() -> Lens {
    Lens {
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
    let picture = picture();
    let mut group = c.benchmark_group("camera_frame_640x480");
    group.measurement_time(Duration::from_secs(4));
    for (name, coding, bytes) in [
        ("mjpeg", Coding::Mjpeg, webcam_jpeg_of(&picture)),
        ("mjpeg_fine", Coding::Mjpeg, fine_jpeg_of(&picture)),
        ("yuyv", raw, yuyv_of(&picture)),
    ] {
        let mut intake = Intake::new(&params, Some(lens()));
        let mut jpeg = Jpeg::default();
        let layout = layout(coding);
        let mut nanos = 0;
        group.bench_function(name, |b| {
            b.iter(|| {
                nanos += 1;
                let arrival = intake.arrive(Stamp::from_nanos(nanos)).expect("in order");
                let mut picture = intake.spare();
                decode(&layout, black_box(&bytes), &mut jpeg, &mut picture).expect("a picture");
                intake.frame(arrival, picture, Extras::default())
            });
        });
    }
    group.finish();
}

fn parts(c: &mut Criterion) {
    let picture = picture();
    let bytes = webcam_jpeg_of(&picture);
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
    let rectifier = Rectifier::new(&lens()).expect("a lens");
    let mut source = picture;
    group.bench_function("rectify", |b| {
        b.iter(|| rectifier.rectify_into(black_box(&mut source), &mut out));
    });
    group.finish();
}
