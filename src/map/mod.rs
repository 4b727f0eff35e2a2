//! Geometry of batches -> one map of splats and poses that grows, is optimised and can be copied.
//!
//! The only part that knows the map frame. Owns the engine; reads back from it only when a batch comes, at
//! intervals of many steps, and for snapshots.

pub mod align;
pub mod checkpoint;
pub mod correction;
mod depth_scale;
pub mod figures;
pub mod frame_fit;
mod framing;
mod gauge;
mod growth;
mod held_out;
mod ids;
pub mod keyframes;
mod laid_over;
pub mod layout;
mod matches;
mod metric;
pub mod past;
mod regions;
pub mod resting;
mod revise;
pub mod saved_view;
mod saving;
pub mod schedule;
mod sections;
pub mod seed;
mod settle;
pub mod slew;
pub mod snapshot;
pub mod spill;
mod transient;
mod views;

use std::path::PathBuf;
use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::config::MapParams;
use crate::config::scale::ScaleParams;
use crate::frame::Batch;
use crate::geometry::{GeometryBatch, PoseError, View};
use crate::map::correction::Correction;
use crate::map::figures::Peaks;
use crate::map::gauge::{GAUGE_EVERY, Gauge};
use crate::map::ids::SplatIds;
use crate::map::keyframes::{Keyframes, Placed};
use crate::map::past::Past;
use crate::map::regions::Regions;
use crate::map::resting::{Disk, Home, TURN_EVERY};
use crate::map::schedule::{Phase, Schedule};
use crate::map::settle::Settling;
use crate::map::snapshot::{KeyframePose, Scale, Snapshot};
use crate::splat::{Engine, PoseStep, StepSettings, TrainingView};

/// Keyframes without a pose that are kept in case the model places them later.
pub const MAX_WAITING: usize = 200;
/// Steps between looks at a view for holes and errors, and between removals of transparent splats.
const RESEED_EVERY: u64 = 50;
const PRUNE_EVERY: u64 = 400;
/// Steps between points of the loss curve at first.
const FIRST_NOTE_EVERY: u64 = 20;
/// Seeding and removal end here, as a share of the final steps: what comes later has no time to settle.
const LAST_RESEED: f32 = 0.6;
/// All splats and poses, and the engine that improves them.
pub struct SplatMap {
    params: MapParams,
    engine: Box<dyn Engine>,
    ids: SplatIds,
    schedule: Schedule,
    rng: Pcg64Mcg,
    keyframes: Keyframes,
    /// Views that are trained on, in order of arrival.
    trainable: Vec<usize>,
    /// The model's component that the map is made of.
    component: Option<u32>,
    /// Median depth of the views, map units.
    scene_depth: f32,
    /// What the model says that poses may be off by: radians, and map units.
    pose_error: [f32; 2],
    /// `None` before views were placed.
    gauge: Option<Gauge>,
    n_put_back: u64,
    /// Not yet asked for.
    correction: Option<Correction>,
    /// Share of the input that has come, while more is to come and where it is known.
    progress: Option<f64>,
    scale: Scale,
    scale_params: Option<ScaleParams>,
    seed: u64,
    epoch: u32,
    revision: u32,
    n_steps: u64,
    /// The map that this one goes on from.
    past: Option<Past>,
    /// The model's lengths are metres.
    knows_metres: bool,
    /// What memory has no room for: splats, and pictures, both in a file in `folder`.
    regions: Regions,
    disk: Disk,
    folder: Option<PathBuf>,
    peaks: Peaks,
    loss_curve: Vec<(u64, f64)>,
    /// Steps between points of the curve.
    note_every: u64,
    settling: Settling,
    /// Index of the engine's view that frames are compared in, once one was.
    frame_view: Option<usize>,
}

impl std::fmt::Debug for SplatMap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (n_keyframes, n_splats) = (self.n_keyframes(), self.n_splats());
        write!(f, "SplatMap({n_keyframes} keyframes, {n_splats} splats)")
    }
}

impl SplatMap {
    pub fn new(params: MapParams, seed: u64, scale: Scale, engine: Box<dyn Engine>) -> Self {
        Self {
            params,
            engine,
            ids: SplatIds::default(),
            schedule: Schedule::new(seed),
            rng: Pcg64Mcg::seed_from_u64(seed ^ 0x5eed_0002),
            keyframes: Keyframes::default(),
            trainable: Vec::new(),
            component: None,
            scene_depth: 1.0,
            pose_error: [0.0; 2],
            gauge: None,
            n_put_back: 0,
            correction: None,
            progress: None,
            scale,
            scale_params: None,
            seed,
            epoch: 0,
            revision: 0,
            n_steps: 0,
            past: None,
            knows_metres: scale == Scale::GIVEN,
            regions: Regions::default(),
            disk: Disk::default(),
            folder: None,
            peaks: Peaks::default(),
            loss_curve: Vec::new(),
            note_every: FIRST_NOTE_EVERY,
            settling: Settling::default(),
            frame_view: None,
        }
    }

    /// Adds what the model says of a batch; `progress` is the share of the input that has come, where known.
    /// Returns the ids of the keyframes that are in the map since.
    pub fn add(
        &mut self,
        batch: Option<&Batch>,
        geometry: GeometryBatch,
        progress: Option<f64>,
    ) -> Vec<u32> {
        if let Some(batch) = batch {
            self.keyframes.remember(&batch.keyframes, MAX_WAITING);
        }
        self.progress = progress;
        self.look_for_past(batch, &geometry);
        self.hold_gauge();
        self.revise(&geometry);
        self.note_sightings(geometry.sightings);
        let mut own = Vec::new();
        for view in geometry.views {
            let component = *self.component.get_or_insert(view.component);
            if view.component == component {
                self.keyframes.foreign.remove(&view.keyframe_id);
                own.push(view);
            } else if self.keyframes.waiting.contains_key(&view.keyframe_id) {
                self.keyframes.foreign.insert(view.keyframe_id, view);
            }
        }
        own.extend(if self.past.is_some() {
            self.join_past()
        } else {
            self.take_over()
        });
        let fresh = self.place(own, geometry.pose_error);
        self.hold_keyframes(0);
        self.thin_old_depth();
        self.match_views();
        self.set_gauge();
        self.note_peaks();
        fresh
    }

    /// One optimiser update per step, with seeding and removal at their intervals. Returns the steps made, which
    /// are fewer only when there is nothing to train on.
    pub fn step(&mut self, n: u64, phase: Phase) -> u64 {
        if phase != Phase::Streaming {
            self.progress = None;
        }
        if self.waits_for_place() {
            return 0;
        }
        for done in 0..n {
            let Some(view_ix) = self.schedule.next_view(&self.trainable, phase) else {
                return done;
            };
            let settings = self.step_settings(phase);
            self.engine.step(view_ix, &settings);
            self.n_steps += 1;
            let may_change = !matches!(phase, Phase::Final(share) if share > LAST_RESEED);
            if may_change && self.n_steps.is_multiple_of(RESEED_EVERY) {
                self.reseed(phase);
            }
            if self.n_steps.is_multiple_of(self.note_every) {
                self.note_loss();
            }
            if may_change && self.n_steps.is_multiple_of(PRUNE_EVERY) {
                self.prune();
            }
            let may_move = may_change && self.params.mcmc && self.n_steps >= self.params.mcmc_start;
            if may_move && self.n_steps.is_multiple_of(self.params.mcmc_every) {
                self.relocate();
            }
            if self.n_steps.is_multiple_of(TURN_EVERY) {
                self.take_turns();
                self.note_peaks();
            }
            if self.n_steps.is_multiple_of(GAUGE_EVERY) {
                if settings.pose != PoseStep::Held {
                    self.hold_gauge();
                }
                self.fit_depths();
            }
        }
        n
    }

    /// Poses and splats as they are.
    pub fn snapshot(&mut self) -> Arc<Snapshot> {
        let map_from_cams = self.engine.poses();
        let focal_factor = self.engine.focal_factor();
        let poses: Vec<KeyframePose> = self
            .keyframes
            .placed
            .values()
            .map(|placed| KeyframePose {
                keyframe_id: placed.keyframe.id,
                stamp: placed.keyframe.frame.stamp,
                map_from_cam: map_from_cams[placed.view_ix].inverse(),
                intrinsics: placed.intrinsics.refocused(focal_factor),
            })
            .collect();
        self.scale = self.measure_scale(self.own(&poses));
        self.revision += 1;
        let (splats, splat_ids) = self.finite_splats();
        Arc::new(Snapshot {
            map_id: self.map_id(),
            epoch: self.epoch,
            revision: self.revision,
            stamp: poses.last().map(|pose| pose.stamp).unwrap_or_default(),
            scale: self.scale,
            poses,
            splats: Arc::new(splats),
            splat_ids: Arc::new(splat_ids),
        })
    }

    /// (id, is held out) of every keyframe in the map that has a picture, and nothing on disk of what it shows.
    pub fn keyframe_ids(&self) -> Vec<(u32, bool)> {
        self.keyframes
            .placed
            .iter()
            .filter(|(_, p)| (p.home.is_here || p.home.copy.is_some()) && !p.home.rests)
            .map(|(id, placed)| (*id, placed.is_held_out))
            .collect()
    }

    /// Keyframes per component: the map's first, then those that have no known relation to it.
    pub fn components(&self) -> Vec<usize> {
        let own = self.keyframes.placed.len();
        let foreign = self.keyframes.foreign_counts();
        (own > 0)
            .then_some(own)
            .into_iter()
            .chain(foreign.into_values())
            .collect()
    }

    pub fn n_keyframes(&self) -> usize {
        self.keyframes.placed.len()
    }

    pub fn has_keyframe(&self, keyframe_id: u32) -> bool {
        self.keyframes.placed.contains_key(&keyframe_id)
    }

    pub fn n_splats(&self) -> usize {
        self.engine.n_splats()
    }

    pub fn n_steps(&self) -> u64 {
        self.n_steps
    }

    /// What has broken for good in the engine.
    pub fn fault(&self) -> Option<String> {
        self.engine.fault()
    }

    pub fn peak_gpu_bytes(&self) -> u64 {
        self.engine.peak_gpu_bytes()
    }

    pub fn adapter(&self) -> String {
        self.engine.adapter()
    }

    fn step_settings(&self, phase: Phase) -> StepSettings {
        schedule::settings(&self.params, self.scene_depth, self.pose_error, phase)
    }

    /// Gives views of the map's own component their place, and seeds splats from them.
    fn place(&mut self, views: Vec<View>, pose_error: PoseError) -> Vec<u32> {
        if views.is_empty() {
            return Vec::new();
        }
        let map_poses = self.engine.poses();
        let map_from_model = self.map_from_model(&map_poses);
        self.pose_error[1] =
            self.pose_error[1].max((pose_error.translation * map_from_model.scale) as f32);
        self.pose_error[0] = self.pose_error[0].max(pose_error.rotation_rad as f32);
        self.hold_keyframes(self.n_unplaced(&views));
        let (mut fresh, mut deepened) = (Vec::new(), Vec::new());
        for view in views {
            let given = self.keyframes.placed.get(&view.keyframe_id);
            let factor = map_from_model.scale * given.map_or(1.0, |placed| placed.depth_factor);
            let depth = Arc::new(keyframes::rescaled(&view.depth, factor));
            let median_depth = depth.median();
            if self.has_keyframe(view.keyframe_id) {
                if self.told_again(&view, depth) {
                    deepened.push(view.keyframe_id);
                }
            } else if let Some(keyframe) = self.keyframes.waiting.remove(&view.keyframe_id) {
                let (image, intrinsics) =
                    keyframes::picture(&keyframe, &view, self.params.max_side);
                let cam_from_map = map_from_model
                    .transform_pose(&view.batch_from_cam)
                    .inverse();
                let view_ix = self.engine.add_view(TrainingView {
                    image: Arc::clone(&image),
                    intrinsics,
                    cam_from_map,
                    depth: Some(Arc::clone(&depth)),
                    mask: None,
                });
                let every = self.params.holdout;
                let is_held_out = keyframe.frame.is_held_out
                    || (every > 0 && view.keyframe_id % every == every / 2);
                let id = view.keyframe_id;
                self.keyframes.placed.insert(
                    id,
                    Placed {
                        keyframe,
                        view_ix,
                        model_from_cam: view.batch_from_cam,
                        image,
                        intrinsics,
                        lens: view.lens,
                        depth,
                        median_depth,
                        depth_factor: 1.0,
                        n_depth_looks: 0,
                        ratios: None,
                        health: view.health,
                        is_held_out,
                        home: Home::here(),
                    },
                );
                if !is_held_out {
                    self.trainable.push(view_ix);
                }
                fresh.push(id);
            }
        }
        self.measure_scene();
        self.prune();
        self.seed_all(&fresh, &deepened);
        fresh
    }
}
