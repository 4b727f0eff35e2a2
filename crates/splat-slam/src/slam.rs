//! The whole sequence on one thread: push frames, get events, keep the map.
//!
//! For tests, for programs that embed the mapper, and as the order of work that the threads of the node keep as well. It
//! knows no threads, no files and no clock: what it returns depends on the frames alone.

use crate::mapper::mapper::Mapper;
use crate::mapper::params::MapperParams;
use crate::mapper::train::schedule::{self, End};
use crate::select::params::SelectParams;
use crate::select::selector::{Batcher, Selector};
use crate::track::history::Tracks;
use crate::track::params::TrackParams;
use crate::track::tracker::Tracker;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_geometry::answer::GeometryBatch;
use splat_geometry::error::GeometryError;
use splat_geometry::model::GeometryModel;
use splat_types::correction::MapCorrection;
use splat_types::frame::{Batch, Frame};
use splat_types::snapshot::Scale;
use splat_types::tracking::TrackedFrame;

/// Steps between two looks at the phase of the final optimisation.
const STEPS_AT_ONCE: u64 = 10;

/// Why frames can no longer be mapped. The map of the time before stays readable.
#[derive(Debug, thiserror::Error)]
pub enum SlamError {
    /// The geometry model failed: its file, its runtime, or its answer.
    #[error("geometry: {0}")]
    Geometry(#[from] GeometryError),
    /// The engine failed: the device is lost, or memory is exhausted.
    #[error("engine: {0}")]
    Engine(#[from] EngineError),
}

/// Parameters of all parts.
#[derive(Debug, Clone, Default)]
pub struct SlamParams {
    /// Which frames become keyframes, and how keyframes are batched.
    pub select: SelectParams,
    /// How frames between keyframes get their poses; `enabled: false` leaves them without.
    pub track: TrackParams,
    /// The map and its optimisation.
    pub mapper: MapperParams,
    /// Of all random numbers.
    pub seed: u64,
    /// Frames that will come, where known: the optimiser steps of a recording are spread over them. Unknown, steps are
    /// made by `Slam::step` and by `Slam::finish` alone.
    pub n_frames: Option<u64>,
}

/// What a frame has caused.
#[derive(Debug, Clone)]
pub enum SlamEvent {
    /// The frame's own pose; `world_from_cam` is in the map's unit.
    Tracked(Box<TrackedFrame>),
    /// The frame is a keyframe and has this id. Its pose follows with the batch that it is in.
    Keyframe(u32),
    /// The map has changed.
    Map(MapEvent),
}

/// A change of the map.
#[derive(Debug, Clone)]
pub enum MapEvent {
    /// The keyframe of this id has a pose in the map.
    Registered(u32),
    /// All that was in the map has moved, or is another map: a loop closure, a merge of submaps, a restart.
    Moved(MapCorrection),
}

/// Frames in order of time -> events and a map.
pub struct Slam {
    params: SlamParams,
    selector: Selector,
    batcher: Batcher,
    model: Box<dyn GeometryModel>,
    mapper: Mapper,
    tracker: Option<Tracker>,
}

/// The map at its end, and where every frame was.
#[derive(Debug)]
pub struct Finished {
    /// Ask it for a snapshot, a checkpoint or a rendering.
    pub mapper: Mapper,
    /// Empty where tracking is off.
    pub tracks: Tracks,
    /// What came up since the last frame.
    pub events: Vec<SlamEvent>,
}

impl std::fmt::Debug for Slam {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Slam({:?})", self.mapper)
    }
}

impl Slam {
    /// `scale` is that of the model's answers: `Scale::UP_TO_SCALE` for images alone.
    pub fn new(
        params: SlamParams,
        model: Box<dyn GeometryModel>,
        engine: Box<dyn Engine>,
        scale: Scale,
    ) -> Self {
        let has_depth_of_poses = model.has_depth_of_poses();
        Self {
            selector: Selector::new(params.select.clone()),
            batcher: Batcher::new(&params.select),
            model,
            mapper: Mapper::new(params.mapper.clone(), params.seed, scale, engine)
                .with_depth_of_poses(has_depth_of_poses),
            tracker: params.track.enabled.then(|| Tracker::new(&params.track)),
            params,
        }
    }

    /// The map as it is, for snapshots and renderings.
    pub fn mapper(&mut self) -> &mut Mapper {
        &mut self.mapper
    }

    /// Takes the next frame: tracks it, and maps the batch that it completes.
    pub fn push(&mut self, frame: Frame) -> Result<Vec<SlamEvent>, SlamError> {
        let mut events = Vec::new();
        if let Some(tracker) = &mut self.tracker {
            events.push(SlamEvent::Tracked(Box::new(tracker.track(&frame))));
        }
        if let Some(keyframe) = self.selector.push(frame) {
            events.push(SlamEvent::Keyframe(keyframe.id));
            if let Some(batch) = self.batcher.push(keyframe) {
                self.map_batch(&batch, &mut events)?;
            }
        }
        Ok(events)
    }

    /// Makes up to `n` optimiser steps between frames. Returns how many were made: fewer only while there is nothing to
    /// train on.
    pub fn step(&mut self, n: u64) -> Result<u64, SlamError> {
        let end = self.end();
        Ok(self.mapper.step(n, end)?)
    }

    /// Maps what is left, makes the steps that are left, and lets the map go.
    pub fn finish(mut self) -> Result<Finished, SlamError> {
        let mut events = Vec::new();
        if let Some(batch) = self.batcher.finish() {
            self.map_batch(&batch, &mut events)?;
        }
        let rest = self.model.finish()?;
        self.integrate(None, &rest, &mut events)?;
        self.mapper.settle_on_largest()?;
        let (first, last) = (self.mapper.n_steps(), self.params.mapper.train.steps);
        while self.mapper.n_steps() < last {
            let n_steps = self.mapper.n_steps();
            let share = (n_steps - first) as f32 / (last - first) as f32;
            let n = STEPS_AT_ONCE.min(last - n_steps);
            if self.mapper.step(n, End::Nears(share))? == 0 {
                break;
            }
        }
        if self.mapper.n_steps() > 0 {
            self.mapper.refine_held_out(&mut |_, _| true)?;
        }
        self.update_tracker()?;
        self.take_correction(&mut events);
        let tracks = self.tracker.map(|tracker| tracker.finish(|| true));
        Ok(Finished {
            mapper: self.mapper,
            tracks: tracks.unwrap_or_default(),
            events,
        })
    }

    fn map_batch(&mut self, batch: &Batch, events: &mut Vec<SlamEvent>) -> Result<(), SlamError> {
        let geometry = self.model.infer(batch)?;
        self.integrate(Some(batch), &geometry, events)?;
        self.update_tracker()
    }

    /// Adds geometry to the map, then makes the steps that are due by the share of the recording that has come.
    fn integrate(
        &mut self,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
        events: &mut Vec<SlamEvent>,
    ) -> Result<(), SlamError> {
        let newest = batch.and_then(|batch| batch.keyframes.last());
        let progress = self
            .params
            .n_frames
            .zip(newest)
            .map(|(n, keyframe)| ((keyframe.frame.seq + 1) as f64 / n.max(1) as f64).min(1.0));
        let fresh = self.mapper.add(batch, geometry, progress)?;
        let registered = fresh.into_iter().map(MapEvent::Registered);
        events.extend(registered.map(SlamEvent::Map));
        self.take_correction(events);
        let due = schedule::due(&self.params.mapper, progress.unwrap_or(0.0));
        let n = due.saturating_sub(self.mapper.n_steps());
        let end = self.end();
        self.mapper.step(n, end)?;
        Ok(())
    }

    /// What is known of it while keyframes come.
    fn end(&self) -> End {
        schedule::end_of_run(&self.params.mapper, self.params.n_frames.is_some())
    }

    fn take_correction(&mut self, events: &mut Vec<SlamEvent>) {
        let moved = self.mapper.take_correction().map(MapEvent::Moved);
        events.extend(moved.map(SlamEvent::Map));
    }

    /// Frames that the map has reached get their second look at once.
    fn update_tracker(&mut self) -> Result<(), SlamError> {
        if let Some(tracker) = &mut self.tracker {
            tracker.update(&self.mapper.keyframe_views()?);
            tracker.retry(usize::MAX);
        }
        Ok(())
    }
}
