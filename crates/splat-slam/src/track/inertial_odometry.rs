//! An IMU as the tracker uses it: turns between frames from the first one on, and poses where the camera sees nothing, once speed, gravity
//! and unit have shown in poses of the map.
//!
//! What it predicts from the frames up to half a second ago is compared with what the map has measured since; an IMU that disagrees
//! for a second is left out until it has agreed for five.

use std::collections::VecDeque;

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix6;

use crate::track::anchor::Anchor;
use crate::track::odometry_link::LinkedPose;
use crate::track::sensor_check::{self, COMPARED_SECS, SensorCheck};
use crate::track::wheel_odometry::MeasuredFrame;
use splat_geometry::inertial::alignment::{InertialAlignment, PredictedPose, align};
use splat_geometry::inertial::frames::{Calibration, PosedFrame, integrated};
use splat_geometry::inertial::noise::ImuNoise;
use splat_types::frame::Frame;
use splat_types::inertial::ImuLog;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Samples and frames are kept for so long: a pose that is older says little of the speed, and the map's unit drifts.
const KEPT_SECS: f64 = 20.0;
/// Of frames further back than the last second, one in so long is looked at.
const SPARSE_SECS: f64 = 0.15;
const DENSE_SECS: f64 = 1.0;
/// Standard deviations of measured poses against each other: as a share of the scene's depth, and radians. Where they are noisier, the
/// alignment's own misfit widens what it says.
const PLACE_STD: f64 = 0.002;
const TURN_STD: f64 = 0.001;
/// Beyond so many seconds a prediction is none.
const MAX_AHEAD_SECS: f64 = 10.0;
/// Forces are averaged over so long, and over no less.
const FORCE_SECS: f64 = 5.0;
const MIN_FORCE_SECS: f64 = 0.4;
/// Without a sample for so long, the IMU is silent.
const SILENT_SECS: f64 = 0.7;

/// An alignment with frames of the map, and where the map had the last of them then.
#[derive(Debug)]
struct Fit {
    alignment: InertialAlignment,
    anchor: Anchor,
    world_from_cam: Rigid,
}

/// Samples, measured frames, and what they have shown together.
#[derive(Debug)]
pub(crate) struct InertialOdometry {
    log: ImuLog,
    measured: VecDeque<MeasuredFrame>,
    calibration: Calibration,
    fit: Option<Fit>,
    /// The one before, which frames are compared with.
    compared: Option<Fit>,
    check: SensorCheck,
    newest_frame: Option<Stamp>,
    mean_force: MeanForce,
}

/// Forces over the last while, summed up in the axes of the newest camera: what speeds a camera up and down cancels in time, gravity
/// does not.
#[derive(Debug, Default)]
struct MeanForce {
    sum: DVec3,
    secs: f64,
}

impl Default for InertialOdometry {
    fn default() -> Self {
        Self {
            log: ImuLog::new(KEPT_SECS + MAX_AHEAD_SECS),
            measured: VecDeque::new(),
            calibration: Calibration::default(),
            fit: None,
            compared: None,
            check: SensorCheck::default(),
            newest_frame: None,
            mean_force: MeanForce::default(),
        }
    }
}

impl InertialOdometry {
    /// One more frame, whatever its image shows.
    pub(crate) fn push(&mut self, frame: &Frame) {
        if let Some(span) = &frame.imu {
            self.log.push(span);
        }
        let before = self.newest_frame.replace(frame.stamp);
        let noise = self.noise();
        let motion = before.and_then(|before| {
            let times = (before, frame.stamp);
            integrated(&self.log, &self.calibration, times, &noise)
        });
        let mean = &mut self.mean_force;
        *mean = motion.map_or_else(MeanForce::default, |motion| {
            let kept = 1.0 - motion.secs / FORCE_SECS;
            MeanForce {
                sum: motion.turn.inverse() * (mean.sum * kept + motion.speed),
                secs: mean.secs * kept + motion.secs,
            }
        });
    }

    /// Up in the axes of the newest frame's camera; `None` while too little is known.
    pub(crate) fn up_in_cam(&self) -> Option<DVec3> {
        let by_fit = || {
            let alignment = &self.fit.as_ref()?.alignment;
            let noise = self.noise();
            let (turn, _) = alignment.predict_turn(&self.log, self.newest_frame?, &noise)?;
            Some(turn.inverse() * alignment.up)
        };
        let by_mean = || {
            let is_enough = self.mean_force.secs >= MIN_FORCE_SECS;
            is_enough.then(|| self.mean_force.sum.try_normalize())?
        };
        let is_out = self.check.is_out();
        by_fit().or_else(by_mean).filter(|_| !is_out)
    }

    fn noise(&self) -> ImuNoise {
        ImuNoise::of(self.log.model())
    }

    pub(crate) fn has_come(&self) -> bool {
        !self.log.is_empty()
    }

    /// What is wrong with it, if anything is.
    pub(crate) fn fault(&self) -> Option<&'static str> {
        let newest = self.log.newest()?;
        let silent = self
            .newest_frame
            .map_or(0.0, |frame| frame.secs_since(newest));
        if silent > SILENT_SECS {
            return Some("is silent");
        }
        self.check.is_out().then_some("disagrees with the camera")
    }

    /// The turn of the camera from one time to another, `earlier_from_later`.
    pub(crate) fn turn(&self, from: Stamp, to: Stamp) -> Option<DQuat> {
        if self.check.is_out() {
            return None;
        }
        let noise = self.noise();
        let motion = integrated(&self.log, &self.calibration, (from, to), &noise)?;
        Some(motion.turn)
    }

    /// One more frame whose place was measured; `pose_of` gives those of frames before by the map of this moment.
    pub(crate) fn measured(
        &mut self,
        frame: MeasuredFrame,
        scene_depth: f64,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) {
        let age = |other: &MeasuredFrame| frame.stamp.secs_since(other.stamp);
        let is_old = |other: &MeasuredFrame| !(0.0..KEPT_SECS).contains(&age(other));
        while self.measured.front().is_some_and(is_old) {
            self.measured.pop_front();
        }
        let is_after = |last: &MeasuredFrame| last.stamp < frame.stamp;
        if self.measured.back().is_none_or(is_after) {
            self.measured.push_back(frame);
        }
        let since = |fit: &Fit| frame.stamp.secs_since(fit.alignment.stamp);
        if let Some(fit) = &self.compared
            && since(fit) >= COMPARED_SECS
            && let Some(misfit) = self.misfit(fit, &frame, scene_depth, &pose_of)
        {
            self.check.note("the IMU", frame.stamp, misfit);
            if self.check.is_out() && self.check.is_off() {
                // What it was before says nothing of what it is now.
                (self.calibration, self.fit, self.compared) = (Calibration::default(), None, None);
                self.measured.clear();
                self.measured.push_back(frame);
            }
        }
        if self
            .fit
            .as_ref()
            .is_none_or(|fit| since(fit) >= COMPARED_SECS)
        {
            self.compared = self.fit.take();
            self.align(scene_depth, &pose_of);
        }
    }

    /// By how many standard deviations the newest frame is elsewhere than an alignment has it; `None` where there is nothing to
    /// compare.
    fn misfit(
        &self,
        fit: &Fit,
        frame: &MeasuredFrame,
        scene_depth: f64,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) -> Option<f64> {
        let measured = pose_of(&frame.anchor)?;
        let noise = self.noise();
        if let Some((said, place)) = self.predict(fit, frame.stamp, &pose_of) {
            let variance = (0..3)
                .map(|i| place.place_covariance.col(i)[i])
                .sum::<f64>()
                / 3.0;
            let stds = (variance.sqrt(), place.turn_std);
            return Some(sensor_check::misfit(&said, stds, &measured, scene_depth));
        }
        // Turns show without a unit, too.
        let alignment = &fit.alignment;
        let (turn, std) = alignment.predict_turn(&self.log, frame.stamp, &noise)?;
        let moved = pose_of(&fit.anchor)?.rotation * fit.world_from_cam.rotation.inverse();
        let said = Rigid::new(moved * turn, measured.translation);
        Some(sensor_check::misfit(
            &said,
            (0.0, std),
            &measured,
            scene_depth,
        ))
    }

    /// Aligns the IMU with the frames of the last while.
    fn align(&mut self, scene_depth: f64, pose_of: impl Fn(&Anchor) -> Option<Rigid>) {
        let Some(last) = self.measured.back().copied() else {
            return;
        };
        let noise = self.noise();
        let mut frames: Vec<PosedFrame> = Vec::new();
        for frame in &self.measured {
            let is_recent = last.stamp.secs_since(frame.stamp) < DENSE_SECS;
            let is_due = frames
                .last()
                .is_none_or(|f| frame.stamp.secs_since(f.stamp) >= SPARSE_SECS);
            if let Some(world_from_cam) = pose_of(&frame.anchor)
                && (is_recent || is_due)
            {
                frames.push(PosedFrame {
                    stamp: frame.stamp,
                    world_from_cam,
                    std: [PLACE_STD * scene_depth, TURN_STD],
                });
            }
        }
        match align(&frames, &self.log, &self.calibration, &noise) {
            Ok(alignment) => {
                self.calibration = alignment.calibration;
                self.fit = frames.last().map(|frame| Fit {
                    alignment,
                    anchor: last.anchor,
                    world_from_cam: frame.world_from_cam,
                });
            }
            Err(reason) => {
                tracing::debug!(?reason, "the IMU is not aligned with the camera");
                self.fit = None;
            }
        }
    }

    /// The camera in the map of this moment by an alignment and the samples since.
    fn predict(
        &self,
        fit: &Fit,
        at: Stamp,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) -> Option<(Rigid, PredictedPose)> {
        let secs = at.secs_since(fit.alignment.stamp);
        if !(0.0..MAX_AHEAD_SECS).contains(&secs) {
            return None;
        }
        let noise = self.noise();
        let predicted = fit.alignment.predict(&self.log, at, &noise)?;
        // The map may have moved since.
        let moved = pose_of(&fit.anchor)? * fit.world_from_cam.inverse();
        Some((moved * predicted.world_from_cam, predicted))
    }

    /// Where a frame is whose image shows nothing that is known.
    pub(crate) fn locate(
        &mut self,
        at: Stamp,
        scene_depth: f64,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) -> Option<(LinkedPose, Rigid)> {
        if self.check.is_out() {
            return None;
        }
        let last = self.measured.back().copied()?;
        let is_newest = |fit: &Fit| fit.alignment.stamp == last.stamp;
        if !self.fit.as_ref().is_some_and(is_newest) {
            self.align(scene_depth, &pose_of);
        }
        let (world_from_cam, predicted) = self.predict(self.fit.as_ref()?, at, &pose_of)?;
        let key = Anchor {
            key_from_cam: Rigid::IDENTITY,
            ..last.anchor
        };
        let linked = LinkedPose {
            keyframe_id: key.keyframe_id,
            key_from_cam: pose_of(&key)?.inverse() * world_from_cam,
            covariance: in_camera(&predicted, &world_from_cam),
            n_inliers: 0,
        };
        Some((linked, world_from_cam))
    }
}

/// Covariance of place and turn in the camera's axes.
fn in_camera(predicted: &PredictedPose, world_from_cam: &Rigid) -> Matrix6<f64> {
    let rotation = DMat3::from_quat(world_from_cam.rotation);
    let place = rotation.transpose() * predicted.place_covariance * rotation;
    let mut covariance = Matrix6::zeros();
    for i in 0..3 {
        (0..3).for_each(|j| covariance[(i, j)] = place.col(j)[i]);
        covariance[(3 + i, 3 + i)] = predicted.turn_std.powi(2);
    }
    covariance
}

#[cfg(test)]
mod tests;
