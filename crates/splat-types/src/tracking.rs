//! What tracking says of a frame: state, pose with covariance, and the reason where there is none.

use crate::covariance::Covariance;
use crate::time::Stamp;
use crate::transform::Rigid;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackState {
    /// No frame has had a pose.
    Initialising,
    /// The pose is measured, carried on for less than `track.lost_secs`, or by odometry of the source for as long as that is sure.
    Tracking,
    /// No pose was found for `track.lost_secs`.
    Lost,
    /// Found again, with no regard to where the camera was before; the frames after it are `TrackingSummary`.
    Relocalised,
}

/// Why a frame has no measured pose.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LostReason {
    #[error("no keyframe has a pose and depth yet")]
    NoKeyframes,
    #[error("no calibration for images of {width_px}x{height_px} is known")]
    NoCamera { width_px: u32, height_px: u32 },
    #[error("the image shows nothing to track: {n_corners} corners")]
    Blank { n_corners: usize },
    #[error("the image is the one before, bit for bit")]
    Repeated,
    #[error("no keyframe has looked there")]
    Unseen,
    #[error("{found} landmarks agree, {needed} are needed")]
    TooFew { found: usize, needed: usize },
    #[error("the landmarks that agree lie in one place of the image")]
    Crowded,
    #[error("landmarks miss their pixels by {times:.1} times what they should")]
    Inexact { times: f64 },
    #[error("the landmarks leave the pose open")]
    Open,
    #[error("the motion so far cannot have led to where the landmarks say")]
    Implausible,
    #[error("no keyframe is recognised")]
    NotRecognised,
}

/// Where the camera is, by the map as it is known at that moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedPose {
    pub world_from_cam: Rigid,
    /// Of the camera in its own axes: translation (the map's unit), then turn (rad).
    pub covariance: Covariance,
    /// Not measured on this frame: the motion before it carried on, or odometry did, with a covariance that grows.
    pub is_predicted: bool,
}

/// What tracking says of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedFrame {
    pub seq: u64,
    pub stamp: Stamp,
    pub state: TrackState,
    pub reason: Option<LostReason>,
    /// `None` before the first pose.
    pub pose: Option<TrackedPose>,
    /// Landmarks that agree with the pose.
    pub n_inliers: usize,
}

impl TrackedFrame {
    /// Whether the pose was measured on this very frame.
    pub fn is_measured(&self) -> bool {
        self.pose.is_some_and(|pose| !pose.is_predicted)
    }
}
