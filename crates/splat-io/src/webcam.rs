//! Cameras by nokhwa, on any system. It knows neither sequence numbers nor error flags, and its reads never time out,
//! so they are made on a thread of their own; images are stamped when they arrive.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver as Released, RecvTimeoutError, sync_channel};
use std::time::Duration;

use nokhwa::Camera as Nokhwa;
use nokhwa::utils::{
    CameraFormat, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType, Resolution,
};

use crate::camera::driver::{Camera, CapturedImage, Coding, Layout};
use crate::camera::live::Opener;
use crate::camera::modes::{FORMATS, Offer, names, ranked};
use crate::camera::stamps::ClockReading;
use crate::camera_error::CameraError;
use crate::error::SourceError;
use crate::params::{CameraParams, SourceParams};
use crate::queue::{Received, Receiver, Sender, WhenFull, queue};
use splat_types::time::{Stamp, monotonic_nanos};

/// Drivers may take seconds to open a camera, but not this long.
const OPEN_WITHIN: Duration = Duration::from_secs(10);
/// A thread that lets its camera go first reads one more image.
const RELEASED_WITHIN: Duration = Duration::from_secs(1);
/// Images that may wait; an older one is worth nothing.
const IMAGES: usize = 2;

/// What the reading thread says.
enum ReaderEvent {
    Open(Layout),
    Image {
        bytes: Vec<u8>,
        /// Of the images read, so that those show that had to make room.
        sequence: u32,
        arrived: ClockReading,
    },
    Failed(String),
}

/// A camera that streams on a thread of its own.
struct Webcam {
    name: String,
    layout: Layout,
    /// `None` once the camera is let go.
    events: Option<Receiver<ReaderEvent>>,
    /// Nothing comes here; its other end goes with the thread.
    is_released: Released<()>,
    /// Lent out as a `CapturedImage`.
    bytes: Vec<u8>,
}

/// Opens camera number `index`.
pub fn opener(index: &str, params: &SourceParams) -> Result<Opener, SourceError> {
    let uri = format!("webcam:{index}");
    let Ok(index) = index.parse::<u32>() else {
        return Err(SourceError::Uri { uri });
    };
    let wish = params.camera.clone();
    let is_reading = Arc::new(AtomicBool::new(false));
    Ok(Box::new(move || open(&uri, index, &wish, &is_reading)))
}

fn open(
    name: &str,
    index: u32,
    wish: &CameraParams,
    is_reading: &Arc<AtomicBool>,
) -> Result<Box<dyn Camera>, CameraError> {
    let fail = |reason: String| CameraError::Io {
        what: "open the camera",
        reason,
        path: name.into(),
    };
    // A read that hangs cannot be ended; a second thread would only hang beside it.
    if is_reading.swap(true, Ordering::AcqRel) {
        return Err(fail("its driver hangs in the last read".to_owned()));
    }
    let (tx, events) = queue("webcam", IMAGES, WhenFull::DropOldest);
    let (wish, is_done) = (wish.clone(), Arc::clone(is_reading));
    let (held, is_released) = sync_channel(0);
    let thread = std::thread::Builder::new().name("webcam".to_owned());
    let started = thread.spawn(move || {
        if let Err(reason) = read(index, &wish, &tx) {
            tx.send(ReaderEvent::Failed(reason)).ok();
        }
        is_done.store(false, Ordering::Release);
        drop(held);
    });
    started.map_err(|e| fail(e.to_string()))?;
    match events.recv_timeout(OPEN_WITHIN) {
        Received::Item(ReaderEvent::Open(layout)) => Ok(Box::new(Webcam {
            name: name.to_owned(),
            layout,
            events: Some(events),
            is_released,
            bytes: Vec::new(),
        })),
        Received::Item(ReaderEvent::Failed(reason)) => Err(fail(reason)),
        Received::Item(_) | Received::Nothing => Err(fail("its driver does not answer".to_owned())),
        Received::Ended => Err(fail("its thread ended".to_owned())),
    }
}

/// Reads until nobody listens.
fn read(index: u32, wish: &CameraParams, tx: &Sender<ReaderEvent>) -> Result<(), String> {
    let text = |e: nokhwa::NokhwaError| e.to_string();
    let all = FORMATS.iter().filter_map(|format| theirs(format.name));
    let all: Vec<FrameFormat> = all.collect();
    let any = RequestedFormat::with_formats(RequestedFormatType::AbsoluteHighestFrameRate, &all);
    let mut camera = Nokhwa::new(CameraIndex::Index(index), any).map_err(text)?;
    let offers = offers(&camera.compatible_camera_formats().map_err(text)?);
    let Some(mode) = ranked(&offers, wish).into_iter().next() else {
        return Err(format!(
            "none of the formats {}",
            names(&wish.formats).collect::<Vec<_>>().join(", ")
        ));
    };
    let format = theirs(mode.format.name).expect("offers are of known formats");
    let rate = mode.interval.map_or(30, |(_, images)| images);
    let size = Resolution::new(mode.width_px, mode.height_px);
    let exact = RequestedFormatType::Exact(CameraFormat::new(size, format, rate));
    let request = RequestedFormat::with_formats(exact, &all);
    camera.set_camera_requset(request).map_err(text)?;
    let taken = camera.camera_format();
    if (taken.resolution(), taken.format()) != (size, format) {
        return Err(format!("{mode} became {taken}"));
    }
    camera.open_stream().map_err(text)?;
    let layout = Layout {
        width_px: mode.width_px,
        height_px: mode.height_px,
        coding: mode.format.coding,
        step: 0,
        rate_hz: Some(f64::from(taken.frame_rate())),
    };
    let mut is_received = tx.send(ReaderEvent::Open(layout)).is_ok();
    let mut sequence = 0_u32;
    while is_received {
        let mut bytes = camera.frame_raw().map_err(text)?.into_owned();
        // On Linux, nokhwa hands out the whole buffer of the kernel.
        bytes.truncate(most_bytes(&layout));
        let image = ReaderEvent::Image {
            bytes,
            sequence,
            arrived: read_clocks(),
        };
        sequence = sequence.wrapping_add(1);
        is_received = tx.send(image).is_ok();
    }
    Ok(())
}

/// nokhwa's name of a format of ours.
fn theirs(name: &str) -> Option<FrameFormat> {
    match name {
        "mjpeg" => Some(FrameFormat::MJPEG),
        "yuyv" => Some(FrameFormat::YUYV),
        "nv12" => Some(FrameFormat::NV12),
        "grey" => Some(FrameFormat::GRAY),
        "rgb24" => Some(FrameFormat::RAWRGB),
        "bgr24" => Some(FrameFormat::RAWBGR),
        _ => None,
    }
}

fn offers(formats: &[CameraFormat]) -> Vec<Offer> {
    let offer = |found: &CameraFormat| {
        let format = FORMATS
            .iter()
            .find(|f| theirs(f.name) == Some(found.format()))?;
        Some(Offer {
            format: *format,
            width_px: found.width(),
            height_px: found.height(),
            intervals: vec![(1, found.frame_rate().max(1))],
        })
    };
    formats.iter().filter_map(offer).collect()
}

/// Bytes of a raw image; compressed ones end where they say.
fn most_bytes(layout: &Layout) -> usize {
    match layout.coding {
        Coding::Raw(format, _) => {
            format.row_bytes(layout.width_px) as usize * format.n_rows(layout.height_px) as usize
        }
        Coding::Mjpeg => usize::MAX,
    }
}

fn read_clocks() -> ClockReading {
    let before_nanos = monotonic_nanos();
    let wall = Stamp::now();
    ClockReading {
        before_nanos,
        wall,
        after_nanos: monotonic_nanos(),
    }
}

/// Who opens the camera next must not find it busy.
impl Drop for Webcam {
    fn drop(&mut self) {
        self.events = None;
        let released = self.is_released.recv_timeout(RELEASED_WITHIN);
        if released == Err(RecvTimeoutError::Timeout) {
            tracing::warn!("{} hangs in its last read", self.name);
        }
    }
}

impl Camera for Webcam {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn next(&mut self, wait: Duration) -> Result<Option<CapturedImage<'_>>, CameraError> {
        let gone = |reason: String| CameraError::Gone {
            reason,
            path: self.name.as_str().into(),
        };
        let Some(events) = &self.events else {
            return Err(gone("it was let go".to_owned()));
        };
        match events.recv_timeout(wait) {
            Received::Item(ReaderEvent::Image {
                bytes,
                sequence,
                arrived,
            }) => {
                self.bytes = bytes;
                Ok(Some(CapturedImage {
                    bytes: &self.bytes,
                    sequence: Some(sequence),
                    taken_nanos: Some(arrived.after_nanos),
                    is_damaged: false,
                    now: arrived,
                }))
            }
            Received::Item(ReaderEvent::Failed(reason)) => Err(gone(reason)),
            Received::Item(ReaderEvent::Open(_)) | Received::Nothing => Ok(None),
            Received::Ended => Err(gone("its thread ended".to_owned())),
        }
    }

    fn read_clocks(&self) -> ClockReading {
        read_clocks()
    }
}
