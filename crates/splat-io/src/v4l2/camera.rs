//! Cameras by Video4Linux: sequence numbers, error flags, the kernel's stamps, waits that end.
//!
//! Single-planar capture into mapped memory. What comes out is as the camera sends it; `source::camera` makes frames of it.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::camera::driver::{Camera, CapturedImage, Coding, Layout};
use crate::camera::live::Opener;
use crate::camera::modes::{Format, Mode, hz, names, ranked};
use crate::camera::stamps::ClockReading;
use crate::camera_error::CameraError;
use crate::params::{CameraParams, SourceParams};
use crate::v4l2::answers::{Caps, Taken};
use crate::v4l2::controls;
use crate::v4l2::list::place_of;
use crate::v4l2::probe::{fault, letters, name_of, offers, open_device};
use crate::v4l2::sys::{Device, Filled, Stream};

const BUFFER_IS_DAMAGED: u32 = 0x40;
const STAMP_KIND: u32 = 0xe000;
const STAMP_IS_MONOTONIC: u32 = 0x2000;
/// Modes that are asked for before a camera counts as refusing all.
const MAX_TRIED: usize = 12;

/// A camera that streams.
#[derive(Debug)]
pub struct V4l2Camera {
    path: PathBuf,
    layout: Layout,
    stream: Stream,
    /// Handed out as a `CapturedImage`, and given back when the next one is asked for.
    lent: Option<Filled>,
}

/// Opens `/dev/video0`, or `/dev/v4l/by-id/...`, which stays the same when cameras change places; also when the camera has
/// come back under another name.
pub fn opener(path: &Path, params: &SourceParams) -> Opener {
    let (path, wish) = (path.to_owned(), params.camera.clone());
    let mut identity: Option<(String, String)> = None;
    Box::new(move || {
        let found = match &identity {
            Some(identity) => place_of(&path, identity),
            None => path.clone(),
        };
        let (camera, caps) = V4l2Camera::open(&found, &wish)?;
        match &identity {
            Some((card, _)) if *card != caps.card => {
                let reason = format!("it was {card}, there is {}", caps.card);
                return Err(CameraError::NotCamera {
                    reason,
                    path: found,
                });
            }
            _ => identity = Some((caps.card, caps.bus)),
        }
        Ok(Box::new(camera) as Box<dyn Camera>)
    })
}

impl V4l2Camera {
    fn open(path: &Path, wish: &CameraParams) -> Result<(Self, Caps), CameraError> {
        let (device, caps) = open_device(path)?;
        let offers = offers(&device, (wish.width, wish.height), wish.rate);
        let modes = ranked(&offers, wish);
        if modes.is_empty() {
            let codes = device.formats().into_iter().map(letters);
            return Err(CameraError::Format {
                wanted: names(&wish.formats).collect::<Vec<_>>().join(", "),
                found: codes.collect::<Vec<_>>().join(", "),
                path: path.to_owned(),
            });
        }
        let layout = negotiate(&device, &modes, path)?;
        controls::apply(&device, wish);
        let stream = Stream::start(&device, wish.buffers)
            .map_err(|e| fault("start the camera", &e, path))?;
        let rate = layout
            .rate_hz
            .map(|hz| format!(" at {hz:.4} Hz"))
            .unwrap_or_default();
        tracing::info!(
            "{} ({}) sends {} {}x{}{rate}: {}",
            caps.card,
            caps.bus,
            name_of(&layout),
            layout.width_px,
            layout.height_px,
            path.display()
        );
        let camera = Self {
            path: path.to_owned(),
            layout,
            stream,
            lent: None,
        };
        Ok((camera, caps))
    }

    fn take(&mut self, wait: Duration) -> io::Result<Option<Filled>> {
        if let Some(lent) = self.lent.take() {
            self.stream.give_back(lent)?;
        }
        if !self.stream.wait(wait)? {
            return Ok(None);
        }
        self.stream.take()
    }
}

/// The first mode that the driver takes as it was asked: drivers answer with another format instead of an error.
fn negotiate(device: &Device, modes: &[Mode], path: &Path) -> Result<Layout, CameraError> {
    let mut refusals = Vec::new();
    for mode in modes.iter().take(MAX_TRIED) {
        let code = u32::from_le_bytes(mode.format.fourcc);
        let taken = match device.set_format(code, mode.width_px, mode.height_px) {
            Ok(taken) => taken,
            Err(e) if matches!(e.raw_os_error(), Some(libc::EINVAL)) => {
                refusals.push(format!("{mode}: {e}"));
                continue;
            }
            Err(e) => return Err(fault("set the camera's format", &e, path)),
        };
        let is_same =
            (taken.fourcc, taken.width, taken.height) == (code, mode.width_px, mode.height_px);
        if !is_same || !taken.is_whole() {
            refusals.push(refusal(mode, &taken));
            continue;
        }
        // Many drivers fix the rate; what they say then is what they do.
        let rate_hz = mode.interval.and_then(|interval| {
            let taken = device.set_interval(interval);
            taken.ok().flatten().or(Some(hz(interval)))
        });
        return Ok(layout_of(&mode.format, &taken, rate_hz));
    }
    Err(CameraError::Refused {
        refusals: refusals.join("; "),
        path: path.to_owned(),
    })
}

fn refusal(mode: &Mode, taken: &Taken) -> String {
    let (found, w, h) = (letters(taken.fourcc), taken.width, taken.height);
    if taken.is_whole() {
        format!("{mode} became {found} {w}x{h}")
    } else {
        format!("{mode} comes in single fields")
    }
}

fn layout_of(format: &Format, taken: &Taken, rate_hz: Option<f64>) -> Layout {
    let coding = match format.coding {
        Coding::Mjpeg => Coding::Mjpeg,
        Coding::Raw(format, _) => Coding::Raw(format, taken.colour()),
    };
    Layout {
        width_px: taken.width,
        height_px: taken.height,
        coding,
        step: taken.step,
        rate_hz,
    }
}

impl Camera for V4l2Camera {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn next(&mut self, wait: Duration) -> Result<Option<CapturedImage<'_>>, CameraError> {
        let filled = match self.take(wait) {
            Ok(filled) => filled,
            Err(e) if e.raw_os_error() == Some(libc::ENODEV) => {
                return Err(fault("read the camera", &e, &self.path));
            }
            Err(e) => {
                return Err(CameraError::Io {
                    what: "go on reading the camera",
                    reason: e.to_string(),
                    path: self.path.clone(),
                });
            }
        };
        let Some(filled) = filled else {
            return Ok(None);
        };
        self.lent = Some(filled);
        let is_monotonic = filled.flags & STAMP_KIND == STAMP_IS_MONOTONIC;
        Ok(Some(CapturedImage {
            bytes: self.stream.bytes(&filled),
            sequence: Some(filled.sequence),
            taken_nanos: is_monotonic.then_some(filled.taken_nanos),
            is_damaged: filled.flags & BUFFER_IS_DAMAGED != 0,
            now: crate::v4l2::sys::read_clocks(),
        }))
    }

    fn read_clocks(&self) -> ClockReading {
        crate::v4l2::sys::read_clocks()
    }
}

/// Sets one control by its name through a handle of its own, which drivers allow while someone streams.
pub fn set_control(path: &Path, name: &str, value: i32) -> Result<(), CameraError> {
    let (device, _) = open_device(path)?;
    controls::set(&device, name, value).map_err(|reason| CameraError::Io {
        what: "set a control",
        reason,
        path: path.to_owned(),
    })
}
