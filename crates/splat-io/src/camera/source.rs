//! Cameras that are there now -> frames, whatever drives them.
//!
//! `v4l2` and `webcam` say how a camera is opened and read; what happens when it stops, and how images become
//! frames, stands here once for both.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::camera::driver::{Layout, decode};
use crate::camera::live::{CameraStatusWatch, Live, Opener};
use crate::camera_info;
use crate::error::SourceError;
use crate::frame_source::{Polled, Source, SourceCounts};
use crate::intake::{Extras, Intake};
use crate::params::SourceParams;
use crate::queue::Received;
use splat_image::jpeg::decoder::Jpeg;
use splat_types::frame::Frame;
use splat_types::time::Stamp;

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
    pub fn health(&self) -> CameraStatusWatch {
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
    let mut image = intake.spare();
    match decode(layout, bytes, jpeg, &mut image) {
        Ok(()) => intake.frame(arrival, image, Extras::default()),
        Err(reason) => {
            intake.undecodable(arrival.seq, &reason.to_string());
            None
        }
    }
}
