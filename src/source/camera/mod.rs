//! Cameras that are there now -> frames, whatever drives them.
//!
//! `v4l2` and `webcam` say how a camera is opened and read; what happens when it stops, and how pictures become
//! frames, stands here once for both.

pub mod live;
pub mod modes;
pub mod stamps;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::clock::Stamp;
use crate::config::SourceParams;
use crate::frame::{Frame, RgbImage};
use crate::queue::Received;
use crate::source::camera::live::{Live, Opener};
use crate::source::camera::stamps::ClockReading;
use crate::source::decode::DecodeError;
use crate::source::intake::{Extras, Intake};
use crate::source::jpeg::Jpeg;
use crate::source::pixels::{PixelFormat, Pixels, YuvColour, to_rgb};
use crate::source::{Polled, Source, SourceCounts, SourceError, camera_info};

/// What the pictures of an open camera are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    pub width_px: u32,
    pub height_px: u32,
    pub coding: Coding,
    /// Bytes from one row to the next; 0 = rows are packed.
    pub step: u32,
    /// As the camera states it.
    pub rate_hz: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coding {
    Mjpeg,
    Raw(PixelFormat, YuvColour),
}

/// One picture, in memory that the camera fills again once this is gone.
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    pub bytes: &'a [u8],
    /// Counts all pictures that the camera made, and wraps.
    pub sequence: Option<u32>,
    /// When it was taken, by the camera's clock.
    pub taken_nanos: Option<i64>,
    /// The driver says that its content is wrong.
    pub is_damaged: bool,
    /// Both clocks when it was handed out.
    pub now: ClockReading,
}

/// A camera that is open and sends pictures.
pub trait Camera: Send {
    fn layout(&self) -> Layout;

    /// The next picture; `None` when none came within `wait`.
    fn next(&mut self, wait: Duration) -> Result<Option<Shot<'_>>, CameraError>;

    fn read_clocks(&self) -> ClockReading;
}

#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    #[error("no camera is there; splat-mapper doctor lists those that are: {}", path.display())]
    Absent { path: PathBuf },
    #[error(
        "the camera is in use by another program; end it (fuser -v {} names it): {}",
        path.display(), path.display()
    )]
    Busy { path: PathBuf },
    #[error(
        "no permission to open the camera; sudo usermod -aG video $USER, then log in again; in a container, pass it on with --device: {}",
        path.display()
    )]
    Permission { path: PathBuf },
    #[error("not a camera: {reason}; splat-mapper doctor lists the cameras: {}", path.display())]
    NotCamera { reason: String, path: PathBuf },
    #[error(
        "the camera has none of the formats {wanted}, but {found}; change source.camera.formats: {}",
        path.display()
    )]
    Format {
        wanted: String,
        found: String,
        path: PathBuf,
    },
    #[error(
        "the camera refused every format: {refusals}; splat-mapper doctor lists what it offers, choose with source.camera.formats, width, height: {}",
        path.display()
    )]
    Refused { refusals: String, path: PathBuf },
    #[error("the camera is gone ({reason}): {}", path.display())]
    Gone { reason: String, path: PathBuf },
    #[error("cannot {what}: {reason}: {}", path.display())]
    Io {
        what: &'static str,
        reason: String,
        path: PathBuf,
    },
}

/// A live camera as a source.
pub struct CameraSource {
    live: Live,
    jpeg: Jpeg,
    intake: Intake,
}

impl std::fmt::Debug for CameraSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "CameraSource({:?})", self.live)
    }
}

impl CameraSource {
    /// Opens the camera, so that a wrong name, a lock or a missing permission is known at the start.
    pub fn open(name: String, open: Opener, params: &SourceParams) -> Result<Self, SourceError> {
        let lens = match camera_info::of_url(&params.camera_info_url)? {
            Some((_, lens)) => Some(lens),
            None => {
                tracing::info!(
                    "no source.camera_info_url: the camera counts as uncalibrated, its focal length is estimated"
                );
                None
            }
        };
        // The camera sets the pace.
        let params = SourceParams {
            rate: 0.0,
            ..params.clone()
        };
        Ok(Self {
            live: Live::open(name, open)?,
            jpeg: Jpeg::default(),
            intake: Intake::new(&params, lens),
        })
    }

    /// How the camera is, for other threads.
    pub fn health(&self) -> live::HealthWatch {
        self.live.health()
    }

    fn poll_within(&mut self, patience: Duration) -> Received<Frame> {
        while !self.intake.is_full() {
            let (intake, jpeg) = (&mut self.intake, &mut self.jpeg);
            let received = self.live.next_within(patience, |layout, stamp, bytes| {
                frame_of(intake, jpeg, layout, stamp, bytes)
            });
            self.count();
            match received {
                Received::Item(Some(frame)) => return Received::Item(frame),
                Received::Item(None) => {}
                Received::Nothing => return Received::Nothing,
                Received::Ended => return Received::Ended,
            }
        }
        Received::Ended
    }

    fn count(&mut self) {
        let tally = self.live.take_tally();
        self.intake.missed(tally.missed);
        for _ in 0..tally.damaged {
            self.intake.unreadable("the driver marked it as damaged");
        }
        for _ in 0..tally.interruptions {
            self.intake.interrupted();
        }
    }
}

impl Source for CameraSource {
    fn next(&mut self) -> Option<Frame> {
        match self.poll_within(Duration::MAX) {
            Received::Item(frame) => Some(frame),
            Received::Nothing | Received::Ended => None,
        }
    }

    fn poll(&mut self, patience: Duration) -> Polled {
        match self.poll_within(patience) {
            Received::Item(frame) => Polled::Frame(Box::new(frame)),
            Received::Nothing => Polled::Waiting,
            Received::Ended => Polled::Ended,
        }
    }

    fn warnings(&self) -> Vec<String> {
        self.live.health().get().fault.into_iter().collect()
    }

    fn counts(&self) -> SourceCounts {
        self.intake.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        None
    }

    fn truth_extent(&self) -> Option<f64> {
        None
    }

    fn is_live(&self) -> bool {
        true
    }

    fn end_when(&mut self, asked: &Arc<AtomicBool>) {
        self.live.end_when(asked);
    }
}

fn frame_of(
    intake: &mut Intake,
    jpeg: &mut Jpeg,
    layout: &Layout,
    stamp: Stamp,
    bytes: &[u8],
) -> Option<Frame> {
    let arrival = intake.arrive(stamp)?;
    let mut picture = intake.spare();
    match decode(layout, bytes, jpeg, &mut picture) {
        Ok(()) => intake.frame(arrival, picture, Extras::default()),
        Err(reason) => {
            intake.undecodable(arrival.seq, &reason.to_string());
            None
        }
    }
}

/// A camera's picture as RGB.
pub fn decode(
    layout: &Layout,
    bytes: &[u8],
    jpeg: &mut Jpeg,
    out: &mut RgbImage,
) -> Result<(), DecodeError> {
    match layout.coding {
        Coding::Mjpeg => jpeg
            .to_rgb(bytes, out)
            .map_err(|reason| DecodeError::Compressed {
                found_bytes: bytes.len(),
                reason,
            }),
        Coding::Raw(format, colour) => {
            let pixels = Pixels {
                width_px: layout.width_px,
                height_px: layout.height_px,
                format,
                colour,
                step: layout.step,
                bytes,
            };
            to_rgb(&pixels, out)
        }
    }
}
