//! Visual odometry among the keyframes of the map: where a frame is, however far the map is behind.
//!
//! Odometry has a frame and a unit of its own. Keyframes that the map has registered have a pose in both, so that the unit
//! follows from distances between them, and a frame's pose from the newest of them and the odometry since.

use std::collections::VecDeque;

use glam::DQuat;
use nalgebra::Matrix6;

use crate::track::anchor::Anchor;
use crate::visual_odometry::odometry::OdometryPose;
use splat_geometry::stats::median;
use splat_types::transform::{Rigid, Similarity};

/// Frames whose odometry is remembered: a minute at 30 Hz, beyond which no keyframe waits for its pose.
const MAX_FRAMES: usize = 1800;
/// Keyframes that the unit is measured by, the newest ones: odometry drifts in scale.
const N_KEYFRAMES: usize = 8;
const MIN_KEYFRAMES: usize = 3;
/// Distances below this share of the largest one are mostly noise.
const MIN_BASELINE_SHARE: f64 = 0.3;
/// A unit by distances that scatter by more says nothing.
const MAX_UNIT_STD: f64 = 0.3;
/// Drift of visual odometry, as a share of the distance, where it has not been measured.
pub(crate) const MIN_UNIT_STD: f64 = 0.02;
/// The same for what it has turned wrongly: radians per axis, for each radian turned and each median depth gone.
const MIN_TURN_DRIFT: f64 = 0.01;

/// A keyframe of the map that odometry has seen.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinkedKeyframe {
    pub(crate) id: u32,
    pub(crate) seq: u64,
    pub(crate) world_from_cam: Rigid,
}

#[derive(Debug, Clone, Copy)]
struct Link {
    segment: u32,
    keyframe_id: u32,
    odometry_from_key: Rigid,
    /// Units of the map in one of odometry, and its relative standard deviation.
    unit: f64,
    unit_std: f64,
    /// As `MIN_TURN_DRIFT`.
    turn_drift: f64,
}

impl Link {
    /// The way from a frame to a later one in the map's unit, and its covariance in the axes of the later camera.
    fn motion(&self, odometry_from_start: &Rigid, pose: &OdometryPose) -> (Rigid, Matrix6<f64>) {
        let mut start_from_cam = odometry_from_start.inverse() * pose.odometry_from_cam;
        let turned = self.turn_drift * path_length(&start_from_cam);
        start_from_cam.translation *= self.unit;
        let unit = |axis: usize| if axis < 3 { self.unit } else { 1.0 };
        let mut covariance = Matrix6::from_fn(|i, j| pose.covariance[i][j] * unit(i) * unit(j));
        let way = start_from_cam.inverse().translation;
        // What is turned wrongly on the way is so by half on average: the place moves across the way.
        let across = (0.5 * turned * way.length()).powi(2);
        (0..3).for_each(|i| covariance[(i, i)] += across);
        (3..6).for_each(|i| covariance[(i, i)] += turned.powi(2));
        // A wrong unit moves the camera along the way, here in the camera's axes.
        let along = (way * self.unit_std).to_array();
        for (i, a) in along.iter().enumerate() {
            for (j, b) in along.iter().enumerate() {
                covariance[(i, j)] += a * b;
            }
        }
        (start_from_cam, covariance)
    }

    /// The map's frame from odometry's, for a keyframe that stands at `world_from_key`.
    fn world_from_odometry(&self, world_from_key: &Rigid) -> Similarity {
        let rotation = world_from_key.rotation * self.odometry_from_key.rotation.inverse();
        let place = rotation * self.odometry_from_key.translation * self.unit;
        Similarity {
            scale: self.unit,
            rotation,
            translation: world_from_key.translation - place,
        }
    }
}

/// A pose by odometry, relative to a keyframe.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinkedPose {
    pub(crate) keyframe_id: u32,
    /// Translation in the map's unit.
    pub(crate) key_from_cam: Rigid,
    /// Of the camera in its own axes, relative to the keyframe.
    pub(crate) covariance: Matrix6<f64>,
    pub(crate) n_inliers: usize,
}

/// The motion between two frames by odometry.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinkedMotion {
    /// Translation in the map's unit.
    pub(crate) earlier_from_later: Rigid,
    /// Of the later camera in its own axes, relative to the earlier one.
    pub(crate) covariance: Matrix6<f64>,
    pub(crate) n_inliers: usize,
}

/// Odometry of the frames so far, and how it lies in the map.
#[derive(Debug, Default)]
pub(crate) struct OdometryLink {
    frames: VecDeque<(u64, OdometryPose)>,
    link: Option<Link>,
    /// Keyframes of frames that are remembered, in order of `seq`.
    keyframes: Vec<LinkedKeyframe>,
}

impl OdometryLink {
    /// Odometry of one more frame; `None` where it found no pose.
    pub(crate) fn push(&mut self, seq: u64, pose: Option<OdometryPose>) {
        if let Some(pose) = pose {
            self.frames.push_back((seq, pose));
        }
        if self.frames.len() > MAX_FRAMES {
            self.frames.pop_front();
        }
    }

    /// Of frame `seq`.
    pub(crate) fn pose_of(&self, seq: u64) -> Option<&OdometryPose> {
        let ix = self.frames.binary_search_by_key(&seq, |(seq, _)| *seq);
        ix.ok().map(|ix| &self.frames[ix].1)
    }

    /// Takes over where the map has its keyframes now; in order of id. Returns the newest segment and how its frame lies
    /// in the map, where that has become known anew.
    pub(crate) fn update(
        &mut self,
        keyframes: impl DoubleEndedIterator<Item = LinkedKeyframe>,
    ) -> Option<(u32, Similarity)> {
        let segment = self.frames.back()?.1.segment;
        let oldest = self.frames.front()?.0;
        let remembered = keyframes
            .rev()
            .take_while(|keyframe| keyframe.seq >= oldest);
        self.keyframes = remembered.collect();
        self.keyframes.reverse();
        let known = self.keyframes.iter().copied().rev().filter_map(|keyframe| {
            let pose = self.pose_of(keyframe.seq)?;
            (pose.segment == segment).then_some((keyframe, pose.odometry_from_cam))
        });
        let known: Vec<(LinkedKeyframe, Rigid)> = known.take(N_KEYFRAMES).collect();
        let (newest, odometry_from_key) = known.first().copied()?;
        let (unit, unit_std) = unit_of(&known)?;
        let link = Link {
            segment,
            keyframe_id: newest.id,
            odometry_from_key,
            unit,
            unit_std: unit_std.max(MIN_UNIT_STD),
            turn_drift: turn_drift(&known).max(MIN_TURN_DRIFT),
        };
        self.link = Some(link);
        Some((segment, link.world_from_odometry(&newest.world_from_cam)))
    }

    /// The keyframe before a frame and the frame's pose in it, by the keyframes on both sides and the odometry between: each says
    /// where it was, and the nearer one counts for more, as drift grows with the way. `None` where the map has not reached the
    /// frame or odometry was lost between.
    pub(crate) fn between_keyframes(&self, seq: u64) -> Option<(u32, Rigid)> {
        let (link, pose) = self.link.as_ref().zip(self.pose_of(seq))?;
        let next = self
            .keyframes
            .partition_point(|keyframe| keyframe.seq < seq);
        let (before, after) = (
            self.keyframes.get(next.checked_sub(1)?)?,
            self.keyframes.get(next)?,
        );
        let by = |keyframe: &LinkedKeyframe| {
            let of_key = self.pose_of(keyframe.seq)?;
            let is_linked = of_key.segment == pose.segment && pose.segment == link.segment;
            let mut key_from_cam = of_key.odometry_from_cam.inverse() * pose.odometry_from_cam;
            key_from_cam.translation *= link.unit;
            is_linked.then(|| keyframe.world_from_cam * key_from_cam)
        };
        let (first, last) = (by(before)?, by(after)?);
        let share = (seq - before.seq) as f64 / (after.seq - before.seq) as f64;
        let world_from_cam = Rigid {
            rotation: first.rotation.slerp(last.rotation, share),
            translation: first.translation.lerp(last.translation, share),
        };
        Some((before.id, before.world_from_cam.inverse() * world_from_cam))
    }

    /// Where frame `seq` is by a keyframe and the odometry since; `None` where there is no way from one to the other.
    pub(crate) fn locate(&self, seq: u64) -> Option<LinkedPose> {
        let (link, pose) = self.link.as_ref().zip(self.pose_of(seq))?;
        if link.segment != pose.segment {
            return None;
        }
        let (key_from_cam, covariance) = link.motion(&link.odometry_from_key, pose);
        Some(LinkedPose {
            keyframe_id: link.keyframe_id,
            key_from_cam,
            covariance,
            n_inliers: pose.n_inliers,
        })
    }

    /// How the camera has moved from one frame to a later one; `None` where odometry was lost between or has no place in the map.
    pub(crate) fn motion(&self, earlier: u64, later: u64) -> Option<LinkedMotion> {
        let (link, start) = self.link.as_ref().zip(self.pose_of(earlier))?;
        let pose = self.pose_of(later)?;
        if start.segment != pose.segment || link.segment != pose.segment {
            return None;
        }
        let (earlier_from_later, covariance) = link.motion(&start.odometry_from_cam, pose);
        Some(LinkedMotion {
            earlier_from_later,
            covariance,
            n_inliers: pose.n_inliers,
        })
    }
}

impl LinkedPose {
    /// As the tracker remembers it; `unit` is that of the keyframe's depths.
    pub(crate) fn anchor(&self, unit: f64) -> Anchor {
        Anchor {
            keyframe_id: self.keyframe_id,
            key_from_cam: self.key_from_cam,
            unit,
        }
    }
}

/// Units of the map in one of odometry, and the relative standard error: the median over pairs of keyframes of the ratio of
/// their distances, and the median deviation from it.
fn unit_of(keyframes: &[(LinkedKeyframe, Rigid)]) -> Option<(f64, f64)> {
    if keyframes.len() < MIN_KEYFRAMES {
        return None;
    }
    let mut distances = Vec::new();
    for (i, (first, odometry_first)) in keyframes.iter().enumerate() {
        for (second, odometry_second) in &keyframes[i + 1..] {
            let of_map = first.world_from_cam.translation - second.world_from_cam.translation;
            let of_odometry = odometry_first.translation - odometry_second.translation;
            distances.push((of_map.length(), of_odometry.length()));
        }
    }
    let farthest = distances.iter().map(|d| d.1).fold(0.0, f64::max);
    let is_long = |d: &&(f64, f64)| d.1 > MIN_BASELINE_SHARE * farthest && d.0 > 0.0;
    let ratios = distances.iter().filter(is_long).map(|d| (d.0 / d.1).ln());
    let mut logs: Vec<f64> = ratios.filter(|log| log.is_finite()).collect();
    let log_unit = median(&mut logs)?;
    let mut off: Vec<f64> = logs.iter().map(|log| (log - log_unit).abs()).collect();
    // The median absolute deviation of a normal distribution is 0.6745 of its standard deviation.
    let std = median(&mut off)? / 0.6745;
    (std < MAX_UNIT_STD).then_some((log_unit.exp(), std))
}

/// What odometry's drift grows with: radians turned and median depths gone.
fn path_length(motion: &Rigid) -> f64 {
    motion.rotation.angle_between(DQuat::IDENTITY) + motion.translation.length()
}

/// How much of the turn between keyframes odometry and the map disagree by, per axis, as a share of the path.
fn turn_drift(keyframes: &[(LinkedKeyframe, Rigid)]) -> f64 {
    let mut sums = [0.0, 0.0];
    for pair in keyframes.windows(2) {
        let (later, earlier) = (&pair[0], &pair[1]);
        let of_map = earlier.0.world_from_cam.inverse() * later.0.world_from_cam;
        let of_odometry = earlier.1.inverse() * later.1;
        sums[0] += of_map.angle_to(&of_odometry).powi(2) / 3.0;
        sums[1] += path_length(&of_odometry).powi(2);
    }
    if sums[1] > 0.0 {
        (sums[0] / sums[1]).sqrt()
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use splat_types::transform::Similarity;

    fn way(seq: u64) -> Rigid {
        let t = seq as f64 * 0.1;
        let rotation = DQuat::from_rotation_y(0.2 * t.sin());
        Rigid::new(rotation, DVec3::new(t, 0.3 * (2.0 * t).sin(), 0.1 * t * t))
    }

    fn pose(segment: u32, odometry_from_cam: Rigid) -> OdometryPose {
        OdometryPose {
            segment,
            odometry_from_cam,
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| if i == j { 1e-6 } else { 0.0 })
            }),
            n_inliers: 80,
        }
    }

    fn map_from_odometry() -> Similarity {
        Similarity {
            scale: 2.5,
            rotation: DQuat::from_rotation_z(0.7),
            translation: DVec3::new(3.0, -1.0, 0.5),
        }
    }

    fn keyframe(id: u32, seq: u64) -> LinkedKeyframe {
        LinkedKeyframe {
            id,
            seq,
            world_from_cam: map_from_odometry().transform_pose(&way(seq)),
        }
    }

    #[test]
    fn a_frame_ahead_of_the_map_has_its_place_in_it() {
        let mut link = OdometryLink::default();
        for seq in 0..40 {
            link.push(seq, Some(pose(0, way(seq))));
        }
        assert!(link.locate(39).is_none(), "there is no map");
        link.update([keyframe(0, 0), keyframe(1, 10)].into_iter());
        assert!(
            link.locate(39).is_none(),
            "two keyframes leave the unit open"
        );
        let keyframes = [keyframe(0, 0), keyframe(1, 10), keyframe(2, 20)];
        let (segment, map) = link.update(keyframes.into_iter()).unwrap();
        assert_eq!(segment, 0);
        let (point, truth) = (DVec3::new(0.3, -2.0, 5.0), map_from_odometry());
        assert!((map.transform_point(point) - truth.transform_point(point)).length() < 1e-9);
        let found = link.locate(39).unwrap();
        assert_eq!(found.keyframe_id, 2);
        let world_from_cam = keyframe(2, 20).world_from_cam * found.key_from_cam;
        let expected = map_from_odometry().transform_pose(&way(39));
        assert!((world_from_cam.translation - expected.translation).length() < 1e-9);
        assert!(world_from_cam.angle_to(&expected) < 1e-9);
        // The unit is uncertain along the way from the keyframe, and the turn by what was turned and gone.
        let path = path_length(&(way(20).inverse() * way(39)));
        let turned = found.covariance[(4, 4)].sqrt();
        assert!(
            (turned - MIN_TURN_DRIFT * path).abs() < 2e-3 * path,
            "{turned}"
        );
        let far = found.key_from_cam.translation.length();
        let std = (0..3).map(|i| found.covariance[(i, i)]).sum::<f64>().sqrt();
        let across = 0.5 * turned * 3.0_f64.sqrt();
        assert!(
            (std / far - MIN_UNIT_STD.hypot(across)).abs() < 2e-3,
            "{std} of {far}"
        );
    }

    #[test]
    fn what_odometry_turns_wrongly_between_keyframes_is_the_stated_uncertainty() {
        let mut link = OdometryLink::default();
        for seq in 0..40 {
            let wrong = Rigid::new(DQuat::from_rotation_x(5e-3 * seq as f64), DVec3::ZERO);
            link.push(seq, Some(pose(0, way(seq) * wrong)));
        }
        link.update([keyframe(0, 0), keyframe(1, 10), keyframe(2, 20)].into_iter());
        let (motion, found) = (link.motion(20, 30).unwrap(), link.locate(30).unwrap());
        assert!(motion.earlier_from_later.angle_to(&found.key_from_cam) < 1e-9);
        assert_eq!(motion.covariance, found.covariance);
        // 0.05 rad in ten frames, over three axes.
        let turned = (3..6)
            .map(|i| motion.covariance[(i, i)])
            .sum::<f64>()
            .sqrt();
        assert!((0.03..0.08).contains(&turned), "{turned}");
    }

    #[test]
    fn another_segment_has_no_way_to_the_map() {
        let mut link = OdometryLink::default();
        for seq in 0..30 {
            link.push(seq, Some(pose(0, way(seq))));
        }
        link.update([keyframe(0, 0), keyframe(1, 10), keyframe(2, 20)].into_iter());
        link.push(30, Some(pose(1, Rigid::IDENTITY)));
        assert!(link.locate(29).is_some() && link.locate(30).is_none());
    }

    #[test]
    fn a_frame_that_the_map_has_reached_is_where_both_keyframes_beside_it_say() {
        let mut link = OdometryLink::default();
        // Odometry drifts by a thousandth of a turn and of its unit a frame.
        for seq in 0..60 {
            let drift = Rigid::new(
                DQuat::from_rotation_y(1e-3 * seq as f64),
                DVec3::new(0.0, 1e-3 * seq as f64, 0.0),
            );
            link.push(seq, Some(pose(0, drift * way(seq))));
        }
        let keyframes = [10, 20, 30, 40].map(|seq| keyframe(seq as u32 / 10, seq));
        link.update(keyframes.into_iter());
        let world = |found: (u32, Rigid)| {
            keyframe(found.0, u64::from(found.0) * 10).world_from_cam * found.1
        };
        let off = |found: Rigid, seq: u64| {
            let truth = map_from_odometry().transform_pose(&way(seq));
            found.translation.distance(truth.translation)
        };
        for seq in [11, 19, 25, 34, 39] {
            let between = link.between_keyframes(seq).unwrap();
            assert_eq!(u64::from(between.0), seq / 10);
            let error = off(world(between), seq);
            assert!(error < 2e-3, "frame {seq} is {error} off");
        }
        // By the newest keyframe alone a frame nine further on is an order worse.
        let ahead = link.locate(49).unwrap();
        let ahead = off(world((ahead.keyframe_id, ahead.key_from_cam)), 49);
        let between = off(world(link.between_keyframes(39).unwrap()), 39);
        assert!(ahead > 5.0 * between, "{ahead} ahead, {between} between");
        assert!(link.between_keyframes(9).is_none() && link.between_keyframes(41).is_none());
    }

    #[test]
    fn distances_that_disagree_give_no_unit() {
        let mut link = OdometryLink::default();
        for seq in 0..30 {
            link.push(seq, Some(pose(0, way(seq))));
        }
        let mut wrong = [keyframe(0, 0), keyframe(1, 10), keyframe(2, 20)];
        wrong[1].world_from_cam.translation *= 4.0;
        link.update(wrong.into_iter());
        assert!(link.locate(29).is_none());
    }
}
