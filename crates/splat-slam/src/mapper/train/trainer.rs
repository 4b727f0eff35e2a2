//! What is trained on, in which order, and what the losses were.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::mapper::params::{SceneScale, SeedShape};
use crate::mapper::parts::Parts;
use crate::mapper::train::convergence::Convergence;
use crate::mapper::train::correspondences::KnownMatches;
use crate::mapper::train::densify;
use crate::mapper::train::grow_prune;
use crate::mapper::train::loss_curve::LossCurve;
use crate::mapper::train::photometric::{self, FrameFit};
use crate::mapper::train::scene_extent::scene_radius;
use crate::mapper::train::schedule::{self, End, Schedule};
use crate::mapper::train::seed_shape;
use splat_engine::error::EngineError;
use splat_engine::settings::StepSettings;
use splat_engine::traits::Engine;
use splat_geometry::answer::GeometryBatch;
use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;
use splat_types::image::RgbImage;
use splat_types::transform::Rigid;

/// Steps on a view, itself among them, from which on the map shows what stands still well enough to say what moved: a view is looked at
/// there, and whenever it has had twice as many.
const FIRST_MASK: u32 = 4;

/// The optimisation of the map.
#[derive(Debug)]
pub(crate) struct Trainer {
    seed: u64,
    schedule: Schedule,
    /// For views to seed from, seeds, and keyframes that take turns.
    rng: Pcg64Mcg,
    /// Views that are trained on, in order of arrival.
    trainable: Vec<usize>,
    n_steps: u64,
    curve: LossCurve,
    convergence: Convergence,
    /// Index of the engine's view that frames are compared in, once one was.
    scratch_view: Option<usize>,
    /// What rates of lengths are shares of, where that is the cameras' extent.
    camera_radius: Option<f32>,
    /// Kept only where the epipolar loss has a use for matches.
    matches: KnownMatches,
    warned_of_no_matches: bool,
}

impl Trainer {
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            seed,
            schedule: Schedule::new(seed),
            rng: Pcg64Mcg::seed_from_u64(seed ^ 0x5eed_0002),
            trainable: Vec::new(),
            n_steps: 0,
            curve: LossCurve::default(),
            convergence: Convergence::default(),
            scratch_view: None,
            camera_radius: None,
            matches: KnownMatches::default(),
            warned_of_no_matches: false,
        }
    }

    pub(crate) fn rng(&mut self) -> &mut Pcg64Mcg {
        &mut self.rng
    }

    pub(crate) fn n_steps(&self) -> u64 {
        self.n_steps
    }

    pub(crate) fn loss_curve(&self) -> &[(u64, f64)] {
        self.curve.points()
    }

    /// Views to train on from now on, in order of arrival.
    pub(crate) fn set_trainable(&mut self, views: Vec<usize>) {
        self.trainable = views;
        self.schedule.restart_round();
    }

    pub(crate) fn add_trainable(&mut self, view_ix: usize) {
        self.trainable.push(view_ix);
    }

    /// The engine's first `n_views` views have been trained on before: none of them is new.
    pub(crate) fn note_trained(&mut self, n_views: usize) {
        self.schedule.note_trained(n_views);
    }

    /// A view has depth that it had not: it is as good as new.
    pub(crate) fn renew(&mut self, view_ix: usize) {
        self.schedule.renew(view_ix);
    }

    pub(crate) fn has_converged(&self) -> bool {
        self.convergence.is_over()
    }

    /// There is something to learn.
    pub(crate) fn reset_convergence(&mut self) {
        self.convergence = Convergence::default();
    }

    /// The engine is another one.
    pub(crate) fn forget_scratch_view(&mut self) {
        self.scratch_view = None;
    }

    pub(crate) fn forget_matches(&mut self) {
        self.matches = KnownMatches::default();
    }

    pub(crate) fn record_matches(&mut self, map: &Parts<'_>, geometry: &GeometryBatch) {
        if map.params.train.epipolar_weight > 0.0 {
            self.matches.record(geometry);
        }
    }

    /// Gives every view its matches with all others, with what was seen since, while the epipolar loss has a use for them.
    pub(crate) fn match_views(&mut self, map: &mut Parts<'_>) -> Result<(), EngineError> {
        let train = &map.params.train;
        let weight = schedule::epipolar_weight(train, self.n_steps);
        if weight <= 0.0 {
            return Ok(());
        }
        let (keyframes, engine) = (&*map.keyframes, &mut *map.engine);
        let n = self
            .matches
            .match_views(keyframes, engine, train.epipolar_weighting)?;
        if n == 0 && self.trainable.len() > 1 && !self.warned_of_no_matches {
            self.warned_of_no_matches = true;
            tracing::warn!(
                "train.epipolar_weight is {weight}, but the geometry has no matches between the {} keyframes so far, so that the \
                 epipolar loss does nothing; a foundation model has some where align.method is not off and images overlap",
                self.trainable.len()
            );
        }
        Ok(())
    }

    /// One update of the optimiser; `None`: there is nothing to train on. Returns its settings.
    pub(crate) fn step(
        &mut self,
        map: &mut Parts<'_>,
        end: End,
    ) -> Result<Option<StepSettings>, EngineError> {
        let order = map.params.train.view_order;
        let Some(view_ix) = self.schedule.next_view(&self.trainable, order) else {
            return Ok(None);
        };
        let n_steps = self.schedule.steps_of(view_ix);
        if n_steps >= FIRST_MASK
            && n_steps.is_power_of_two()
            && let Some(id) = keyframe_of(map, view_ix)
        {
            grow_prune::mask_transients(map, id)?;
        }
        let scene_depth = map.keyframes.scene_depth();
        let scene_scale = self.camera_radius.unwrap_or(scene_depth);
        let pose_error = map.keyframes.pose_error();
        let n_steps = self.schedule.steps_of(view_ix);
        let mut settings = schedule::settings(map.params, scene_scale, pose_error, end, n_steps);
        schedule::admit_bands(&mut settings, map.params, self.n_steps);
        settings.epipolar_weight = schedule::epipolar_weight(&map.params.train, self.n_steps);
        settings.accumulate_screen_gradients =
            densify::accumulates(&map.params.densify, self.n_steps);
        map.engine.step(view_ix, &settings)?;
        self.n_steps += 1;
        Ok(Some(settings))
    }

    /// Notes the loss where it is due.
    pub(crate) fn record_loss_at_interval(
        &mut self,
        engine: &mut dyn Engine,
    ) -> Result<(), EngineError> {
        if self.curve.is_due(self.n_steps) {
            self.record_loss(engine)?;
        }
        Ok(())
    }

    pub(crate) fn record_loss(&mut self, engine: &mut dyn Engine) -> Result<(), EngineError> {
        let stats = engine.take_stats()?;
        if stats.n_steps > 0 {
            self.curve.push(self.n_steps, stats.loss);
            let n_views = self.trainable.len();
            self.convergence.note(stats.loss, stats.n_steps, n_views);
        }
        self.curve.bound();
        Ok(())
    }

    /// Looks at one training view: seeds where the map has a hole or is wrong.
    pub(crate) fn seed_again(&mut self, map: &mut Parts<'_>, end: End) -> Result<(), EngineError> {
        if self.trainable.is_empty() {
            return Ok(());
        }
        let view_ix = self.trainable[self.rng.random_range(0..self.trainable.len())];
        if let Some(id) = keyframe_of(map, view_ix) {
            let fills_gaps = self.schedule.may_fill(view_ix, end);
            grow_prune::seed_from(map, &mut self.rng, id, fills_gaps)?;
        }
        Ok(())
    }

    pub(crate) fn seed_each(
        &mut self,
        map: &mut Parts<'_>,
        ids: &[u32],
        fills_gaps: bool,
    ) -> Result<(), EngineError> {
        ids.iter().try_for_each(|id| {
            grow_prune::judge_guesses(map, *id)?;
            grow_prune::seed_from(map, &mut self.rng, *id, fills_gaps)
        })
    }

    /// Splats for a keyframe without depth, from where its landmarks are.
    pub(crate) fn seed_provisional(
        &mut self,
        map: &mut Parts<'_>,
        keyframe_id: u32,
        depth: &DepthMap,
    ) -> Result<(), EngineError> {
        grow_prune::seed_provisional(map, &mut self.rng, keyframe_id, depth)
    }

    pub(crate) fn relocate(&mut self, map: &mut Parts<'_>) -> Result<(), EngineError> {
        grow_prune::relocate(map, self.trainable.len(), self.seed ^ self.n_steps)
    }

    /// After keyframes came or moved: what the scene's scale and the near plane are.
    pub(crate) fn measure_scene(&mut self, map: &mut Parts<'_>) -> Result<(), EngineError> {
        let train = &map.params.train;
        let near = train.near;
        self.camera_radius = match train.scene_scale {
            SceneScale::MedianDepth => None,
            SceneScale::Cameras => Some(scene_radius(map)?),
        };
        let scene_scale = self.camera_radius.unwrap_or(map.keyframes.scene_depth());
        map.engine.set_near(near * scene_scale);
        Ok(())
    }

    /// Splats that no step has moved get the size, opacity and rotation that are asked for.
    pub(crate) fn reshape_fresh(&mut self, map: &mut Parts<'_>) -> Result<(), EngineError> {
        match map.params.train.seed_shape {
            SeedShape::Spacing => Ok(()),
            SeedShape::Neighbours => seed_shape::reshape_fresh(map, &mut self.rng),
        }
    }

    /// Clones, splits and removes splats, and resets opacities, where that is due.
    pub(crate) fn densify_if_due(&mut self, map: &mut Parts<'_>) -> Result<(), EngineError> {
        densify::densify_if_due(map, self.n_steps, self.seed)
    }

    /// The pose near `world_from_cam` at which the map looks most like `image`; `None` where no pose is clearly better.
    pub(crate) fn refine_frame(
        &mut self,
        map: &mut Parts<'_>,
        image: &RgbImage,
        intrinsics: &Intrinsics,
        world_from_cam: &Rigid,
    ) -> Result<Option<FrameFit>, EngineError> {
        self.record_loss(map.engine)?;
        let scratch_view = &mut self.scratch_view;
        photometric::refine_frame(map, scratch_view, image, intrinsics, world_from_cam)
    }
}

fn keyframe_of(map: &Parts<'_>, view_ix: usize) -> Option<u32> {
    let mut registered = map.keyframes.registered().iter();
    let found = registered.find(|(_, p)| p.view_ix == view_ix);
    found.map(|(id, _)| *id)
}
