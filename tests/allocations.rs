//! A camera's frames cost no memory once the first ones have passed. Alone in its binary, since it counts allocations.
#![allow(clippy::unwrap_used, reason = "tests")]
#![expect(unsafe_code, reason = "an allocator is unsafe to write")]

use std::alloc::{GlobalAlloc, Layout as Memory, System};
use std::cell::Cell;
use std::time::Duration;

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use splat_image::pixel_format::{PixelFormat, YuvColour};
use splat_io::camera::driver::{Camera, CapturedImage, Coding, Layout};
use splat_io::camera::source::CameraSource;
use splat_io::camera::stamps::ClockReading;
use splat_io::camera_error::CameraError;
use splat_io::frame_source::Source;
use splat_io::params::SourceParams;
use splat_mapper::params::settings::Settings;
use splat_types::time::Stamp;

const WIDTH_PX: u32 = 640;
const HEIGHT_PX: u32 = 480;

thread_local! {
    static N_ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, with a count per thread.
struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

// SAFETY: everything is handed to the system's allocator as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, memory: Memory) -> *mut u8 {
        N_ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: the caller keeps the contract.
        unsafe { System.alloc(memory) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, memory: Memory) {
        // SAFETY: the caller keeps the contract.
        unsafe { System.dealloc(pointer, memory) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, memory: Memory, n_bytes: usize) -> *mut u8 {
        N_ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: the caller keeps the contract.
        unsafe { System.realloc(pointer, memory, n_bytes) }
    }
}

fn counted(work: impl FnOnce()) -> u64 {
    let before = N_ALLOCATIONS.with(Cell::get);
    work();
    N_ALLOCATIONS.with(Cell::get) - before
}

/// Sends the same bytes again and again, a tenth of a second apart.
struct Endless {
    layout: Layout,
    bytes: Vec<u8>,
    n: u32,
}

impl Camera for Endless {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn next(&mut self, _wait: Duration) -> Result<Option<CapturedImage<'_>>, CameraError> {
        self.n += 1;
        let now = self.read_clocks();
        Ok(Some(CapturedImage {
            bytes: &self.bytes,
            sequence: Some(self.n),
            taken_nanos: Some(now.after_nanos),
            is_damaged: false,
            now,
        }))
    }

    fn read_clocks(&self) -> ClockReading {
        let nanos = i64::from(self.n) * 100_000_000;
        ClockReading {
            before_nanos: nanos,
            wall: Stamp::from_nanos(nanos),
            after_nanos: nanos,
        }
    }
}

fn source(coding: Coding, bytes: Vec<u8>) -> CameraSource {
    let folder = tempfile::tempdir().unwrap();
    let url = folder.path().join("camera.yaml");
    let text = "image_width: 640\nimage_height: 480\n\
        camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n\
        distortion_model: plumb_bob\n\
        distortion_coefficients: {rows: 1, cols: 5, data: [-0.28, 0.09, 0, 0, 0]}\n";
    std::fs::write(&url, text).unwrap();
    let params = SourceParams {
        camera_info_url: url.to_str().unwrap().to_owned(),
        ..Settings::shipped().params().unwrap().source
    };
    let opener = Box::new(move || {
        let layout = Layout {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            coding,
            step: 0,
            rate_hz: Some(10.0),
        };
        let bytes = bytes.clone();
        Ok(Box::new(Endless {
            layout,
            bytes,
            n: 0,
        }) as Box<dyn Camera>)
    });
    CameraSource::open("endless".to_owned(), opener, &params).unwrap()
}

/// Allocations of a hundred frames after the first twenty, while some are still held as the queues hold them.
fn per_hundred_frames(mut source: CameraSource) -> u64 {
    let mut held = std::collections::VecDeque::with_capacity(8);
    let mut step = || {
        held.push_back(source.next().unwrap());
        if held.len() > 6 {
            held.pop_front();
        }
    };
    for _ in 0..20 {
        step();
    }
    counted(|| {
        for _ in 0..100 {
            step();
        }
    })
}

#[test]
fn raw_images_become_undistorted_frames_without_an_allocation() {
    for (format, n_bytes) in [
        (PixelFormat::Yuyv, 2 * WIDTH_PX * HEIGHT_PX),
        (PixelFormat::Nv12, 3 * WIDTH_PX * HEIGHT_PX / 2),
        (PixelFormat::Rgb, 3 * WIDTH_PX * HEIGHT_PX),
        (PixelFormat::Grey, WIDTH_PX * HEIGHT_PX),
    ] {
        let coding = Coding::Raw(format, YuvColour::default());
        let n = per_hundred_frames(source(coding, vec![90; n_bytes as usize]));
        assert_eq!(n, 0, "{format:?}");
    }
}

#[test]
fn jpeg_images_become_undistorted_frames_without_an_allocation() {
    let pixels: Vec<u8> = (0..3 * WIDTH_PX * HEIGHT_PX)
        .map(|ix| (ix % 253) as u8)
        .collect();
    for sampling in [
        SamplingFactor::R_4_4_4,
        SamplingFactor::R_4_2_2,
        SamplingFactor::R_4_2_0,
    ] {
        let mut bytes = Vec::new();
        let mut encoder = Encoder::new(&mut bytes, 85);
        encoder.set_sampling_factor(sampling);
        let (width, height) = (WIDTH_PX as u16, HEIGHT_PX as u16);
        encoder
            .encode(&pixels, width, height, ColorType::Rgb)
            .unwrap();
        let n = per_hundred_frames(source(Coding::Mjpeg, bytes));
        assert_eq!(n, 0, "{sampling:?}");
    }
}
