//! What was found of a frame -> what is reported of it, and the state that the tracker is in from then on.

use std::sync::Arc;

use nalgebra::Matrix6;

use super::finding::FoundPose;
use super::{DESIGN_SHARE, FoundFrame, LOOK_AHEAD, MAX_DESIGN, Tracker, rows};
use crate::track::anchor::Anchor;
use crate::track::motion::Motion;
use crate::track::observation::Observation;
use crate::track::odometry_link::LinkedPose;
use crate::track::wheel_odometry::MeasuredFrame;
use crate::visual_odometry::odometry::OdometryPose;
use splat_types::covariance::worst_std;
use splat_types::time::Stamp;
use splat_types::tracking::{LostReason, TrackState, TrackedFrame, TrackedPose};
use splat_types::transform::Rigid;

/// A pose that odometry has carried on is no pose beyond a standard deviation of such a share of the scene's depth, and of so many
/// radians.
const MAX_BRIDGED_STD: f64 = 0.25;
const MAX_BRIDGED_TURN_STD: f64 = 0.2;

impl Tracker {
    pub(super) fn found(&mut self, (seq, stamp): (u64, Stamp), found: &FoundPose) -> TrackedFrame {
        let located = &found.located;
        let design = located.design.clamp(0.0, MAX_DESIGN);
        self.search.design += DESIGN_SHARE * (design - self.search.design);
        let covariance = self.localizer().covariance(located);
        let cam_from_world = located.cam_from_world;
        let has_jumped = found.by_search
            && self.motion.as_ref().is_some_and(|motion| {
                self.state == TrackState::Lost
                    || motion.is_elsewhere(stamp, &cam_from_world, self.scene_depth())
            });
        // A jump that was noticed at once was a loss all the same.
        if has_jumped && self.state != TrackState::Lost {
            self.history.n_lost += 1;
        }
        let was_elsewhere = self.odometry.registered_in_map();
        // Whoever was lost was not led here by the motion before: the search has found the place, or odometry from keyframes
        // that are newer than the loss.
        let is_new = was_elsewhere || self.state == TrackState::Lost;
        let anchor = self.anchor_of(located);
        self.search.found = Some(FoundFrame {
            seq,
            anchor,
            covariance,
        });
        if self.odometry.has_source() {
            let (depth, keyframes) = (self.scene_depth(), &self.keyframes);
            let measured = MeasuredFrame { seq, stamp, anchor };
            self.odometry
                .measured(measured, depth, |anchor| keyframes.pose_by(anchor));
        }
        let points = found.points.as_deref().zip(self.odometry.newest());
        if let Some((points, frame)) = points {
            let points = points.iter().map(|p| (p.id, p.point_in_world, p.pixel));
            let image = (frame.pyramid, frame.camera);
            let at = (located.reference, &cam_from_world);
            self.points.keep_last(image, at, points);
        } else {
            self.points.last = None;
        }
        let pose = (cam_from_world, covariance, located.n_inliers);
        self.measured((seq, stamp), pose, anchor, has_jumped || is_new)
    }

    /// There is no map yet: the pose is in odometry's frame and unit.
    pub(super) fn ahead_of_map(
        &mut self,
        seen: Arc<Observation>,
        pose: &OdometryPose,
    ) -> TrackedFrame {
        (self.state, self.search.n_failed) = (TrackState::Tracking, 0);
        let reported = TrackedPose {
            world_from_cam: pose.odometry_from_cam,
            covariance: pose.covariance,
            is_predicted: false,
        };
        let tracked = TrackedFrame {
            seq: seen.seq,
            stamp: seen.stamp,
            state: self.state,
            reason: None,
            pose: Some(reported),
            n_inliers: pose.n_inliers,
        };
        self.keep(Some(seen), &tracked, Some(pose.segment));
        tracked
    }

    /// Odometry has gone on from a keyframe. Landmarks of the map were not found, not looked for, or know less.
    pub(super) fn carried(
        &mut self,
        frame: (u64, Stamp),
        linked: &LinkedPose,
        world_from_cam: &Rigid,
    ) -> TrackedFrame {
        self.odometry.registered_in_map();
        let is_new = self.state == TrackState::Lost;
        let anchor = linked.anchor(self.keyframes.unit(linked.keyframe_id));
        let measured = MeasuredFrame {
            seq: frame.0,
            stamp: frame.1,
            anchor,
        };
        self.note_for_imu(measured);
        let pose = (
            world_from_cam.inverse(),
            linked.covariance,
            linked.n_inliers,
        );
        self.measured(frame, pose, anchor, is_new)
    }

    fn note_for_imu(&mut self, frame: MeasuredFrame) {
        let (depth, keyframes) = (self.scene_depth(), &self.keyframes);
        let inertial = &mut self.odometry.inertial;
        if inertial.has_come() {
            inertial.measured(frame, depth, |anchor| keyframes.pose_by(anchor));
        }
    }

    /// The image shows nothing that could be found, but odometry of the source has gone on. As long as it is sure enough, nothing is
    /// lost.
    pub(super) fn bridged(
        &mut self,
        at: (u64, Stamp),
        seen: Option<Arc<Observation>>,
        reason: LostReason,
        (linked, world_from_cam): &(LinkedPose, Rigid),
    ) -> TrackedFrame {
        let covariance = rows(&linked.covariance);
        let (place, turn) = worst_std(&covariance);
        let is_sure = place < MAX_BRIDGED_STD * self.scene_depth() && turn < MAX_BRIDGED_TURN_STD;
        if !is_sure || matches!(self.state, TrackState::Initialising | TrackState::Lost) {
            let tracked = self.missed(at, reason);
            self.keep(seen, &tracked, None);
            return tracked;
        }
        self.search.n_failed += 1;
        self.state = TrackState::Tracking;
        let tracked = TrackedFrame {
            seq: at.0,
            stamp: at.1,
            state: self.state,
            reason: Some(reason),
            pose: Some(TrackedPose {
                world_from_cam: *world_from_cam,
                covariance,
                is_predicted: true,
            }),
            n_inliers: 0,
        };
        self.keep(seen, &tracked, None);
        let anchor = linked.anchor(self.keyframes.unit(linked.keyframe_id));
        if let Some(entry) = self.history.frames.last_mut() {
            entry.anchor = Some(anchor);
        }
        tracked
    }

    /// A pose in the map: `cam_from_world`, its covariance and the observations that agree. `is_new`: it owes nothing to where
    /// the camera was before.
    fn measured(
        &mut self,
        (seq, stamp): (u64, Stamp),
        (cam_from_world, covariance, n_inliers): (Rigid, Matrix6<f64>, usize),
        anchor: Anchor,
        is_new: bool,
    ) -> TrackedFrame {
        self.state = if is_new {
            self.history.n_relocalised += 1;
            TrackState::Relocalised
        } else {
            TrackState::Tracking
        };
        let before = self.motion.take().filter(|_| !is_new);
        let motion = Motion::on(before.as_ref(), stamp, cam_from_world, covariance);
        self.motion = Some(motion);
        self.anchor = Some(anchor);
        self.search.n_failed = 0;
        TrackedFrame {
            seq,
            stamp,
            state: self.state,
            reason: None,
            pose: Some(TrackedPose {
                world_from_cam: cam_from_world.inverse(),
                covariance: rows(&covariance),
                is_predicted: false,
            }),
            n_inliers,
        }
    }

    /// The image of the frame before has come again.
    pub(super) fn repeated(&mut self, frame: (u64, Stamp)) -> TrackedFrame {
        let reason = LostReason::Repeated;
        if let Some(linked) = self.linked_by_sensors(frame) {
            return self.bridged(frame, None, reason, &linked);
        }
        let tracked = if self.motion.is_some() {
            self.missed(frame, reason)
        } else {
            // There is nothing to carry on, and nothing is lost by it.
            let is_lost = self.state == TrackState::Lost;
            TrackedFrame {
                seq: frame.0,
                stamp: frame.1,
                state: if is_lost {
                    TrackState::Lost
                } else {
                    TrackState::Initialising
                },
                reason: Some(reason),
                pose: None,
                n_inliers: 0,
            }
        };
        self.keep(None, &tracked, None);
        tracked
    }

    pub(super) fn missed(
        &mut self,
        (seq, stamp): (u64, Stamp),
        reason: LostReason,
    ) -> TrackedFrame {
        self.search.n_failed += 1;
        let since = self
            .motion
            .as_ref()
            .map(|motion| stamp.secs_since(motion.stamp));
        let last = self.last.as_ref().map_or(stamp, |(last, _)| *last);
        let wait = stamp.secs_since(last) * LOOK_AHEAD;
        // A keyframe that is gone leaves no motion, but a tracker that was somewhere.
        let is_late = since.is_none_or(|secs| secs + wait >= self.params.lost_secs);
        if self.state != TrackState::Initialising && self.state != TrackState::Lost {
            self.state = if is_late {
                TrackState::Lost
            } else {
                TrackState::Tracking
            };
            self.history.n_lost += u64::from(is_late);
        }
        let depth = self.scene_depth();
        let pose = self.motion.as_ref().map(|motion| TrackedPose {
            world_from_cam: motion.ahead(stamp).inverse(),
            covariance: rows(&motion.covariance_ahead(stamp, depth)),
            is_predicted: true,
        });
        TrackedFrame {
            seq,
            stamp,
            state: self.state,
            reason: Some(reason),
            pose,
            n_inliers: 0,
        }
    }
}
