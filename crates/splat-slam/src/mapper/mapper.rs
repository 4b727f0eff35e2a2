//! Geometry of batches -> one map of splats and poses that grows, is optimised and can be copied.
//!
//! The only part that knows the map frame. Owns the engine; reads back from it only when a batch comes, at
//! intervals of many steps, and for snapshots. The work is in its parts; this says in which order they act.

mod evaluation;

mod snapshots;

mod parking;

mod recovery;

mod registration;

pub mod reports;

mod resumption;

use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::depth_scale::scale_depths;
use crate::mapper::keyframes::store::{KeyframeStore, ROTATE_EVERY};
use crate::mapper::keyframes::tracker_views::views_of;
use crate::mapper::last_good::LastGood;
use crate::mapper::metric_scale::MetricScale;
use crate::mapper::metric_scale_params::ScaleParams;
use crate::mapper::pages::Paging;
use crate::mapper::params::{MapperParams, PoseEmbedding, PoseOptimization};
use crate::mapper::parts::Parts;
use crate::mapper::splats::store::SplatSet;
use crate::mapper::submaps::pose_anchor::ANCHOR_EVERY;
use crate::mapper::submaps::registry::Submaps;
use crate::mapper::train::schedule::End;
use crate::mapper::train::start_points::StartPoints;
use crate::mapper::train::trainer::Trainer;
use crate::track::landmarks::KeyframeView;
use splat_engine::error::EngineError;
use splat_engine::settings::{FirstEmbedding, PoseMode};
use splat_engine::traits::Engine;
use splat_geometry::answer::{GeometryBatch, PoseStd, View};
use splat_types::correction::{MapCorrection, Reason};
use splat_types::frame::Batch;
use splat_types::map_frame::MapFrame;
use splat_types::pages::PageStore;
use splat_types::snapshot::Scale;
use splat_types::sparse_point::SparsePoint;

/// Keyframes without a pose that are kept in case the model places them later.
pub const MAX_WAITING: usize = 200;
/// Steps between removals of transparent splats.
const PRUNE_EVERY: u64 = 400;
/// Steps between looks at the depth of one view, while more views are to come: they wait for nothing that takes long.
const SCALE_ONE_EVERY: u64 = 3;

/// Is given the map and the ids of keyframes that are new in it.
pub type OnPoses<'a> = dyn FnMut(&mut Mapper, &[u32]) -> Result<(), EngineError> + 'a;

/// All splats and poses, and the engine that improves them. Many methods: it is the one face of the map, and each
/// of its users needs a few.
pub struct Mapper {
    params: MapperParams,
    seed: u64,
    engine: Box<dyn Engine>,
    paging: Paging,
    keyframes: KeyframeStore,
    submaps: Submaps,
    splats: SplatSet,
    trainer: Trainer,
    scale: MetricScale,
    /// Of the scene, with `train.start: points`.
    start_points: StartPoints,
    /// `None` before anything was read.
    last_good: Option<Arc<LastGood>>,
    /// Saved with the map.
    map_frame: Option<MapFrame>,
}

impl std::fmt::Debug for Mapper {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (n_keyframes, n_splats) = (self.n_keyframes(), self.n_splats());
        write!(f, "Mapper({n_keyframes} keyframes, {n_splats} splats)")
    }
}

impl Mapper {
    pub fn new(params: MapperParams, seed: u64, scale: Scale, engine: Box<dyn Engine>) -> Self {
        Self {
            params,
            seed,
            engine,
            paging: Paging::default(),
            keyframes: KeyframeStore::default(),
            submaps: Submaps::default(),
            splats: SplatSet::default(),
            trainer: Trainer::new(seed),
            scale: MetricScale::new(scale),
            start_points: StartPoints::default(),
            last_good: None,
            map_frame: None,
        }
    }

    /// From now on looks for metres by these parameters, unless the geometry has them.
    #[must_use]
    pub fn measuring_scale(mut self, params: &ScaleParams) -> Self {
        self.scale.look_for(params);
        self
    }

    /// Where the robot's map frame lies; it is saved with the map.
    pub fn set_map_frame(&mut self, frame: MapFrame) {
        self.map_frame = Some(frame);
    }

    pub fn map_frame(&self) -> Option<MapFrame> {
        self.map_frame
    }

    /// `has`: depth and poses come in one scale, view by view, so that no view's depth is fitted to the map. A young map is the worse rule: live it has put depth
    /// of stereo up to 16 % off.
    #[must_use]
    pub fn with_depth_of_poses(mut self, has: bool) -> Self {
        self.scale.set_one_for_all_views(has);
        self
    }

    /// With `train.start: points`, these become the first splats, as keyframes come that have them in view. They lie in the frame
    /// and unit of the geometry's poses.
    #[must_use]
    pub fn starting_from(mut self, points: Vec<SparsePoint>) -> Self {
        self.start_points = StartPoints::new(points);
        self
    }

    /// Where splats and images go that memory has no room for; without a store they are lost.
    #[must_use]
    pub fn paging_to(mut self, pages: Box<dyn PageStore>) -> Self {
        self.paging = Paging::to(pages);
        self
    }

    /// Adds what the model says of a batch; `progress` is the share of the input that has come, where known.
    /// Returns the ids of the keyframes that are in the map since. After a fault, and `recover`, it must be added again.
    pub fn add(
        &mut self,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
        progress: Option<f64>,
    ) -> Result<Vec<u32>, EngineError> {
        self.add_with(batch, geometry, progress, &mut |_, _| Ok(()))
    }

    /// [`add`](Self::add), which hands out the same ids, and the map, as soon as all poses are in it: splats take longer.
    pub fn add_with(
        &mut self,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
        progress: Option<f64>,
        on_poses: &mut OnPoses<'_>,
    ) -> Result<Vec<u32>, EngineError> {
        if let Some(batch) = batch {
            let given_up = self.keyframes.remember(&batch.keyframes, MAX_WAITING);
            self.submaps.forget(&given_up);
        }
        self.splats.set_progress(progress);
        if let Some(unit) = geometry.metric {
            self.scale.set_unit(unit);
            self.submaps.anchor().keep_scale();
        }
        self.find_prior(batch, geometry)?;
        self.hold_anchor()?;
        let (keyframes, engine) = (&mut self.keyframes, &mut *self.engine);
        let update = self.submaps.apply_updates(geometry, keyframes, engine)?;
        if update.has_moved {
            self.trainer.reset_convergence();
        }
        if let Some(parked) = update.unparked {
            self.unpark(parked)?;
        }
        let joined = self.register(update.joined, PoseStd::default(), &geometry.observations)?;
        self.seed(&joined, &geometry.observations)?;
        let (parts, trainer) = self.split();
        trainer.record_matches(&parts, geometry);
        let mut own = self.submaps.sort(&geometry.views, &self.keyframes);
        own.extend(if self.submaps.prior().is_some() {
            self.register_resumed()?
        } else {
            self.follow_newest()?
        });
        let own = self.register(own, geometry.pose_error, &geometry.observations)?;
        on_poses(self, &own.fresh)?;
        self.seed(&own, &geometry.observations)?;
        self.settle_in()?;
        Ok(own.fresh)
    }

    /// After keyframes came or moved.
    fn settle_in(&mut self) -> Result<(), EngineError> {
        self.enforce_budget(0)?;
        self.share_budget();
        self.keyframes.subsample_old_depth(&mut *self.engine)?;
        let (mut parts, trainer) = self.split();
        trainer.measure_scene(&mut parts)?;
        trainer.match_views(&mut parts)?;
        self.set_anchor()?;
        self.splats.note_peaks(&*self.engine);
        self.keep_good()
    }

    /// One optimiser update per step, with seeding and removal at their intervals. Returns the steps made, which
    /// are fewer only when there is nothing to train on.
    pub fn step(&mut self, n: u64, end: End) -> Result<u64, EngineError> {
        if end.is_near() {
            self.splats.set_progress(None);
        }
        if self.submaps.waits_for_registration() {
            return Ok(0);
        }
        for done in 0..n {
            let (mut parts, trainer) = self.split();
            let Some(settings) = trainer.step(&mut parts, end)? else {
                return Ok(done);
            };
            let n_steps = trainer.n_steps();
            let train = &parts.params.train;
            let may_change = !matches!(end, End::Nears(share) if share > train.refine_until);
            let reseeds = train.reseed_every > 0 && n_steps.is_multiple_of(train.reseed_every);
            if may_change && reseeds {
                trainer.seed_again(&mut parts, end)?;
            }
            trainer.record_loss_at_interval(parts.engine)?;
            if may_change && n_steps.is_multiple_of(PRUNE_EVERY) {
                parts.splats.prune(parts.params, parts.engine)?;
            }
            let mcmc = &parts.params.mcmc;
            let may_move = may_change && mcmc.enabled && n_steps >= mcmc.start;
            if may_move && n_steps.is_multiple_of(mcmc.every) {
                trainer.relocate(&mut parts)?;
            }
            if may_change {
                trainer.densify_if_due(&mut parts)?;
            }
            self.report_renumbered();
            if n_steps.is_multiple_of(ROTATE_EVERY) {
                self.share_budget();
                self.rotate()?;
                self.splats.note_peaks(&*self.engine);
            }
            if n_steps.is_multiple_of(ANCHOR_EVERY) && settings.pose != PoseMode::Held {
                self.hold_anchor()?;
            }
            let looks = if end.is_near() {
                (ANCHOR_EVERY, usize::MAX)
            } else {
                (SCALE_ONE_EVERY, 1)
            };
            if n_steps.is_multiple_of(looks.0) && !self.scale.is_one_for_all_views() {
                scale_depths(looks.1, &mut self.keyframes, &mut *self.engine)?;
            }
        }
        Ok(n)
    }

    /// (id, is held out) of every keyframe in the map that has an image, and nothing on disk of what it shows.
    pub fn keyframe_ids(&self) -> Vec<(u32, bool)> {
        self.keyframes
            .registered()
            .iter()
            .filter(|(_, p)| (p.home.is_here || p.home.copy.is_some()) && !p.home.rests)
            .map(|(id, registered)| (*id, registered.is_held_out))
            .collect()
    }

    pub fn n_keyframes(&self) -> usize {
        self.keyframes.registered().len()
    }

    pub fn has_keyframe(&self, keyframe_id: u32) -> bool {
        self.keyframes.registered().contains_key(&keyframe_id)
    }

    pub fn n_splats(&self) -> usize {
        self.engine.len()
    }

    pub fn n_steps(&self) -> u64 {
        self.trainer.n_steps()
    }

    pub fn peak_gpu_bytes(&self) -> u64 {
        self.engine.memory().peak_gpu_bytes
    }

    pub fn adapter(&self) -> String {
        self.engine.adapter()
    }

    /// The correction since this was last called.
    pub fn take_correction(&mut self) -> Option<MapCorrection> {
        self.submaps.take_correction()
    }

    /// All keyframes as they stand at this moment, in order of id.
    pub fn keyframe_views(&mut self) -> Result<Vec<KeyframeView>, EngineError> {
        let cameras = Cameras::read(&mut *self.engine)?;
        Ok(views_of(&self.keyframes, &cameras))
    }

    /// What operations on splats need, and who performs them.
    fn split(&mut self) -> (Parts<'_>, &mut Trainer) {
        let parts = Parts {
            params: &self.params,
            engine: &mut *self.engine,
            keyframes: &mut self.keyframes,
            splats: &mut self.splats,
        };
        (parts, &mut self.trainer)
    }

    /// Looks for keyframes of this run in the saved map.
    fn find_prior(
        &mut self,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
    ) -> Result<(), EngineError> {
        let mut parts = Parts {
            params: &self.params,
            engine: &mut *self.engine,
            keyframes: &mut self.keyframes,
            splats: &mut self.splats,
        };
        match self.submaps.prior_mut() {
            Some(prior) => prior.look_for(&mut parts, batch, geometry),
            None => Ok(()),
        }
    }

    /// This run's views, once its geometry has got its place in the saved map.
    fn register_resumed(&mut self) -> Result<Vec<View>, EngineError> {
        let prior = self.submaps.prior_mut();
        let Some((submap, world_from_submap)) = prior.and_then(|prior| prior.align()) else {
            return Ok(Vec::new());
        };
        let map_poses = self.engine.poses()?;
        let keyframes = &mut self.keyframes;
        let views = self
            .submaps
            .take_frame(submap, &world_from_submap, keyframes, &map_poses);
        self.scale.take_over(1.0 / world_from_submap.scale);
        Ok(views)
    }

    fn hold_anchor(&mut self) -> Result<(), EngineError> {
        let anchor = self.submaps.anchor();
        anchor.hold(&self.keyframes, &mut *self.engine)
    }

    fn set_anchor(&mut self) -> Result<(), EngineError> {
        let has_network = self.params.train.pose_opt == PoseOptimization::Network;
        let embedding = match self.params.train.pose_embedding {
            PoseEmbedding::Order => FirstEmbedding::Order,
            PoseEmbedding::Zero => FirstEmbedding::Zero,
        };
        let seed = has_network.then_some((self.seed, embedding));
        let anchor = self.submaps.anchor();
        anchor.set(seed, &self.keyframes, &mut *self.engine)
    }

    fn choose_trainable(&mut self) -> Result<(), EngineError> {
        let (keyframes, engine) = (&mut self.keyframes, &mut *self.engine);
        self.splats.mark_paged_out(keyframes, engine)?;
        self.trainer.set_trainable(self.keyframes.trainable());
        Ok(())
    }

    /// Keeps as many keyframes in memory as there may be, less room for those that come.
    fn enforce_budget(&mut self, n_coming: usize) -> Result<(), EngineError> {
        let n_own = self.keyframes.n_resident() + n_coming;
        let most = self.keyframes.max_resident(&self.params);
        let n_lost = self.submaps.parked_mut().page_out(
            most.saturating_sub(n_own),
            &mut *self.engine,
            &mut self.paging,
            self.scale.params(),
        )?;
        self.keyframes.note_lost(n_lost);
        let has_left = self.keyframes.enforce_budget(
            n_coming,
            &self.params,
            &mut *self.engine,
            &mut self.paging,
            self.scale.params(),
        )?;
        if has_left {
            self.choose_trainable()?;
        }
        Ok(())
    }

    fn rotate(&mut self) -> Result<(), EngineError> {
        let may_have_left = self.keyframes.rotate(
            &self.params,
            &mut *self.engine,
            &mut self.paging,
            self.scale.params(),
            self.trainer.rng(),
        )?;
        if may_have_left {
            self.choose_trainable()?;
        }
        Ok(())
    }

    /// The image of a keyframe comes into memory for a moment: another makes room for it. Whoever asks sends it away again.
    fn with_resident(&mut self, id: u32) -> Result<bool, EngineError> {
        let registered = self.keyframes.registered().get(&id);
        if registered.is_some_and(|p| !p.home.is_here && p.home.copy.is_some()) {
            self.enforce_budget(1)?;
        }
        self.keyframes.page_in(id, &mut *self.engine)
    }

    fn page_out(&mut self, id: u32) -> Result<(), EngineError> {
        let (paging, metres) = (&mut self.paging, self.scale.params());
        self.keyframes
            .page_out(id, &mut *self.engine, paging, metres)
    }

    /// Brings back what is near, and makes room for that and for `n_wanted` more splats, as far as there is anything far.
    fn balance(&mut self, n_wanted: usize) -> Result<(), EngineError> {
        let (params, engine) = (&self.params, &mut *self.engine);
        let plan = self
            .splats
            .plan(n_wanted, params, &self.keyframes, engine)?;
        let Some(plan) = plan else {
            return Ok(());
        };
        if plan.n_over > 0 {
            self.evict_far((plan.n_over, plan.beyond), &plan.away)?;
        }
        let (keyframes, engine) = (&self.keyframes, &mut *self.engine);
        if self.splats.restore_near(&plan, keyframes, engine)? {
            self.choose_trainable()?;
            self.splats.note_peaks(&*self.engine);
        }
        Ok(())
    }

    fn evict_far(
        &mut self,
        most: (usize, f64),
        away: &std::collections::BTreeMap<u32, f64>,
    ) -> Result<(), EngineError> {
        let (keyframes, engine) = (&self.keyframes, &mut *self.engine);
        let paging = &mut self.paging;
        let splats = &mut self.splats;
        if splats.evict_far(most, away, keyframes, engine, paging)? {
            self.choose_trainable()?;
        }
        Ok(())
    }

    fn report_renumbered(&mut self) {
        if self.splats.take_renumbered() {
            let correction = MapCorrection::identity(Reason::Renumbered);
            self.submaps.start_epoch(correction);
        }
    }
}
