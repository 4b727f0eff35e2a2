//! Odometry that comes with the frames, such as that of wheels, as the tracker goes on by where the camera sees nothing.
//!
//! Wheels slip, drivers freeze and stamps are wrong. What odometry says of the last half second is compared with what the map
//! has measured; where both disagree for a second, odometry is left out until they have agreed for five.

use std::collections::VecDeque;

use crate::track::anchor::Anchor;
use crate::track::odometry_link::{LinkedMotion, OdometryLink};
use crate::track::sensor_check::{self, COMPARED_SECS, MAX_COMPARED_SECS, SensorCheck};
use crate::visual_odometry::odometry::OdometryPose;
use splat_geometry::odometry_step::is_continuous;
use splat_types::frame::Frame;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Poses by odometry, and how they lie in the map.
#[derive(Debug, Default)]
pub(crate) struct WheelOdometry {
    pub(crate) link: OdometryLink,
    last: Option<(Stamp, Rigid)>,
    /// Grows when odometry begins anew.
    segment: u32,
    /// Frames of the last seconds.
    measured: VecDeque<MeasuredFrame>,
    check: SensorCheck,
}

/// A frame whose place was measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MeasuredFrame {
    pub(crate) seq: u64,
    pub(crate) stamp: Stamp,
    pub(crate) anchor: Anchor,
}

impl WheelOdometry {
    /// A frame without odometry is skipped.
    pub(crate) fn push(&mut self, frame: &Frame) {
        let Some(odometry_from_cam) = frame.odometry else {
            return;
        };
        if let Some((stamp, before)) = &self.last {
            let step = before.inverse() * odometry_from_cam;
            if !is_continuous(&step, frame.stamp.secs_since(*stamp)) {
                self.segment += 1;
            }
        }
        self.last = Some((frame.stamp, odometry_from_cam));
        let pose = OdometryPose {
            segment: self.segment,
            odometry_from_cam,
            // What a way adds is what the map has seen odometry drift by (`OdometryLink`).
            covariance: Default::default(),
            n_inliers: 0,
        };
        self.link.push(frame.seq, Some(pose));
    }

    pub(crate) fn has_come(&self) -> bool {
        self.last.is_some()
    }

    /// Whether odometry has disagreed with what the map measured.
    pub(crate) fn is_out(&self) -> bool {
        self.check.is_out()
    }

    /// One more frame whose place was measured; `pose_of` gives those of frames before by the map of this moment.
    pub(crate) fn compare(
        &mut self,
        frame: MeasuredFrame,
        scene_depth: f64,
        pose_of: impl Fn(&Anchor) -> Option<Rigid>,
    ) {
        let age = |other: &MeasuredFrame| frame.stamp.secs_since(other.stamp);
        let measured = &mut self.measured;
        while measured
            .front()
            .is_some_and(|first| !(0.0..MAX_COMPARED_SECS).contains(&age(first)))
        {
            measured.pop_front();
        }
        let start = measured.iter().rev().find(|f| age(f) >= COMPARED_SECS);
        let compared = start.copied().and_then(|start| {
            let motion = self.link.motion(start.seq, frame.seq)?;
            let measured = pose_of(&start.anchor)?.inverse() * pose_of(&frame.anchor)?;
            Some(misfit(&motion, &measured, scene_depth))
        });
        if let Some(misfit) = compared {
            self.check.note("odometry", frame.stamp, misfit);
        }
        self.measured.push_back(frame);
    }
}

/// By how many standard deviations two motions differ, the larger of place and turn.
fn misfit(motion: &LinkedMotion, measured: &Rigid, scene_depth: f64) -> f64 {
    let std = |axes: std::ops::Range<usize>| {
        let variance = axes.map(|i| motion.covariance[(i, i)]).sum::<f64>() / 3.0;
        variance.sqrt()
    };
    let stds = (std(0..3), std(3..6));
    sensor_check::misfit(&motion.earlier_from_later, stds, measured, scene_depth)
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::track::odometry_link::LinkedKeyframe;

    fn way(seq: u64) -> Rigid {
        let secs = seq as f64 * 0.1;
        let place = DVec3::new(0.6 * secs, 0.1 * (1.3 * secs).sin(), 0.0);
        Rigid::new(DQuat::from_rotation_z(0.3 * (0.7 * secs).sin()), place)
    }

    fn stamp(seq: u64) -> Stamp {
        Stamp::from_nanos(seq as i64 * 100_000_000)
    }

    /// Frames of the way at 10 Hz, and a keyframe every fifth until the fault: seconds of the frames after which odometry was
    /// out, and back.
    fn run(fault: impl Fn(u64) -> Rigid) -> (Option<f64>, Option<f64>) {
        let mut wheels = WheelOdometry::default();
        let (mut out, mut back) = (None, None);
        for seq in 0..200 {
            let pose = OdometryPose {
                segment: 0,
                odometry_from_cam: fault(seq),
                covariance: Default::default(),
                n_inliers: 0,
            };
            wheels.link.push(seq, Some(pose));
            if seq % 5 == 0 && seq <= 50 {
                let keyframes = (0..=seq / 5).map(|id| LinkedKeyframe {
                    id: id as u32,
                    seq: 5 * id,
                    world_from_cam: way(5 * id),
                });
                wheels.link.update(keyframes);
            }
            let anchor = Anchor {
                keyframe_id: 0,
                key_from_cam: way(seq),
                unit: 1.0,
            };
            let frame = MeasuredFrame {
                seq,
                stamp: stamp(seq),
                anchor,
            };
            wheels.compare(frame, 2.0, |anchor| Some(anchor.key_from_cam));
            let secs = seq as f64 * 0.1;
            match wheels.is_out() {
                true if out.is_none() => out = Some(secs),
                false if out.is_some() && back.is_none() => back = Some(secs),
                _ => {}
            }
        }
        (out, back)
    }

    #[test]
    fn odometry_that_agrees_is_never_left_out() {
        assert_eq!(run(way), (None, None));
    }

    #[test]
    fn odometry_that_freezes_for_a_while_is_left_out_and_taken_back() {
        let (out, back) = run(|seq| match seq {
            0..60 => way(seq),
            60..100 => way(60),
            _ => way(60) * (way(100).inverse() * way(seq)),
        });
        let (out, back) = (out.unwrap(), back.unwrap());
        assert!((6.0..7.6).contains(&out), "out after {out} s");
        assert!((14.5..16.5).contains(&back), "back after {back} s");
    }

    #[test]
    fn odometry_with_a_wrong_length_or_heading_is_left_out() {
        let long = run(|seq| {
            let mut pose = way(seq);
            pose.translation.x *= if seq < 60 { 1.0 } else { 1.3 };
            pose
        });
        assert!(
            long.0.is_some_and(|out| (6.0..8.0).contains(&out)),
            "{long:?}"
        );
        let turned = run(|seq| {
            let wrong = 0.02 * seq.saturating_sub(60) as f64;
            way(seq) * Rigid::new(DQuat::from_rotation_z(wrong), DVec3::ZERO)
        });
        assert!(
            turned.0.is_some_and(|out| (6.0..8.0).contains(&out)),
            "{turned:?}"
        );
    }
}
