//! What was said of every frame, and what is known of it in the end.

use super::{Anchor, Reason, State, TrackedFrame, Tracker};
use crate::clock::Stamp;
use crate::pose::Rigid;

/// Frames beyond this many have no place in the trajectory: nine hours at 30 Hz, some 250 MB.
const MAX_FRAMES: usize = 1_000_000;

/// A frame of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameTrack {
    pub seq: u64,
    pub stamp: Stamp,
    /// As it was said when the frame came.
    pub state: State,
    pub reason: Option<Reason>,
    pub n_inliers: u32,
    /// Standard deviation along and about the least certain axis: (the map's unit, degrees).
    pub std: Option<(f32, f32)>,
    /// `map_from_cam` as it was measured when the frame came.
    pub live: Option<Rigid>,
    /// The same by the last poses of the keyframes, and of frames that had no pose when they came but have one since.
    pub refined: Option<Rigid>,
}

/// All frames, and what befell them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracks {
    /// In order of time.
    pub frames: Vec<FrameTrack>,
    pub n_frames: u64,
    /// Frames with a pose measured when they came.
    pub n_tracked: u64,
    /// Times that the tracker got lost, and was found again without a hint.
    pub n_lost: u64,
    pub n_relocalised: u64,
    /// Frames whose last pose is that at which their picture fits the splats best.
    pub n_fitted: u64,
}

#[derive(Debug)]
pub(super) struct Kept {
    track: FrameTrack,
    pub(super) anchor: Option<Anchor>,
    /// The map was looked at to find where its picture fits.
    pub(super) is_fitted: bool,
}

#[derive(Debug, Default)]
pub(super) struct History {
    /// Up to `MAX_FRAMES`, and one more that stands for all later ones.
    pub(super) frames: Vec<Kept>,
    n_frames: u64,
    n_tracked: u64,
    pub(super) n_lost: u64,
    pub(super) n_relocalised: u64,
}

impl History {
    /// Returns the frame's number.
    pub(super) fn push(&mut self, frame: &TrackedFrame, anchor: Option<Anchor>) -> usize {
        self.n_frames += 1;
        self.n_tracked += u64::from(frame.is_measured());
        let std = frame.pose.map(|pose| {
            let worst = |axes: std::ops::Range<usize>| {
                let variances = axes.map(|i| pose.covariance[i][i]);
                variances.fold(0.0, f64::max).sqrt()
            };
            (worst(0..3) as f32, worst(3..6).to_degrees() as f32)
        });
        let measured = frame.pose.filter(|pose| !pose.is_predicted);
        let track = FrameTrack {
            seq: frame.seq,
            stamp: frame.stamp,
            state: frame.state,
            reason: frame.reason,
            n_inliers: frame.n_inliers as u32,
            std,
            live: measured.map(|pose| pose.map_from_cam),
            refined: None,
        };
        if self.frames.len() > MAX_FRAMES {
            self.frames.truncate(MAX_FRAMES);
        }
        self.frames.push(Kept {
            track,
            anchor,
            is_fitted: false,
        });
        self.frames.len() - 1
    }

    pub(super) fn into_tracks(self, mut frames: Vec<FrameTrack>) -> Tracks {
        frames.truncate(MAX_FRAMES);
        let fitted = self.frames.iter().filter(|frame| frame.is_fitted);
        Tracks {
            n_fitted: fitted.count() as u64,
            frames,
            n_frames: self.n_frames,
            n_tracked: self.n_tracked,
            n_lost: self.n_lost,
            n_relocalised: self.n_relocalised,
        }
    }
}

impl Tracker {
    /// Where the camera was on the last frame with a pose, by the map of this moment.
    pub fn last_pose(&self) -> Option<Rigid> {
        self.motion
            .as_ref()
            .map(|motion| motion.cam_from_map.inverse())
    }

    pub(super) fn told(&self, kept: &Kept) -> FrameTrack {
        FrameTrack {
            refined: kept.anchor.and_then(|anchor| self.pose_by(&anchor)),
            ..kept.track
        }
    }
}
