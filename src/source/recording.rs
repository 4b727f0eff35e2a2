//! Cameras and other sources -> an MCAP recording that a crash cannot spoil.
//!
//! Pictures of a camera are written as they came: JPEG untouched, raw pixels with their padding. Frames of other
//! sources are written as the mapper would see them: scaled, undistorted, without loss.

mod file;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use crate::camera::{Distortion, Lens};
use crate::clock::{Stamp, Stopwatch};
use crate::config::{RecordParams, SourceParams};
use crate::frame::Frame;
use crate::queue::{Receiver, Sender, WhenFull, queue};
use crate::ros::{CameraInfo, CompressedImage, Header, Image};
use crate::source::bag_writer::camera_info;
use crate::source::camera::live::Live;
use crate::source::camera::{self, Coding, Layout};
use crate::source::decode::empty;
use crate::source::jpeg::Jpeg;
use crate::source::pixels::{PixelFormat, YuvColour};
use crate::source::recording::file::Files;
use crate::source::{Polled, Source, SourceError, camera_info as calibration, camera_opener};

/// Pictures between the camera and the disk.
const PICTURES: usize = 16;
/// How often Ctrl-C is looked for while a source waits for the world.
const PATIENCE: Duration = Duration::from_millis(100);
/// Seconds between two words on the progress.
const WORD_SECS: f64 = 1.0;

#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error(transparent)]
    Source(#[from] SourceError),
    #[error(
        "a file of that name is there; name another one, or remove it: {}",
        path.display()
    )]
    Exists { path: PathBuf },
    #[error(
        "cannot write the recording: {reason}; what was written before can be read: {}",
        path.display()
    )]
    Write { reason: String, path: PathBuf },
}

/// What is wanted.
#[derive(Debug, Clone)]
pub struct Wanted {
    /// Source URI.
    pub source: String,
    pub out: PathBuf,
    /// Of wall time for a camera, of the stamps for other sources.
    pub duration_secs: Option<f64>,
    pub seed: u64,
}

/// How far a recording is, and what it came to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    pub n_pictures: u64,
    pub secs: f64,
    pub n_bytes: u64,
    /// Pictures that never came from the camera, or that the disk was too slow for.
    pub n_dropped: u64,
    pub n_damaged: u64,
    pub n_files: u64,
}

/// A picture as a message.
#[derive(Debug)]
enum Body {
    Jpeg(Vec<u8>),
    Raw(Image),
}

#[derive(Debug)]
struct Picture {
    stamp: Stamp,
    body: Body,
    info: Option<CameraInfo>,
}

/// What the writing thread tells.
#[derive(Debug, Default)]
struct Written {
    n_bytes: AtomicU64,
    n_files: AtomicU64,
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
    wanted: &Wanted,
    source: &SourceParams,
    params: &RecordParams,
    asked: &Arc<AtomicBool>,
    on_progress: &mut dyn FnMut(&Progress),
) -> Result<Progress, RecordError> {
    let input = open(wanted, source, asked)?;
    record_from(input, wanted, params, asked, on_progress)
}

/// The same from an input that is open.
pub fn record_from(
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
    let (pictures, to_write) = queue("pictures", PICTURES, when_full);
    let thread = std::thread::Builder::new().name("record".to_owned());
    let writer = thread.spawn(move || write(files, &to_write));
    let writer = writer.map_err(|e| RecordError::Write {
        reason: e.to_string(),
        path: wanted.out.clone(),
    })?;
    let watch = Stopwatch::start();
    let mut shown = Stopwatch::start();
    let mut progress = Progress::default();
    let mut tell = |progress: &mut Progress, pictures: &Sender<Picture>| {
        progress.secs = watch.secs();
        progress.n_bytes = written.n_bytes.load(Ordering::Relaxed);
        progress.n_files = written.n_files.load(Ordering::Relaxed);
        if shown.secs() > WORD_SECS {
            shown = Stopwatch::start();
            on_progress(&without_late(*progress, pictures.dropped()));
        }
    };
    match input {
        Input::Camera(live, info) => {
            from_camera(*live, info.as_deref(), &pictures, &mut progress, &mut tell);
        }
        Input::Frames(source) => {
            let duration = wanted.duration_secs.unwrap_or(f64::INFINITY);
            let until = (asked.as_ref(), duration);
            from_frames(source, until, &pictures, &mut progress, &mut tell);
        }
    }
    let mut progress = without_late(progress, pictures.dropped());
    drop(pictures);
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

/// Pictures that the disk was too slow for are dropped ones.
fn without_late(progress: Progress, n_late: u64) -> Progress {
    Progress {
        n_pictures: progress.n_pictures - n_late,
        n_dropped: progress.n_dropped + n_late,
        ..progress
    }
}

fn open(
    wanted: &Wanted,
    params: &SourceParams,
    asked: &Arc<AtomicBool>,
) -> Result<Input, SourceError> {
    let Some(opener) = camera_opener(&wanted.source, params) else {
        let mut source = super::open(&wanted.source, params, wanted.seed)?;
        source.end_when(asked);
        return Ok(Input::Frames(source));
    };
    let info = calibration::of_url(&params.camera_info_url)?;
    let mut live = Live::open(wanted.source.clone(), opener?)?;
    live.end_when(asked);
    if let Some(secs) = wanted.duration_secs {
        live.end_after(secs);
    }
    Ok(Input::Camera(
        Box::new(live),
        info.map(|(info, _)| Box::new(info)),
    ))
}

fn from_camera(
    mut live: Live,
    info: Option<&CameraInfo>,
    pictures: &Sender<Picture>,
    progress: &mut Progress,
    tell: &mut dyn FnMut(&mut Progress, &Sender<Picture>),
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
        if pictures.send(Picture { stamp, body, info }).is_err() {
            return;
        }
        progress.n_pictures += 1;
        tell(progress, pictures);
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
        let mut picture = empty();
        camera::decode(layout, bytes, jpeg, &mut picture).ok()?;
        return Some(Body::Raw(image(
            width,
            height,
            PixelFormat::Rgb,
            3 * width,
            picture.pixels,
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
    pictures: &Sender<Picture>,
    progress: &mut Progress,
    tell: &mut dyn FnMut(&mut Progress, &Sender<Picture>),
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
        if pictures.send(picture_of(&frame)).is_err() {
            return;
        }
        progress.n_pictures += 1;
        tell(progress, pictures);
    }
}

fn picture_of(frame: &Frame) -> Picture {
    let (width, height) = (frame.image.width_px, frame.image.height_px);
    let data = frame.image.pixels.clone();
    let info = frame.intrinsics.map(|intrinsics| {
        let lens = Lens {
            intrinsics,
            distortion: Distortion::None,
        };
        camera_info(&lens, Header::default())
    });
    Picture {
        stamp: frame.stamp,
        body: Body::Raw(image(width, height, PixelFormat::Rgb, 3 * width, data)),
        info,
    }
}

fn write(mut files: Files, pictures: &Receiver<Picture>) -> Result<(), RecordError> {
    while let Some(picture) = pictures.recv() {
        files.write(picture)?;
    }
    files.finish()
}

impl Picture {
    /// The messages that carry it, under this frame's name.
    fn messages(self, frame_id: &str) -> (Result<CompressedImage, Image>, Option<CameraInfo>) {
        let header = Header {
            stamp: self.stamp.into(),
            frame_id: frame_id.to_owned(),
        };
        let info = self.info.map(|info| CameraInfo {
            header: header.clone(),
            ..info
        });
        let picture = match self.body {
            Body::Jpeg(data) => Ok(CompressedImage {
                header,
                format: "jpeg".to_owned(),
                data,
            }),
            Body::Raw(image) => Err(Image { header, ..image }),
        };
        (picture, info)
    }
}
