//! Bundle adjustment of a whole submap as work for another thread: taken out of the scene, solved apart from it, and brought
//! back into a scene that has gone on meanwhile. New keyframes never wait for it.
//!
//! ORB-SLAM2 does the same after a loop: adjusted keyframes take their new poses, and what came since follows the motion of
//! the keyframe that it hangs on (Mur-Artal and Tardós 2017, section III-E).

use std::collections::BTreeMap;

use glam::DVec3;

use crate::sfm::adjust::{AdjustTask, adjust_local, kept_scale, share_lens};
use crate::sfm::landmarks::filter;
use crate::sfm::limits::Limits;
use crate::sfm::metric_submap::make_metric;
use crate::sfm::reconstruction::{Reconstruction, Submap};
use splat_types::transform::{Rigid, Similarity};

/// The work, which needs nothing of the scene.
#[derive(Debug)]
pub struct GlobalAdjustment {
    submap: u32,
    first: usize,
    n_rebuilt: u64,
    /// Measured depth keeps the scale.
    is_metric: bool,
    task: AdjustTask,
}

/// What came of it. `GeometryModel::take_adjustment` brings it back.
#[derive(Debug)]
pub struct AdjustedSubmap {
    submap: u32,
    first: usize,
    n_rebuilt: u64,
    /// By view: `cam_from_world` before and after.
    poses: BTreeMap<usize, [Rigid; 2]>,
    /// By landmark: where it was, and where it is.
    points: BTreeMap<u32, [DVec3; 2]>,
    /// Factor on the focal length of uncalibrated views, and their radial coefficient.
    lens: Option<(f64, f64)>,
}

impl GlobalAdjustment {
    /// The submap counts as adjusted from here on. `None` where nothing could move.
    pub(crate) fn of(
        scene: &mut Reconstruction,
        submap: u32,
        max_error_px: f64,
        max_steps: usize,
    ) -> Option<Self> {
        make_metric(scene, submap);
        let Submap {
            views, is_metric, ..
        } = &scene.submaps[submap as usize];
        let (first, n, is_metric) = (*views.first()?, views.len(), *is_metric);
        let task = AdjustTask::of_submap(scene, submap, max_error_px, max_steps);
        scene.submaps[submap as usize].n_adjusted = n;
        Some(Self {
            submap,
            first,
            n_rebuilt: scene.n_rebuilt,
            is_metric,
            task,
        })
    }

    /// Takes seconds where the submap has hundreds of views.
    pub fn run(mut self) -> AdjustedSubmap {
        let task = &mut self.task;
        let start: Vec<Rigid> = poses(task).collect();
        let start_points = task.problem.points.clone();
        let shared = |task: &AdjustTask| {
            let camera = task.problem.cameras.iter().find(|c| c.shares_lens);
            camera.map(|camera| (camera.intrinsics.fx, camera.radial))
        };
        let old_lens = shared(task);
        task.solve();
        let new_lens = shared(task).filter(|_| task.moves_lens);
        let lens = old_lens
            .zip(new_lens)
            .map(|((old_fx, _), (fx, radial))| (fx / old_fx, radial));
        let kept = self.scale_back(&start);
        let task = self.task;
        let moved = poses(&task).map(|pose| kept.transform_pose(&pose.inverse()).inverse());
        let both = start.into_iter().zip(moved).map(|(old, new)| [old, new]);
        let points = start_points.into_iter().zip(&task.problem.points);
        let points = points.map(|(old, new)| [old, kept.transform_point(*new)]);
        AdjustedSubmap {
            submap: self.submap,
            first: self.first,
            n_rebuilt: self.n_rebuilt,
            poses: task.views.iter().copied().zip(both).collect(),
            points: task.landmarks.iter().copied().zip(points).collect(),
            lens,
        }
    }

    /// What puts the scale back to what it was.
    fn scale_back(&self, start: &[Rigid]) -> Similarity {
        let views = &self.task.views;
        let held = views.iter().position(|view| *view == self.first);
        let held = held.filter(|_| !self.is_metric);
        let kept = held.and_then(|ix| {
            let centre = start[ix].inverse().translation;
            let away = |pose: &Rigid| pose.inverse().translation.distance(centre);
            let before: Vec<f64> = start.iter().map(away).collect();
            let after: Vec<f64> = poses(&self.task).map(|pose| away(&pose)).collect();
            kept_scale(centre, &before, &after)
        });
        kept.unwrap_or(Similarity::IDENTITY)
    }
}

fn poses(task: &AdjustTask) -> impl Iterator<Item = Rigid> + '_ {
    task.problem.cameras.iter().map(|c| c.cam_from_world)
}

impl AdjustedSubmap {
    /// Views and landmarks of the adjustment move by what it moved them, the others with their neighbours. Returns whether
    /// it still applies: not where submaps were adjusted, merged or a loop was closed meanwhile.
    pub(crate) fn apply(&self, scene: &mut Reconstruction, limits: &Limits) -> bool {
        let submap = scene.submaps.get(self.submap as usize);
        let views = submap
            .map(|submap| submap.views.clone())
            .unwrap_or_default();
        if scene.n_rebuilt != self.n_rebuilt || views.first() != Some(&self.first) {
            return false;
        }
        scene.n_rebuilt += 1;
        let landmarks = scene.landmarks_of(&views);
        let motions = self.motions(scene, &views);
        for &landmark in &landmarks {
            let (now, seen) = {
                let landmark = &scene.landmarks[landmark as usize];
                (
                    landmark.point,
                    landmark.seen.first().map(|at| at.0 as usize),
                )
            };
            let motion = seen.and_then(|view| motions.get(&view));
            scene.landmarks[landmark as usize].point = match (self.points.get(&landmark), motion) {
                (Some([old, new]), _) if *old == now => *new,
                (Some([old, new]), _) => now + (*new - *old),
                (None, Some(motion)) => motion.transform_point(now),
                (None, None) => now,
            };
        }
        for (view, motion) in &motions {
            if let Some(registered) = &mut scene.views[*view].registered {
                let (now, both) = (registered.cam_from_world, self.poses.get(view));
                registered.cam_from_world = match both {
                    Some([old, new]) if *old == now => *new,
                    _ => (now * motion.inverse()).renormalized(),
                };
            }
        }
        if let Some((factor, radial)) = self.lens {
            share_lens(scene, factor, radial);
        }
        filter(scene, &landmarks, limits.max_error_px);
        let newest = views
            .iter()
            .rev()
            .find(|view| !self.poses.contains_key(view));
        if let Some(&newest) = newest {
            adjust_local(scene, newest, limits);
        }
        true
    }

    /// `new_world_from_old_world` about each view: by its own motion, else that of the adjusted view that it shares most landmarks
    /// with, else of the one before it.
    fn motions(&self, scene: &Reconstruction, views: &[usize]) -> BTreeMap<usize, Rigid> {
        let own = |view: usize| {
            let [old, new] = self.poses.get(&view)?;
            Some(new.inverse() * *old)
        };
        let mut motions = BTreeMap::new();
        for &view in views {
            let neighbour = || {
                let shared = scene.shared_counts(view).into_iter();
                let adjusted = shared.filter(|(other, _)| self.poses.contains_key(other));
                adjusted.max_by_key(|(_, n)| *n).map(|(other, _)| other)
            };
            let before = || {
                self.poses
                    .range(..view)
                    .next_back()
                    .map(|(other, _)| *other)
            };
            let motion = own(view)
                .or_else(|| neighbour().and_then(own))
                .or_else(|| before().and_then(own));
            motions.insert(view, motion.unwrap_or(Rigid::IDENTITY));
        }
        motions
    }
}
