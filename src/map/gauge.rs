//! Poses that have drifted together, or jumped alone -> poses that stay by what the model gave.
//!
//! Pictures do not tell where the map frame is: a motion of all cameras and splats together changes none of them,
//! so optimisers wander along it. And they tell little about a view that is badly wrong: one that has jumped goes
//! back to the model's pose.

use std::collections::BTreeSet;

use glam::DVec3;

use crate::config::PoseRefinement;
use crate::map::SplatMap;
use crate::map::align::{self, Carry};
use crate::map::keyframes::Placed;
use crate::pose::{Rigid, Similarity};
use crate::splat::RefinerSettings;

/// Steps between looks at the poses.
pub(super) const GAUGE_EVERY: u64 = 250;
/// Common motion that is left alone, in radians and as a share of the spread of the cameras: moving back takes all
/// splats from the engine and returns them.
const MIN_DRIFT: f64 = 1e-3;
/// A view that has left the model's pose by more has jumped (3R-GS poses stay within a fraction of it).
const MAX_TURN_RAD: f64 = 5.0 * std::f64::consts::PI / 180.0;
/// The same for its place, as a share of the spread of the cameras.
const MAX_SHIFT: f64 = 0.1;
/// Both are at least so many standard deviations of what the model states of its poses: each of three axes may be
/// off by several, and all may have an offset in common.
const MAX_ERRORS: f64 = 6.0;
/// The network starts again when the cameras have spread by this factor: its outputs would have become too small.
const RESTART_GROWTH: f64 = 2.0;
/// Least spread of the cameras as a share of the scene's depth, for a single place.
const MIN_SPREAD: f64 = 0.05;

/// Where the map frame lies by the model, and how far the cameras spread.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gauge {
    map_from_model: Similarity,
    /// RMS distance of the cameras to their mean when the network was started.
    network_scale: f64,
}

impl SplatMap {
    /// After views were placed: remembers where the map lies, and starts the network where it is due.
    pub(super) fn set_gauge(&mut self) {
        let map_poses = self.engine.poses();
        let map_from_model = self.map_from_model(&map_poses);
        let spread = self.spread(&map_poses);
        let old = self.gauge.map_or(0.0, |gauge| gauge.network_scale);
        let is_due = spread > RESTART_GROWTH * old;
        if is_due && self.params.pose == PoseRefinement::Shared {
            self.engine.start_refiner(&RefinerSettings {
                seed: self.seed,
                camera_scale: spread as f32,
            });
        }
        self.gauge = Some(Gauge {
            map_from_model,
            network_scale: if is_due { spread } else { old },
        });
    }

    /// Moves all cameras and splats back by what they have moved together, and views that have jumped alone.
    pub(super) fn hold_gauge(&mut self) {
        let Some(gauge) = self.gauge else { return };
        let mut map_poses = self.engine.poses();
        self.put_back_jumps(&mut map_poses);
        let spread = self.spread(&map_poses);
        let back = self.back_to(&gauge.map_from_model, &map_poses);
        let shift = back.transform_point(self.centre(&map_poses)) - self.centre(&map_poses);
        let drift = (shift.length() / spread).max(back.angle_to(&Rigid::IDENTITY));
        if drift > MIN_DRIFT && back.is_finite() {
            self.engine.move_cameras(&back);
            let mut splats = self.engine.splats();
            let carry = Carry::new(back.into(), splats.sh_degree);
            (0..splats.len()).for_each(|i| carry.carry(&mut splats, i));
            self.engine.overwrite(&splats);
        }
    }

    /// Views put back because they had jumped.
    pub fn n_put_back(&self) -> u64 {
        self.n_put_back
    }

    fn put_back_jumps(&mut self, map_poses: &mut [Rigid]) {
        let jumped = self.jumped(map_poses);
        if jumped.is_empty() {
            return;
        }
        let map_from_model = self.map_from_model_without(map_poses, &jumped);
        for id in &jumped {
            let Some(placed) = self.keyframes.placed.get(id) else {
                continue;
            };
            let wanted = map_from_model.transform_pose(&placed.model_from_cam);
            map_poses[placed.view_ix] = wanted.inverse();
            self.engine.set_pose(placed.view_ix, wanted.inverse());
            self.n_put_back += 1;
            tracing::debug!("keyframe {id} is put back");
            if self.n_put_back == 1 {
                tracing::warn!("keyframe {id} left the model's pose and is put back; said once");
            }
        }
    }

    /// Ids of views that have left the model's pose. The farthest is found first and then no longer asked where the
    /// others lie: one that has jumped far would make all look as if they had.
    fn jumped(&self, map_poses: &[Rigid]) -> BTreeSet<u32> {
        let placed = &self.keyframes.placed;
        let broken = placed
            .iter()
            .filter(|(_, p)| !map_poses[p.view_ix].is_finite());
        let mut jumped: BTreeSet<u32> = broken.map(|(id, _)| *id).collect();
        let [stated_turn, stated_shift] = self.pose_error.map(f64::from);
        let max_turn = MAX_TURN_RAD.max(MAX_ERRORS * stated_turn);
        while jumped.len() < placed.len() {
            let map_from_model = self.map_from_model_without(map_poses, &jumped);
            let wanted = |p: &Placed| map_from_model.transform_pose(&p.model_from_cam);
            let rest = || placed.iter().filter(|(id, _)| !jumped.contains(id));
            // Of the places that the model gives: what has jumped has no part in it.
            let spread = self.spread_of(
                &rest()
                    .map(|(_, p)| wanted(p).translation)
                    .collect::<Vec<_>>(),
            );
            let max_shift = (MAX_SHIFT * spread).max(MAX_ERRORS * stated_shift);
            let farthest = rest()
                .map(|(id, p)| {
                    let (wanted, found) = (wanted(p), map_poses[p.view_ix].inverse());
                    let shift = (wanted.translation - found.translation).length();
                    let share = (wanted.angle_to(&found) / max_turn).max(shift / max_shift);
                    (share, *id)
                })
                .max_by(|a, b| a.0.total_cmp(&b.0));
            match farthest {
                Some((share, id)) if share > 1.0 || share.is_nan() => jumped.insert(id),
                _ => break,
            };
        }
        jumped
    }

    /// The rigid motion of the map that takes the cameras' common place and heading to where the gauge has them.
    fn back_to(&self, wanted: &Similarity, map_poses: &[Rigid]) -> Rigid {
        let found = self.map_from_model(map_poses);
        let rotation = (wanted.rotation * found.rotation.conjugate()).normalize();
        let centre = self.centre(map_poses);
        let in_model = found.inverse().transform_point(centre);
        Rigid::new(
            rotation,
            wanted.transform_point(in_model) - rotation * centre,
        )
    }

    /// Views that take part in optimisation: the others stay where they were put.
    fn anchored(&self) -> impl Iterator<Item = &Placed> {
        self.keyframes.placed.values().filter(|p| !p.is_held_out)
    }

    fn centre(&self, map_poses: &[Rigid]) -> DVec3 {
        let n = self.anchored().count().max(1) as f64;
        let centres = self
            .anchored()
            .map(|p| map_poses[p.view_ix].inverse().translation);
        centres.sum::<DVec3>() / n
    }

    /// RMS distance of the cameras to their mean.
    fn spread(&self, map_poses: &[Rigid]) -> f64 {
        let places = self
            .anchored()
            .map(|p| map_poses[p.view_ix].inverse().translation);
        self.spread_of(&places.collect::<Vec<_>>())
    }

    fn spread_of(&self, places: &[DVec3]) -> f64 {
        let n = places.len().max(1) as f64;
        let centre = places.iter().sum::<DVec3>() / n;
        let squares: f64 = places
            .iter()
            .map(|at| (*at - centre).length_squared())
            .sum();
        let spread = (squares / n).sqrt();
        spread.max(MIN_SPREAD * f64::from(self.scene_depth))
    }

    /// From the poses that the model gave to where the same cameras stand; `map_poses` by view index.
    pub(super) fn map_from_model(&self, map_poses: &[Rigid]) -> Similarity {
        self.map_from_model_without(map_poses, &BTreeSet::new())
    }

    fn map_from_model_without(&self, map_poses: &[Rigid], ids: &BTreeSet<u32>) -> Similarity {
        let pairs = self.keyframes.pose_pairs(map_poses, ids);
        align::align(&pairs).unwrap_or(Similarity::IDENTITY)
    }
}
