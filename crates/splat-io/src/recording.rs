//! Cameras and other sources -> an MCAP recording that a crash cannot spoil.
//!
//! Images of a camera are written as they came: JPEG untouched, raw pixels with their padding. Frames of other
//! sources are written as the mapper would see them: scaled, undistorted, without loss.

pub mod item;

mod file;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::bag_writer::camera_info;
use crate::camera::driver::{self, Coding, Layout};
use crate::camera::live::Live;
use crate::frame_source::{Polled, Source};
use crate::params::RecordParams;
use crate::queue::{Receiver, Sender, WhenFull, queue};
use crate::recording::file::Files;
use crate::recording::item::{Body, RecordError, RecordedImage, Written};
use splat_image::jpeg::decoder::Jpeg;
use splat_image::limits::empty;
use splat_image::pixel_format::{PixelFormat, YuvColour};
use splat_msgs::ros::{CameraInfo, Header, Image};
use splat_types::camera::{CameraModel, Distortion};
use splat_types::frame::Frame;
use splat_types::time::Stopwatch;

/// Images between the camera and the disk.
const IMAGES: usize = 16;
/// How often Ctrl-C is looked for while a source waits for the world.
const PATIENCE: Duration = Duration::from_millis(100);
/// Seconds between two words on the progress.
const WORD_SECS: f64 = 1.0;

/// What is wanted.
#[derive(Debug, Clone)]
pub struct Wanted {
    pub out: PathBuf,
    /// Of wall time for a camera, of the stamps for other sources.
    pub duration_secs: Option<f64>,
}

/// How far a recording is, and what it came to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    pub n_images: u64,
    pub secs: f64,
    pub n_bytes: u64,
    /// Images that never came from the camera, or that the disk was too slow for.
    pub n_dropped: u64,
    pub n_damaged: u64,
    pub n_files: u64,
}

/// What is recorded.
pub enum Input {
    /// As it comes, with its calibration.
    Camera(Box<Live>, Option<Box<CameraInfo>>),
    Frames(Box<dyn Source>),
}

impl std::fmt::Debug for Input {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Camera(live, _) => write!(f, "Camera({live:?})"),
            Self::Frames(_) => write!(f, "Frames"),
        }
    }
}

/// Records until the end of the source, of the duration, or until asked.
pub fn record(
    input: Input,
    wanted: &Wanted,
    params: &RecordParams,
    asked: &Arc<AtomicBool>,
    on_progress: &mut dyn FnMut(&Progress),
) -> Result<Progress, RecordError> {
    let written = Arc::new(Written::default());
    let files = Files::create(&wanted.out, params, &written)?;
    let when_full = match &input {
        Input::Camera(..) => WhenFull::DropOldest,
        Input::Frames(source) if source.is_live() => WhenFull::DropOldest,
        Input::Frames(_) => WhenFull::Wait,
    };
    let (images, to_write) = queue("images", IMAGES, when_full);
    let thread = std::thread::Builder::new().name("record".to_owned());
    let writer = thread.spawn(move || write(files, &to_write));
    let writer = writer.map_err(|e| RecordError::Write {
        reason: e.to_string(),
        path: wanted.out.clone(),
    })?;
    let watch = Stopwatch::start();
    let mut shown = Stopwatch::start();
    let mut progress = Progress::default();
    let mut report = |progress: &mut Progress, images: &Sender<RecordedImage>| {
        progress.secs = watch.secs();
        progress.n_bytes = written.n_bytes.load(Ordering::Relaxed);
        progress.n_files = written.n_files.load(Ordering::Relaxed);
        if shown.secs() > WORD_SECS {
            shown = Stopwatch::start();
            on_progress(&without_late(*progress, images.dropped()));
        }
    };
    match input {
        Input::Camera(live, info) => {
            from_camera(*live, info.as_deref(), &images, &mut progress, &mut report);
        }
        Input::Frames(source) => {
            let duration = wanted.duration_secs.unwrap_or(f64::INFINITY);
            let until = (asked.as_ref(), duration);
            from_frames(source, until, &images, &mut progress, &mut report);
        }
    }
    let mut progress = without_late(progress, images.dropped());
    drop(images);
    let done = writer.join().unwrap_or_else(|_| {
        Err(RecordError::Write {
            reason: "the writing thread broke".to_owned(),
            path: wanted.out.clone(),
        })
    });
    progress.secs = watch.secs();
    progress.n_bytes = written.n_bytes.load(Ordering::Relaxed);
    progress.n_files = written.n_files.load(Ordering::Relaxed);
    done.map(|()| progress)
}

/// Images that the disk was too slow for are dropped ones.
fn without_late(progress: Progress, n_late: u64) -> Progress {
    Progress {
        n_images: progress.n_images - n_late,
        n_dropped: progress.n_dropped + n_late,
        ..progress
    }
}

fn from_camera(
    mut live: Live,
    info: Option<&CameraInfo>,
    images: &Sender<RecordedImage>,
    progress: &mut Progress,
    report: &mut dyn FnMut(&mut Progress, &Sender<RecordedImage>),
) {
    let mut jpeg = Jpeg::default();
    loop {
        let body = live.next(|layout, stamp, bytes| (stamp, body_of(layout, bytes, &mut jpeg)));
        let tally = live.take_tally();
        progress.n_dropped += tally.missed;
        progress.n_damaged += tally.damaged;
        let Some((stamp, body)) = body else {
            return;
        };
        let Some(body) = body else {
            progress.n_damaged += 1;
            continue;
        };
        let info = info.cloned();
        if images.send(RecordedImage { stamp, body, info }).is_err() {
            return;
        }
        progress.n_images += 1;
        report(progress, images);
    }
}

/// `None` for raw pixels that are not all there.
fn body_of(layout: &Layout, bytes: &[u8], jpeg: &mut Jpeg) -> Option<Body> {
    let (width, height) = (layout.width_px, layout.height_px);
    let Coding::Raw(format, colour) = layout.coding else {
        return Some(Body::Jpeg(bytes.to_vec()));
    };
    // A message cannot say that its colours are unusual.
    if format.is_yuv() && colour != YuvColour::default() {
        let mut rgb_image = empty();
        driver::decode(layout, bytes, jpeg, &mut rgb_image).ok()?;
        return Some(Body::Raw(image(
            width,
            height,
            PixelFormat::Rgb,
            3 * width,
            rgb_image.pixels,
        )));
    }
    let step = match layout.step {
        0 => format.row_bytes(width),
        step => step,
    };
    let n_bytes = step as usize * format.n_rows(height) as usize;
    let data = bytes.get(..n_bytes)?.to_vec();
    Some(Body::Raw(image(width, height, format, step, data)))
}

fn image(width: u32, height: u32, format: PixelFormat, step: u32, data: Vec<u8>) -> Image {
    Image {
        header: Header::default(),
        height,
        width,
        encoding: format.ros_name().to_owned(),
        is_bigendian: 0,
        step,
        data,
    }
}

fn from_frames(
    mut source: Box<dyn Source>,
    (asked, duration_secs): (&AtomicBool, f64),
    images: &Sender<RecordedImage>,
    progress: &mut Progress,
    report: &mut dyn FnMut(&mut Progress, &Sender<RecordedImage>),
) {
    let mut first = None;
    while !asked.load(Ordering::Relaxed) {
        let polled = source.poll(PATIENCE);
        let counts = source.counts();
        progress.n_damaged = counts.undecodable;
        progress.n_dropped = counts.dropped;
        let frame = match polled {
            Polled::Frame(frame) => frame,
            Polled::Waiting => continue,
            Polled::Ended => return,
        };
        let first = *first.get_or_insert(frame.stamp);
        if frame.stamp.secs_since(first) > duration_secs {
            return;
        }
        if images.send(image_of(&frame)).is_err() {
            return;
        }
        progress.n_images += 1;
        report(progress, images);
    }
}

fn image_of(frame: &Frame) -> RecordedImage {
    let (width, height) = (frame.image.width_px, frame.image.height_px);
    let data = frame.image.pixels.clone();
    let info = frame.intrinsics.map(|intrinsics| {
        let lens = CameraModel {
            intrinsics,
            distortion: Distortion::None,
        };
        camera_info(&lens, Header::default())
    });
    RecordedImage {
        stamp: frame.stamp,
        body: Body::Raw(image(width, height, PixelFormat::Rgb, 3 * width, data)),
        info,
    }
}

fn write(mut files: Files, images: &Receiver<RecordedImage>) -> Result<(), RecordError> {
    while let Some(image) = images.recv() {
        files.write(image)?;
    }
    files.finish()
}
