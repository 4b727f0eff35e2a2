//! Where the newest frame is: near a guess by triangulated points, near the newest keyframes by what they look like, and by
//! corners among all keyframes.

use super::Tracker;
use crate::track::align::AlignedPoint;
use crate::track::localize::{Hint, Localized, Localizer};
use crate::track::map_points::PointKeyframe;
use crate::track::observation::Observation;
use crate::track::odometry_link::LinkedPose;
use splat_types::frame::Frame;
use splat_types::tracking::{LostReason, TrackState};
use splat_types::transform::Rigid;

/// Keyframes that a frame is aligned with.
const N_LOCAL: usize = 5;
/// Newest keyframes that a frame without a guess is compared with.
const N_NEWEST: usize = 2;
/// Share of the corners needed otherwise, where alignment confirms the pose.
const SHARE_CONFIRMED: f64 = 0.4;

/// A frame with a measured pose, and how it was found.
#[derive(Debug)]
pub(super) struct FoundPose {
    pub(super) located: Localized,
    /// Triangulated points that agree, each found to a fraction of a pixel; `None` where corners alone gave the pose.
    pub(super) points: Option<Vec<AlignedPoint>>,
    /// Without regard to where the camera was.
    pub(super) by_search: bool,
}

impl FoundPose {
    fn aligned((located, points): (Localized, Vec<AlignedPoint>), by_search: bool) -> Self {
        Self {
            located,
            points: Some(points),
            by_search,
        }
    }
}

impl Tracker {
    /// By triangulated points, where odometry or the motion so far leads; where visual odometry does not know, beside the newest
    /// keyframes.
    pub(super) fn found_by_points(
        &self,
        frame: &Frame,
        linked: Option<&(LinkedPose, Rigid)>,
        is_searched: bool,
    ) -> Option<FoundPose> {
        let guess = linked.map(|(_, pose)| pose.inverse());
        let ahead = || {
            let motion = self.motion.as_ref();
            let motion = motion.filter(|_| self.state != TrackState::Lost);
            motion.map(|motion| {
                let turn = self.odometry.inertial.turn(motion.stamp, frame.stamp);
                motion.ahead_turned(frame.stamp, turn)
            })
        };
        let near = guess.or_else(ahead).and_then(|guess| self.aligned(&guess));
        match near {
            Some(aligned) => Some(FoundPose::aligned(aligned, false)),
            None if is_searched => Some(FoundPose::aligned(self.aligned_by_search(frame)?, true)),
            None => None,
        }
    }

    /// By corners; then by triangulated points from there on, which also confirm what corners alone leave in doubt.
    pub(super) fn found_by_corners(
        &mut self,
        seen: &Observation,
        guess: Option<Rigid>,
    ) -> Result<FoundPose, LostReason> {
        let reason = match self.find(seen, guess, 1.0) {
            Ok((located, by_search)) => {
                let aligned = self.aligned(&located.cam_from_world);
                let by_corners = FoundPose {
                    located,
                    points: None,
                    by_search,
                };
                let aligned = aligned.map(|aligned| FoundPose::aligned(aligned, by_search));
                return Ok(aligned.unwrap_or(by_corners));
            }
            // Nothing was like it at all.
            Err(reason @ LostReason::NotRecognised) => return Err(reason),
            Err(reason) => reason,
        };
        let Ok((rough, by_search)) = self.find(seen, guess, SHARE_CONFIRMED) else {
            return Err(reason);
        };
        let aligned = self.aligned(&rough.cam_from_world).ok_or(reason)?;
        Ok(FoundPose::aligned(aligned, by_search))
    }

    /// The newest frame near a guess, `cam_from_world`, by the triangulated points that keyframes show, or else as the frame before
    /// shows them.
    fn aligned(&self, guess: &Rigid) -> Option<(Localized, Vec<AlignedPoint>)> {
        let frame = self.odometry.newest()?;
        let mut keyframes = self.points.visible(guess, &frame.camera.pinhole, N_LOCAL);
        let localizer = self.localizer();
        let by_keyframes = localizer.align(&frame, &keyframes, guess).ok();
        by_keyframes.or_else(|| {
            keyframes.insert(0, self.points.last.as_ref()?);
            localizer.align(&frame, &keyframes, guess).ok()
        })
    }

    /// The newest frame, where the camera stands near where it was, or near one of the newest keyframes.
    fn aligned_by_search(&self, frame: &Frame) -> Option<(Localized, Vec<AlignedPoint>)> {
        let newest = self.odometry.newest()?;
        let keyframes = self.points.held.values().rev().take(N_NEWEST);
        let near: Vec<&PointKeyframe> = self.points.last.iter().chain(keyframes).collect();
        let rough = newest.search(&near, frame.seq)?;
        let aligned = self.aligned(&rough)?;
        let is_clear = aligned.0.n_inliers >= self.params.relocalise_inliers;
        is_clear.then_some(aligned)
    }

    /// The pose of the newest frame, and whether it was searched for without a hint.
    /// `guess` is `cam_from_world` by odometry.
    fn find(
        &mut self,
        seen: &Observation,
        guess: Option<Rigid>,
        share_needed: f64,
    ) -> Result<(Localized, bool), LostReason> {
        let (n, start) = (self.landmarks.held.len().max(1), self.search.next);
        let hint = Hint {
            motion: self.motion.as_ref(),
            guess,
            is_lost: self.state == TrackState::Lost,
            n_failed: self.search.n_failed,
            scene_depth: self.scene_depth(),
            last_keyframe: self.anchor.map(|anchor| anchor.keyframe_id),
        };
        let localizer = Localizer {
            share_needed,
            ..self.localizer()
        };
        let (found, has_searched) = localizer.find(seen, &hint, start);
        if has_searched {
            self.search.next = (start + self.params.relocalise_keyframes) % n;
        }
        found
    }
}
