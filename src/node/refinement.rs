//! Live: frames that tracking has registered go to a map that has nothing else to do, and come back with the poses at which
//! their images fit it best. Nobody waits for the other; an older frame makes room for a newer one.

use splat_engine::error::EngineError;
use splat_io::queue::{Receiver, Sender, WhenFull, queue};
use splat_slam::mapper::mapper::Mapper;
use splat_slam::track::refinement::FrameRef;
use splat_types::frame::Frame;
use splat_types::transform::Rigid;

/// The side of tracking.
#[derive(Debug)]
pub(crate) struct RefinementClient {
    frames: Sender<(FrameRef, Frame)>,
    fits: Receiver<(FrameRef, Rigid)>,
}

/// The side of the map.
#[derive(Debug)]
pub(crate) struct RefinementWorker {
    frames: Receiver<(FrameRef, Frame)>,
    fits: Sender<(FrameRef, Rigid)>,
}

pub(crate) fn pair() -> (RefinementClient, RefinementWorker) {
    let (frames_tx, frames) = queue("frames to fit", 1, WhenFull::DropOldest);
    let (fits_tx, fits) = queue("fitted frames", 1, WhenFull::DropOldest);
    let client = RefinementClient {
        frames: frames_tx,
        fits,
    };
    let fitter = RefinementWorker {
        frames,
        fits: fits_tx,
    };
    (client, fitter)
}

impl RefinementClient {
    pub(crate) fn ask(&self, placement: FrameRef, frame: &Frame) {
        // A map that has ended answers no more.
        drop(self.frames.send((placement, frame.clone())));
    }

    pub(crate) fn answer(&self) -> Option<(FrameRef, Rigid)> {
        self.fits.try_recv().ok().flatten()
    }
}

impl RefinementWorker {
    /// Looks at the newest frame that has come. Returns whether there was one.
    pub(crate) fn fit_one(&self, map: &mut Mapper) -> Result<bool, EngineError> {
        let Ok(Some((placement, frame))) = self.frames.try_recv() else {
            return Ok(false);
        };
        if let Some(key_from_cam) = map.fit_placement(&placement, &frame)? {
            self.fits.send((placement, key_from_cam)).ok();
        }
        Ok(true)
    }
}
