//! Poses that have drifted together, or jumped alone -> poses that stay by what the model gave.
//!
//! Images do not say where the map frame is: a motion of all cameras and splats together changes none of them,
//! so optimisers wander along it. And they report little about a view that is badly wrong: one that has jumped goes
//! back to the model's pose.

use std::collections::BTreeSet;

use glam::DVec3;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::splats::transform::transform_all;
use splat_engine::error::EngineError;
use splat_engine::settings::{FirstEmbedding, PoseNetworkSettings};
use splat_engine::traits::Engine;
use splat_geometry::similarity;
use splat_types::transform::{Rigid, Similarity};

/// Steps between looks at the poses.
pub(crate) const ANCHOR_EVERY: u64 = 250;
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
struct AnchorState {
    world_from_submap: Similarity,
    /// RMS distance of the cameras to their mean when the network was started.
    network_scale: f64,
}

/// Holds the map where it was when views were last registered.
#[derive(Debug, Default)]
pub(crate) struct PoseAnchor {
    /// `None` before views were registered.
    state: Option<AnchorState>,
    /// Lengths are those of the model, which are metres.
    keeps_scale: bool,
    n_put_back: u64,
}

impl PoseAnchor {
    /// From now on lengths stay what the model gave, too: images do not show them either, and rendered depth lies a little behind
    /// the surfaces, so that the depth loss shrinks a map (kitchen7s_rgbd by 0.8 % within 1,500 steps).
    pub(crate) fn keep_scale(&mut self) {
        self.keeps_scale = true;
    }

    /// Nothing is registered any more.
    pub(crate) fn clear(&mut self) {
        self.state = None;
    }

    /// Views put back because they had jumped.
    pub(crate) fn n_put_back(&self) -> u64 {
        self.n_put_back
    }

    /// After views were registered: remembers where the map lies, and starts the network, if there is a seed and a first embedding for one,
    /// where it is due.
    pub(crate) fn set(
        &mut self,
        network: Option<(u64, FirstEmbedding)>,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let map_poses = engine.poses()?;
        let world_from_submap = keyframes.world_from_submap(&map_poses);
        let spread = spread(keyframes, &map_poses);
        let old = self.state.map_or(0.0, |state| state.network_scale);
        let is_due = spread > RESTART_GROWTH * old;
        if let Some((seed, embedding)) = network.filter(|_| is_due) {
            engine.start_pose_network(&PoseNetworkSettings {
                embedding,
                seed,
                camera_scale: spread as f32,
            })?;
        }
        self.state = Some(AnchorState {
            world_from_submap,
            network_scale: if is_due { spread } else { old },
        });
        Ok(())
    }

    /// Moves all cameras and splats back by what they have moved together, and views that have jumped alone.
    pub(crate) fn hold(
        &mut self,
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let Some(state) = self.state else {
            return Ok(());
        };
        let mut map_poses = engine.poses()?;
        self.reset_jumped(&mut map_poses, keyframes, engine)?;
        let spread = spread(keyframes, &map_poses);
        if self.keeps_scale {
            scale_back(keyframes, &state.world_from_submap, &mut map_poses, engine)?;
        }
        let back = back_to(keyframes, &state.world_from_submap, &map_poses);
        let centre = centre(keyframes, &map_poses);
        let shift = back.transform_point(centre) - centre;
        let drift = (shift.length() / spread).max(back.angle_to(&Rigid::IDENTITY));
        if drift > MIN_DRIFT && back.is_finite() {
            engine.transform_cameras(&back)?;
            transform_all(back.into(), engine)?;
        }
        Ok(())
    }

    fn reset_jumped(
        &mut self,
        map_poses: &mut [Rigid],
        keyframes: &KeyframeStore,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        let jumped = jumped(keyframes, map_poses);
        if jumped.is_empty() {
            return Ok(());
        }
        let world_from_submap = world_from_submap_without(keyframes, map_poses, &jumped);
        for id in &jumped {
            let Some(registered) = keyframes.registered().get(id) else {
                continue;
            };
            let wanted = world_from_submap.transform_pose(&registered.submap_from_cam);
            map_poses[registered.view_ix] = wanted.inverse();
            engine.set_pose(registered.view_ix, wanted.inverse())?;
            self.n_put_back += 1;
            tracing::debug!("keyframe {id} is put back");
            if self.n_put_back == 1 {
                tracing::warn!("keyframe {id} left the model's pose and is put back; said once");
            }
        }
        Ok(())
    }
}

/// Ids of views that have left the model's pose. The farthest is found first and then no longer asked where the
/// others lie: one that has jumped far would make all look as if they had.
fn jumped(keyframes: &KeyframeStore, map_poses: &[Rigid]) -> BTreeSet<u32> {
    let registered = keyframes.registered();
    let broken = registered
        .iter()
        .filter(|(_, p)| !map_poses[p.view_ix].is_finite());
    let mut jumped: BTreeSet<u32> = broken.map(|(id, _)| *id).collect();
    let [stated_turn, stated_shift] = keyframes.pose_error().map(f64::from);
    let max_turn = MAX_TURN_RAD.max(MAX_ERRORS * stated_turn);
    while jumped.len() < registered.len() {
        let world_from_submap = world_from_submap_without(keyframes, map_poses, &jumped);
        let wanted = |p: &RegisteredKeyframe| world_from_submap.transform_pose(&p.submap_from_cam);
        let rest = || registered.iter().filter(|(id, _)| !jumped.contains(id));
        // Of the places that the model gives: what has jumped has no part in it.
        let spread = spread_of(
            keyframes,
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

/// The rigid motion of the map that takes the cameras' common place and orientation to where the pose anchor has them.
fn back_to(keyframes: &KeyframeStore, wanted: &Similarity, map_poses: &[Rigid]) -> Rigid {
    let found = keyframes.world_from_submap(map_poses);
    let rotation = (wanted.rotation * found.rotation.conjugate()).normalize();
    let centre = centre(keyframes, map_poses);
    let in_model = found.inverse().transform_point(centre);
    Rigid::new(
        rotation,
        wanted.transform_point(in_model) - rotation * centre,
    )
}

/// Gives cameras and splats the lengths back that the pose anchor has, about their centre.
fn scale_back(
    keyframes: &KeyframeStore,
    wanted: &Similarity,
    map_poses: &mut [Rigid],
    engine: &mut dyn Engine,
) -> Result<(), EngineError> {
    let factor = wanted.scale / keyframes.world_from_submap(map_poses).scale;
    if !factor.is_finite() || (factor - 1.0).abs() < MIN_DRIFT || factor <= 0.0 {
        return Ok(());
    }
    let centre = centre(keyframes, map_poses);
    let back = Similarity {
        scale: factor,
        translation: centre * (1.0 - factor),
        ..Similarity::IDENTITY
    };
    for (view_ix, pose) in map_poses.iter_mut().enumerate() {
        *pose = back.transform_pose(&pose.inverse()).inverse();
        engine.set_pose(view_ix, *pose)?;
    }
    transform_all(back, engine)
}

/// Views that take part in optimisation: the others stay where they were put.
fn state(keyframes: &KeyframeStore) -> impl Iterator<Item = &RegisteredKeyframe> {
    keyframes.registered().values().filter(|p| !p.is_held_out)
}

fn centre(keyframes: &KeyframeStore, map_poses: &[Rigid]) -> DVec3 {
    let n = state(keyframes).count().max(1) as f64;
    let centres = state(keyframes).map(|p| map_poses[p.view_ix].inverse().translation);
    centres.sum::<DVec3>() / n
}

/// RMS distance of the cameras to their mean.
fn spread(keyframes: &KeyframeStore, map_poses: &[Rigid]) -> f64 {
    let places = state(keyframes).map(|p| map_poses[p.view_ix].inverse().translation);
    spread_of(keyframes, &places.collect::<Vec<_>>())
}

fn spread_of(keyframes: &KeyframeStore, places: &[DVec3]) -> f64 {
    let n = places.len().max(1) as f64;
    let centre = places.iter().sum::<DVec3>() / n;
    let squares: f64 = places
        .iter()
        .map(|at| (*at - centre).length_squared())
        .sum();
    let spread = (squares / n).sqrt();
    spread.max(MIN_SPREAD * f64::from(keyframes.scene_depth()))
}

fn world_from_submap_without(
    keyframes: &KeyframeStore,
    map_poses: &[Rigid],
    ids: &BTreeSet<u32>,
) -> Similarity {
    let pairs = keyframes.pose_pairs(map_poses, ids);
    similarity::of_poses(&pairs).unwrap_or(Similarity::IDENTITY)
}
