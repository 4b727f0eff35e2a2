//! What all sources of frames have in common.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::error::SourceError;
use splat_types::frame::Frame;
use splat_types::sparse_point::SparsePoint;
use splat_types::transform::Rigid;

/// What a source met so far; copied into `report.json`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SourceCounts {
    /// Messages or files that should have been frames.
    pub received: u64,
    pub undecodable: u64,
    /// Stamps that did not increase; such frames are left out.
    pub out_of_order: u64,
    /// Made and never looked at: the driver skipped their numbers, or they came faster than they were taken.
    pub dropped: u64,
    /// Frames that no depth image belongs to, of a source that has some.
    pub without_depth: u64,
    /// Frames that no image of the second camera belongs to, of a stereo pair.
    pub without_second: u64,
    /// Frames that no samples of the IMU reach, of a source that has one.
    pub without_imu: u64,
    /// Times that a camera stopped and was opened again.
    pub interruptions: u64,
    /// The fault that ended the input early, for example a truncated recording. Frames before it stay in use.
    pub fault: Option<String>,
}

/// What frames bring that shows lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetricInput {
    None,
    /// Depth that a sensor measured, `Frame::sensor_depth`.
    Depth,
    /// The image of a second camera, `Frame::second`.
    Stereo,
}

/// What a look for the next frame found.
#[derive(Debug)]
pub enum Polled {
    Frame(Box<Frame>),
    /// None yet; more may come.
    Waiting,
    Ended,
}

/// Hands out frames one at a time.
pub trait Source: Send {
    /// The next frame; `None` at the end of the input. A fault in the middle ends the input and stands in `counts`.
    fn next(&mut self) -> Option<Frame>;

    /// The next frame, if one comes within `patience`. Sources that wait for the world override it.
    fn poll(&mut self, _patience: Duration) -> Polled {
        self.next()
            .map_or(Polled::Ended, |frame| Polled::Frame(Box::new(frame)))
    }

    /// How the camera is mounted on the robot, `base_from_cam` in metres, where the input says so.
    fn mount(&self) -> Option<Rigid> {
        None
    }

    /// Name of the camera's frame, optical axes; empty where the input names none.
    fn camera_frame(&self) -> &str {
        ""
    }

    /// What keeps images from coming, a line each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }

    fn counts(&self) -> SourceCounts;

    /// Frames still to come, where the source knows (for the progress bar).
    fn len_hint(&self) -> Option<u64> {
        None
    }

    /// Images still to come, where somebody chose each of them: photos in a folder or in a scene of another program. `None` for
    /// the frames of a camera, recorded or not, which repeat themselves.
    fn n_photos(&self) -> Option<u64> {
        None
    }

    /// Largest distance between two true camera positions of the whole input, where they are known beforehand.
    fn truth_extent(&self) -> Option<f64> {
        None
    }

    /// What the frames bring besides one colour image that shows lengths.
    fn metric_input(&self) -> MetricInput {
        MetricInput::None
    }

    /// Sparse points of the scene in the frame of the true poses, read when they are asked for; empty where it has none.
    fn sparse_points(&self) -> Result<Vec<SparsePoint>, SourceError> {
        Ok(Vec::new())
    }

    /// Images come when the world makes them: those not taken in time are lost, so nothing may wait.
    fn is_live(&self) -> bool {
        false
    }

    /// A source that waits for the world ends `next` with `None` soon after the end is asked for.
    fn end_when(&mut self, _asked: &Arc<AtomicBool>) {}
}

/// How long one look for the next frame of a waiting source lasts.
const LOOK: Duration = Duration::from_secs(1);

/// `Source::next` of a source that waits for the world: looks until there is a frame, or the end.
pub fn next_polled(source: &mut impl Source) -> Option<Frame> {
    loop {
        match source.poll(LOOK) {
            Polled::Frame(frame) => return Some(*frame),
            Polled::Waiting => {}
            Polled::Ended => return None,
        }
    }
}
