//! Where the map has its keyframes; and how far it has moved them since it first said so -> how far off its newest ones may be.
//!
//! A keyframe's own covariance takes the landmarks for exact, which the newest ones are not: they are seen by few keyframes, and
//! adjustment, loops and the splats move both. What it has moved before is the best word on what it will.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Matrix6, Vector6};

use crate::track::anchor::Anchor;
use splat_types::transform::{Rigid, rotation_vector};

/// A keyframe has its place when so many newer ones have theirs.
const SETTLED: usize = 10;
/// What a keyframe may be off by, times what it will be moved by: before, as the map is not exact in the end, and after it has settled.
const NEW_SHARE: f64 = 1.3;
const SETTLED_SHARE: f64 = 0.6;
/// Keyframes that the statistic is made of, the last ones that have settled.
const N_KEYFRAMES: usize = 24;
/// Taken for keyframes of the past while there are none: shares of the scene's depth, and radians.
const N_PRIOR: usize = 8;
const PRIOR_DEPTHS: f64 = 0.005;
const PRIOR_RAD: f64 = 0.003;
/// Share of the motions that are smaller than the one that the standard deviation is taken from, and so many of which that one is
/// in a normal distribution: beyond the median, as few large ones matter, too.
const QUANTILE: f64 = 0.8;
const QUANTILE_OF_NORMAL: f64 = 1.2816;
/// Waiting for more newer keyframes than this, a keyframe is forgotten.
const MAX_WAITING: usize = 256;

/// Pose of every keyframe of the map, and the unit of its depths.
#[derive(Debug, Default)]
pub(crate) struct KeyframePoses {
    poses: BTreeMap<u32, (Rigid, f64)>,
    pub(crate) revisions: Revisions,
}

impl KeyframePoses {
    pub(crate) fn get(&self, id: &u32) -> Option<&(Rigid, f64)> {
        self.poses.get(id)
    }

    /// Of a keyframe's depths; 1 where the map has it no more.
    pub(crate) fn unit(&self, id: u32) -> f64 {
        self.get(&id).map_or(1.0, |(_, unit)| *unit)
    }

    /// `world_from_cam` of a frame by the keyframe's pose of this moment; `None` where the map has it no more.
    pub(crate) fn pose_by(&self, anchor: &Anchor) -> Option<Rigid> {
        let (world_from_key, unit) = self.get(&anchor.keyframe_id)?;
        let mut key_from_cam = anchor.key_from_cam;
        key_from_cam.translation *= unit / anchor.unit;
        Some(*world_from_key * key_from_cam)
    }

    /// Of a saved map.
    pub(crate) fn insert(&mut self, id: u32, pose: (Rigid, f64)) {
        self.poses.insert(id, pose);
    }

    /// All there are now.
    pub(crate) fn update(&mut self, poses: BTreeMap<u32, (Rigid, f64)>) {
        self.revisions.update(&poses);
        self.poses = poses;
    }
}

/// Where the map said at first that its newest keyframes are, and by how much it has moved others.
#[derive(Debug, Default)]
pub(crate) struct Revisions {
    /// By id: the first pose, and the unit that the map had there.
    first: BTreeMap<u32, (Rigid, f64)>,
    newest: Option<u32>,
    /// Motions of settled keyframes in their own axes, translation first.
    moved: VecDeque<[f64; 6]>,
}

impl Revisions {
    fn update(&mut self, keyframes: &BTreeMap<u32, (Rigid, f64)>) {
        for (id, (world_from_cam, unit)) in keyframes {
            if self.newest.is_none_or(|newest| *id > newest) {
                self.first.insert(*id, (*world_from_cam, *unit));
                self.newest = Some(*id);
            }
        }
        let n_settled = keyframes.len().saturating_sub(SETTLED);
        for (id, (now, unit)) in keyframes.iter().take(n_settled) {
            let Some((first, old_unit)) = self.first.remove(id) else {
                continue;
            };
            // Poses in different units have no difference.
            if (unit / old_unit - 1.0).abs() > 1e-9 {
                continue;
            }
            self.moved.push_back(motion(&(first.inverse() * *now)));
            if self.moved.len() > N_KEYFRAMES {
                self.moved.pop_front();
            }
        }
        while self.first.len() > MAX_WAITING {
            self.first.pop_first();
        }
    }

    /// Of a keyframe in its own axes; `scene_depth` in the map's unit.
    pub(crate) fn covariance(&self, id: u32, scene_depth: f64) -> Matrix6<f64> {
        let share = if self.first.contains_key(&id) {
            NEW_SHARE
        } else {
            SETTLED_SHARE
        };
        let variance = |axis: usize| {
            let prior = if axis < 3 {
                PRIOR_DEPTHS * scene_depth
            } else {
                PRIOR_RAD
            };
            let known = self.moved.iter().map(|moved| moved[axis].abs());
            let n_prior = N_PRIOR.saturating_sub(self.moved.len());
            let prior = std::iter::repeat_n(prior * QUANTILE_OF_NORMAL, n_prior);
            let mut all: Vec<f64> = known.chain(prior).collect();
            let rank = (QUANTILE * (all.len() - 1) as f64).round() as usize;
            let (_, at, _) = all.select_nth_unstable_by(rank, f64::total_cmp);
            (share * *at / QUANTILE_OF_NORMAL).powi(2)
        };
        Matrix6::from_diagonal(&Vector6::from_fn(|axis, _| variance(axis)))
    }
}

fn motion(moved: &Rigid) -> [f64; 6] {
    let (shift, turn) = (moved.translation, rotation_vector(moved.rotation));
    [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn pose(id: u32, off: f64) -> (u32, (Rigid, f64)) {
        let place = DVec3::new(f64::from(id), 0.0, off);
        (id, (Rigid::new(DQuat::IDENTITY, place), 1.0))
    }

    #[test]
    fn what_the_map_has_moved_before_is_what_the_newest_keyframes_may_be_off_by() {
        let mut revisions = Revisions::default();
        let before = revisions.covariance(0, 2.0);
        let before = before / SETTLED_SHARE.powi(2);
        assert!((before[(0, 0)].sqrt() - PRIOR_DEPTHS * 2.0).abs() < 1e-12);
        for n in 1..60 {
            // Each is moved once it has a newer one, by 0.1 to either side.
            let off = |id: u32| {
                if id + 1 == n {
                    0.0
                } else {
                    0.1 - 0.2 * f64::from(id % 2)
                }
            };
            revisions.update(&(0..n).map(|id| pose(id, off(id))).collect());
        }
        let of_settled = revisions.covariance(48, 2.0)[(2, 2)].sqrt();
        assert!((of_settled - SETTLED_SHARE * 0.1 / QUANTILE_OF_NORMAL).abs() < 1e-9);
        let after = revisions.covariance(49, 2.0);
        assert!(after[(0, 0)] < 1e-20 && after[(4, 4)] < 1e-20, "{after}");
        assert!(
            (after[(2, 2)].sqrt() - NEW_SHARE * 0.1 / QUANTILE_OF_NORMAL).abs() < 1e-9,
            "{after}"
        );
        assert!(revisions.moved.len() == N_KEYFRAMES && revisions.first.len() == SETTLED);
    }

    #[test]
    fn another_unit_is_no_motion() {
        let mut revisions = Revisions::default();
        revisions.update(&(0..20).map(|id| pose(id, 0.0)).collect());
        let rescaled = (0..40).map(|id| {
            let (id, (pose, _)) = pose(id, 0.0);
            (id, (Rigid::new(pose.rotation, pose.translation * 3.0), 3.0))
        });
        revisions.update(&rescaled.collect());
        assert!(revisions.moved.iter().flatten().all(|v| *v == 0.0));
    }
}
