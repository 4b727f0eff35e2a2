//! Geometry of batches -> one map of splats and poses that grows, is optimised and can be copied.
//!
//! The only part that knows the map frame. Owns the engine; reads back from it only when a batch comes, at
//! intervals of many steps, and for snapshots.

pub mod align;
pub mod checkpoint;
mod growth;
pub mod keyframes;
pub mod layout;
mod revise;
pub mod schedule;
pub mod seed;
pub mod snapshot;

use std::sync::Arc;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use sha2::{Digest, Sha256};

use crate::config::MapParams;
use crate::frame::{Batch, RgbImage};
use crate::geometry::{GeometryBatch, View};
use crate::map::keyframes::{Keyframes, Placed};
use crate::map::schedule::{Phase, Schedule};
use crate::map::snapshot::{KeyframePose, ScaleSource, Snapshot};
use crate::pose::{Rigid, Similarity};
use crate::splat::{Engine, Rendering, StepSettings, TrainingView};

/// Keyframes without a pose that are kept in case the model places them later.
pub const MAX_WAITING: usize = 200;
/// Steps between looks at a view for holes and errors, and between removals of transparent splats.
const RESEED_EVERY: u64 = 50;
const PRUNE_EVERY: u64 = 400;
/// Steps between points of the loss curve at first, and the points beyond which the distance doubles.
const FIRST_NOTE_EVERY: u64 = 20;
const MAX_CURVE: usize = 400;
/// Seeding and removal end here, as a share of the final steps: what comes later has no time to settle.
const LAST_RESEED: f32 = 0.6;
/// Steps that refine the pose of one held-out view, and its first rates (3R-GS: 100 steps, decay to 1 %).
const HELD_OUT_STEPS: u32 = 60;
const HELD_OUT_RATE: f32 = 5e-4;
const HELD_OUT_FINAL_RATE: f32 = 0.01;

/// All splats and poses, and the engine that improves them.
pub struct SplatMap {
    params: MapParams,
    engine: Box<dyn Engine>,
    schedule: Schedule,
    rng: Pcg64Mcg,
    keyframes: Keyframes,
    /// Views that are trained on, in order of arrival.
    trainable: Vec<usize>,
    /// The model's component that the map is made of.
    component: Option<u32>,
    /// Median depth of the views, map units.
    scene_depth: f32,
    scale: ScaleSource,
    seed: u64,
    epoch: u32,
    revision: u32,
    n_steps: u64,
    loss_curve: Vec<(u64, f64)>,
    /// Steps between points of the curve.
    note_every: u64,
}

impl std::fmt::Debug for SplatMap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "SplatMap({} keyframes, {} splats)",
            self.keyframes.placed.len(),
            self.engine.n_splats()
        )
    }
}

impl SplatMap {
    pub fn new(params: MapParams, seed: u64, scale: ScaleSource, engine: Box<dyn Engine>) -> Self {
        Self {
            params,
            engine,
            schedule: Schedule::new(seed),
            rng: Pcg64Mcg::seed_from_u64(seed ^ 0x5eed_0002),
            keyframes: Keyframes::default(),
            trainable: Vec::new(),
            component: None,
            scene_depth: 1.0,
            scale,
            seed,
            epoch: 0,
            revision: 0,
            n_steps: 0,
            loss_curve: Vec::new(),
            note_every: FIRST_NOTE_EVERY,
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
        self.revise(&geometry);
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
        own.extend(self.take_over());
        self.place(own, progress)
    }

    /// One optimiser update per step, with seeding and removal at their intervals. Returns the steps made, which
    /// are fewer only when there is nothing to train on.
    pub fn step(&mut self, n: u64, phase: Phase) -> u64 {
        for done in 0..n {
            let Some(view_ix) = self.schedule.next_view(&self.trainable, phase) else {
                return done;
            };
            let settings = schedule::settings(&self.params, self.scene_depth, phase);
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
        }
        n
    }

    /// Poses and splats as they are.
    pub fn snapshot(&mut self) -> Arc<Snapshot> {
        let map_from_cams = self.engine.poses();
        let poses: Vec<KeyframePose> = self
            .keyframes
            .placed
            .values()
            .map(|placed| KeyframePose {
                keyframe_id: placed.keyframe.id,
                stamp: placed.keyframe.frame.stamp,
                map_from_cam: map_from_cams[placed.view_ix].inverse(),
                intrinsics: placed.intrinsics,
            })
            .collect();
        self.revision += 1;
        Arc::new(Snapshot {
            map_id: self.map_id(),
            epoch: self.epoch,
            revision: self.revision,
            stamp: poses.last().map(|pose| pose.stamp).unwrap_or_default(),
            scale: self.scale,
            poses,
            splats: Arc::new(self.engine.splats().into_finite()),
        })
    }

    /// Moves each held-out view, alone and with the splats frozen, to where its picture fits best.
    pub fn refine_held_out(&mut self) {
        self.note_loss();
        let held_out: Vec<usize> = self
            .keyframes
            .placed
            .values()
            .filter(|p| p.is_held_out)
            .map(|p| p.view_ix)
            .collect();
        let last = schedule::settings(&self.params, self.scene_depth, Phase::Final(1.0));
        for view_ix in held_out {
            for step in 0..HELD_OUT_STEPS {
                let rate =
                    HELD_OUT_RATE * HELD_OUT_FINAL_RATE.powf(step as f32 / HELD_OUT_STEPS as f32);
                let settings = StepSettings {
                    train_splats: false,
                    train_pose: true,
                    lr_pose_rotation: rate,
                    lr_pose_translation: rate * self.scene_depth,
                    depth_weight: 0.0,
                    ..last.clone()
                };
                self.engine.step(view_ix, &settings);
            }
        }
        // These steps are no training: their losses must not enter the curve.
        self.engine.take_stats();
    }

    /// What the map shows from a keyframe, beside the picture that was taken there.
    pub fn render_keyframe(&mut self, keyframe_id: u32) -> Option<(Rendering, Arc<RgbImage>)> {
        let (view_ix, intrinsics, image) = {
            let placed = self.keyframes.placed.get(&keyframe_id)?;
            (placed.view_ix, placed.intrinsics, Arc::clone(&placed.image))
        };
        let cam_from_map = self.engine.poses()[view_ix];
        let sh_degree = self.params.sh_degree;
        Some((
            self.engine.render(&intrinsics, &cam_from_map, sh_degree),
            image,
        ))
    }

    /// (id, is held out) of every keyframe in the map.
    pub fn keyframe_ids(&self) -> Vec<(u32, bool)> {
        self.keyframes
            .placed
            .iter()
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

    pub fn adapter(&self) -> String {
        self.engine.adapter()
    }

    /// (step, mean loss since the one before).
    pub fn loss_curve(&self) -> &[(u64, f64)] {
        &self.loss_curve
    }

    fn map_id(&self) -> [u8; 16] {
        let first = self
            .keyframes
            .placed
            .values()
            .next()
            .map(|p| p.keyframe.frame.stamp.nanos)
            .unwrap_or(0);
        let digest = Sha256::new()
            .chain_update(self.seed.to_le_bytes())
            .chain_update(first.to_le_bytes())
            .finalize();
        std::array::from_fn(|i| digest[i])
    }

    /// Gives views of the map's own component their place, and seeds splats from them.
    fn place(&mut self, views: Vec<View>, progress: Option<f64>) -> Vec<u32> {
        if views.is_empty() {
            return Vec::new();
        }
        let map_poses = self.engine.poses();
        let map_from_model = self.map_from_model(&map_poses);
        let mut fresh = Vec::new();
        for view in views {
            let depth = Arc::new(keyframes::rescaled(&view.depth, map_from_model.scale));
            let median_depth = depth.median();
            if let Some(placed) = self.keyframes.placed.get_mut(&view.keyframe_id) {
                // A shared keyframe: more neighbours have verified its depth since.
                self.engine
                    .set_depth(placed.view_ix, Some(Arc::clone(&depth)));
                (placed.depth, placed.median_depth) = (depth, median_depth);
                placed.health = view.health;
            } else if let Some(keyframe) = self.keyframes.waiting.remove(&view.keyframe_id) {
                let image = Arc::new(keyframe.frame.image.shrunk(self.params.max_side));
                let intrinsics = view.intrinsics.resized(image.width_px, image.height_px);
                let cam_from_map = map_from_model
                    .transform_pose(&view.batch_from_cam)
                    .inverse();
                let view_ix = self.engine.add_view(TrainingView {
                    image: Arc::clone(&image),
                    intrinsics,
                    cam_from_map,
                    depth: Some(Arc::clone(&depth)),
                });
                let every = self.params.holdout;
                let is_held_out = every > 0 && view.keyframe_id % every == every / 2;
                let id = view.keyframe_id;
                self.keyframes.placed.insert(
                    id,
                    Placed {
                        keyframe,
                        view_ix,
                        model_from_cam: view.batch_from_cam,
                        image,
                        intrinsics,
                        depth,
                        median_depth,
                        health: view.health,
                        is_held_out,
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
        for id in &fresh {
            self.seed_from(*id, false, progress);
        }
        fresh
    }

    /// From the poses that the model gave to where the same cameras stand; `map_poses` by view index.
    fn map_from_model(&self, map_poses: &[Rigid]) -> Similarity {
        align::align(&self.keyframes.pose_pairs(map_poses)).unwrap_or(Similarity::IDENTITY)
    }

    fn measure_scene(&mut self) {
        let mut medians: Vec<f32> = self
            .keyframes
            .placed
            .values()
            .filter_map(|p| p.median_depth)
            .collect();
        medians.sort_by(f32::total_cmp);
        if let Some(median) = medians.get(medians.len() / 2) {
            self.scene_depth = *median;
        }
    }

    fn note_loss(&mut self) {
        let stats = self.engine.take_stats();
        if stats.n_steps > 0 {
            self.loss_curve.push((self.n_steps, stats.loss));
        }
        // A live run has no end: half the points at twice the distance show the same curve.
        if self.loss_curve.len() > MAX_CURVE {
            let mut odd = false;
            self.loss_curve.retain(|_| {
                odd = !odd;
                odd
            });
            self.note_every *= 2;
        }
    }
}
