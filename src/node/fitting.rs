//! Live: frames that tracking has placed go to a map that has nothing else to do, and come back with the poses at which
//! their pictures fit it best. Nobody waits for the other; an older frame makes room for a newer one.

use crate::frame::Frame;
use crate::map::SplatMap;
use crate::pose::Rigid;
use crate::queue::{Receiver, Sender, WhenFull, queue};
use crate::track::FramePlace;

/// The side of tracking.
#[derive(Debug)]
pub(super) struct Asker {
    frames: Sender<(FramePlace, Frame)>,
    fits: Receiver<(FramePlace, Rigid)>,
}

/// The side of the map.
#[derive(Debug)]
pub(super) struct Fitter {
    frames: Receiver<(FramePlace, Frame)>,
    fits: Sender<(FramePlace, Rigid)>,
}

pub(super) fn pair() -> (Asker, Fitter) {
    let (frames_tx, frames) = queue("frames to fit", 1, WhenFull::DropOldest);
    let (fits_tx, fits) = queue("fitted frames", 1, WhenFull::DropOldest);
    let asker = Asker {
        frames: frames_tx,
        fits,
    };
    let fitter = Fitter {
        frames,
        fits: fits_tx,
    };
    (asker, fitter)
}

impl Asker {
    pub(super) fn ask(&self, placement: FramePlace, frame: &Frame) {
        // A map that has ended answers no more.
        drop(self.frames.send((placement, frame.clone())));
    }

    pub(super) fn answer(&self) -> Option<(FramePlace, Rigid)> {
        self.fits.try_recv().ok().flatten()
    }
}

impl Fitter {
    /// Looks at the newest frame that has come. Returns whether there was one.
    pub(super) fn fit_one(&self, map: &mut SplatMap) -> bool {
        let Ok(Some((placement, frame))) = self.frames.try_recv() else {
            return false;
        };
        if let Some(key_from_cam) = map.fit_placement(&placement, &frame) {
            self.fits.send((placement, key_from_cam)).ok();
        }
        true
    }
}
