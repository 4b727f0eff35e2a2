//! Geometry -> the map, its steps and its snapshots: a struct with push-like methods that knows no threads.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::node::autosave::Autosave;
use crate::node::backpressure::Backpressure;
use crate::node::grid_thread::GridInput;
use crate::node::job::{Activity, KeyframeLatency, Progress};
use crate::node::milestones::Milestones;
use crate::node::publish_threads::Outgoing;
use crate::node::recovery::Recovery;
use crate::node::refinement::RefinementWorker;
use crate::node::requests::RequestHandler;
use crate::node::stop::ShutdownTimeout;
use crate::node::track_thread::KeyframeUpdate;
use crate::params::params::Params;
use splat_engine::error::EngineError;
use splat_geometry::answer::GeometryBatch;
use splat_io::queue::Sender;
use splat_ros::odometry::FrameCells;
use splat_ros::output::Output;
use splat_ros::reports::Reports;
use splat_ros::status::MapStatus;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::mapper::params::MapperParams;
use splat_slam::mapper::train::schedule::{self, End};
use splat_slam::track::landmarks::KeyframeView;
use splat_types::frame::Batch;
use splat_types::load_shed::LoadShed;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;

/// Steps between looks at the clock, the queue and the stop.
const STEPS_AT_ONCE: u64 = 10;
/// The same live, where a keyframe waits for them.
const LIVE_STEPS_AT_ONCE: u64 = 1;
/// The same after the last frame, between looks at whether they are to end.
const FINISHING_STEPS_AT_ONCE: u64 = 2;
/// Live: a step is made after so many seconds, even where poses have all processors busy: what is seen is to be shown.
const MAX_SECS_WITHOUT_STEP: f64 = 0.2;
/// Seconds that geometry gets to end after a stop.
const SECS_AFTER_STOP: f64 = 0.7;
/// Live: most steps that a keyframe is worth; the optimiser rests when the loss falls no more or all are spent.
const LIVE_STEPS_PER_KEYFRAME: u64 = 600;

/// Takes a snapshot for everybody, or only word of how far the run is.
pub(crate) type Publish<'a> = dyn FnMut(Option<Outgoing>, Progress) + 'a;

/// Geometry -> the map, its steps and its snapshots.
pub(crate) struct MapStage {
    pub(crate) map: Mapper,
    params: MapperParams,
    /// `None` in a replay.
    pub(crate) live: Option<LiveSteps>,
    n_frames: Option<u64>,
    pub(crate) request_handler: RequestHandler,
    /// Live: frames of the tracker to look at while there is nothing else to do.
    pub(crate) fitter: Option<RefinementWorker>,
    reports: Option<Arc<Reports>>,
    pub(crate) autosave: Option<Autosave>,
    pub(crate) recovery: Recovery,
    snapshots: Snapshots,
    grace: ShutdownTimeout,
    pub(crate) figures: MapFigures,
}

/// When one goes out, and with what.
#[derive(Debug)]
struct Snapshots {
    since_last: Stopwatch,
    /// Keyframes go along with their depth.
    has_grid: bool,
    /// `None`: nothing goes out.
    frames: Option<Arc<FrameCells>>,
}

/// Live: when steps are made, and by which threads.
#[derive(Debug)]
pub(crate) struct LiveSteps {
    /// `None`: the threads that all share.
    pub(crate) pool: Option<rayon::ThreadPool>,
    since_last: Stopwatch,
}

/// What became of the keyframes that came, and how long it took.
#[derive(Debug, Default)]
pub(crate) struct MapFigures {
    n_keyframes: usize,
    /// Age of keyframes that no snapshot has shown.
    unpublished: BTreeMap<u32, Stopwatch>,
    pub(crate) latency: KeyframeLatency,
    pub(crate) optimise_secs: f64,
    /// Quality on the way.
    pub(crate) milestones: Milestones,
}

impl MapFigures {
    /// Depth and places that were known when the last one came stay: the answer at the end counts nothing.
    fn note_load_shed(&mut self, geometry: &LoadShed) {
        let known = &mut self.latency.load_shed;
        known.hurried_keyframes = known.hurried_keyframes.max(geometry.hurried_keyframes);
        known.unsought_keyframes = known.unsought_keyframes.max(geometry.unsought_keyframes);
        known.depth_secs = known.depth_secs.max(geometry.depth_secs);
    }

    /// A snapshot shows its keyframes from now on.
    fn shown(&mut self, snapshot: &Snapshot) {
        for pose in &snapshot.poses {
            if let Some(age) = self.unpublished.remove(&pose.keyframe_id) {
                self.latency.to_snapshot_secs.push(age.secs());
            }
        }
        // Keyframes that never get a pose must not pile up.
        while self.unpublished.len() > splat_slam::mapper::mapper::MAX_WAITING {
            self.unpublished.pop_first();
        }
    }
}

impl MapStage {
    pub(crate) fn new(
        map: Mapper,
        params: &Params,
        (is_live, n_frames): (bool, Option<u64>),
        recovery: Recovery,
        output: Option<&mut Output>,
    ) -> Self {
        let frames = output.as_ref().map(|o| Arc::clone(&o.handles.frames));
        let (reports, calls) = output
            .map(|output| (Arc::clone(&output.handles.reports), output.calls.take()))
            .unzip();
        let stop = recovery.stop.clone();
        Self {
            map,
            params: params.mapper(),
            live: is_live.then(|| LiveSteps {
                pool: None,
                since_last: Stopwatch::start(),
            }),
            request_handler: RequestHandler::new(calls.flatten(), &params.track, stop.clone()),
            grace: ShutdownTimeout::new(stop),
            n_frames,
            fitter: None,
            snapshots: Snapshots {
                since_last: Stopwatch::start(),
                has_grid: params.grid.enabled && reports.is_some(),
                frames,
            },
            reports,
            autosave: None,
            recovery,
            figures: MapFigures::default(),
        }
    }

    /// Adds a batch; in a replay makes the steps that are due by then. `None`: what the model said at its end. `updates` get all
    /// keyframes as soon as poses are in the map: splats take longer.
    pub(crate) fn add(
        &mut self,
        batch: Option<&Batch>,
        geometry: &GeometryBatch,
        updates: Option<&Sender<KeyframeUpdate>>,
        publish: &mut Publish<'_>,
    ) {
        let newest = batch
            .and_then(|b| b.keyframes.last())
            .map(|k| k.frame.seq + 1);
        let progress = self
            .n_frames
            .zip(newest)
            .map(|(all, seen)| (seen as f64 / all.max(1) as f64).min(1.0));
        let figures = &mut self.figures;
        figures.note_load_shed(&geometry.load_shed);
        for keyframe in batch.iter().flat_map(|b| &b.keyframes) {
            figures.n_keyframes = figures.n_keyframes.max(keyframe.id as usize + 1);
            if !self.map.has_keyframe(keyframe.id) {
                figures.unpublished.insert(keyframe.id, keyframe.age);
            }
        }
        let watch = Stopwatch::start();
        let ages = self.figures.unpublished.clone();
        // Of the last attempt, where a device is lost.
        let mut to_pose_secs = Vec::new();
        let mut on_poses = |map: &mut Mapper, fresh: &[u32]| {
            let ages = fresh
                .iter()
                .filter_map(|id| Some((*id, ages.get(id)?.secs())));
            to_pose_secs = ages.collect();
            if let Some(updates) = updates {
                // A tracker that is gone is no reason to stop mapping.
                drop(updates.send(map.keyframe_views()?));
            }
            Ok(())
        };
        self.on_map(|map| map.add_with(batch, geometry, progress, &mut on_poses));
        for (id, secs) in &to_pose_secs {
            tracing::debug!("keyframe {id} has its pose after {secs:.2} s");
            self.report(|status| status.keyframe_to_pose.note(*secs));
        }
        let to_pose_secs = to_pose_secs.into_iter().map(|(_, secs)| secs);
        self.figures.latency.to_pose_secs.extend(to_pose_secs);
        self.figures.optimise_secs += watch.secs();
        self.report_counts();
        publish(None, self.progress());
        if self.live.is_none() {
            let due = schedule::due(&self.params, progress.unwrap_or(0.0));
            self.step_until(due, publish);
        }
    }

    /// Live: steps have waited for poses.
    pub(crate) fn note_waited(&mut self, secs: f64) {
        self.figures.latency.load_shed.steps_secs += secs;
    }

    /// Live: whether splats wait, since poses of keyframes are at work; now and then a step is made all the same.
    pub(crate) fn gives_way(&mut self, poses: &Backpressure) -> bool {
        let live = self.live.as_ref();
        poses.is_at_work()
            && live.is_some_and(|live| live.since_last.secs() < MAX_SECS_WITHOUT_STEP)
    }

    /// Live: a few steps, if any are left to make. Returns whether some were made.
    pub(crate) fn step_while_waiting(&mut self, publish: &mut Publish<'_>) -> bool {
        if self.map.is_settled() || self.map.n_splats() == 0 {
            return false;
        }
        if let Some(live) = &mut self.live {
            live.since_last = Stopwatch::start();
        }
        let cap = LIVE_STEPS_PER_KEYFRAME * self.map.n_mapped_keyframes() as u64;
        let target = (self.map.n_steps() + LIVE_STEPS_AT_ONCE).min(cap);
        let before = self.map.n_steps();
        self.step_until(target, publish);
        self.map.n_steps() > before
    }

    /// The steps after the last keyframe, the poses of held-out views, and the last snapshot. Live there are as many steps as
    /// `map.finish_secs` has room for.
    pub(crate) fn finish(&mut self, publish: &mut Publish<'_>) -> Arc<Snapshot> {
        let watch = Stopwatch::start();
        self.on_map(Mapper::settle_on_largest);
        if self.live.is_some() {
            self.finish_live(publish);
        } else {
            let (first, last) = (self.map.n_steps(), self.params.train.steps);
            let end = |n_steps| End::Nears((n_steps - first) as f32 / (last - first) as f32);
            self.make_steps(last, &end, publish);
        }
        // Splats as they were seeded say less of a pose than the geometry that seeded them.
        if self.map.n_steps() > 0 && !self.recovery.stop.is_asked() {
            self.refine_held_out(publish);
        }
        self.figures.optimise_secs += watch.secs();
        // The last map file must not be overtaken by an older one.
        self.autosave = None;
        // After a fault that ends mapping: the last that was read before it.
        let snapshot = self.snapshot();
        let snapshot = snapshot.unwrap_or_else(|| self.map.last_snapshot());
        self.report_counts();
        let last = Progress {
            activity: Activity::Saving,
            has_ended: true,
            ..self.progress()
        };
        self.hand_over(Arc::clone(&snapshot), last, publish);
        snapshot
    }

    /// Steps for `map.finish_secs`, also after a stop; another one cuts them short.
    fn finish_live(&mut self, publish: &mut Publish<'_>) {
        let (watch, of_secs) = (Stopwatch::start(), self.params.map.finish_secs);
        let stop = self.recovery.stop.clone();
        stop.set_finishing(of_secs > 0.0);
        while watch.secs() < of_secs && !stop.is_cut_short() {
            // The end is known at last, so that rates can fall towards it.
            let end = End::Nears((watch.secs() / of_secs) as f32);
            if !self.make_steps_at_once(FINISHING_STEPS_AT_ONCE, end) {
                break;
            }
            let activity = Activity::Finishing {
                secs: watch.secs(),
                of_secs,
            };
            publish(
                None,
                Progress {
                    activity,
                    ..self.progress()
                },
            );
            self.snapshot_if_due(publish);
        }
        stop.set_finishing(false);
    }

    /// As long as nobody asks to stop.
    fn refine_held_out(&mut self, publish: &mut Publish<'_>) {
        let (stop, progress) = (self.recovery.stop.clone(), self.progress());
        self.on_map(|map| {
            map.refine_held_out(&mut |done, of| {
                let activity = Activity::HeldOutPoses { done, of };
                publish(
                    None,
                    Progress {
                        activity,
                        ..progress
                    },
                );
                !stop.is_asked()
            })
        });
    }

    /// Calls from outside and frames of the tracker, while nothing else is to be done.
    pub(crate) fn serve(&mut self) {
        let served = self.request_handler.serve(&mut self.map);
        self.react(served);
        if let Some(fitter) = &self.fitter {
            let fitted = fitter.fit_one(&mut self.map);
            self.react(fitted);
        }
    }

    /// All keyframes as they stand; after a fault that ends mapping, as they last stood.
    pub(crate) fn keyframe_views(&mut self) -> Vec<KeyframeView> {
        let views = self.on_map(Mapper::keyframe_views);
        views.unwrap_or_else(|| self.map.last_keyframe_views())
    }

    /// Works on the map; where the device is lost, again from the last good state. `None` once mapping has ended.
    fn on_map<T>(
        &mut self,
        mut work: impl FnMut(&mut Mapper) -> Result<T, EngineError>,
    ) -> Option<T> {
        while self.recovery.error.is_none() {
            let done = work(&mut self.map);
            if let Some(done) = self.react(done) {
                return Some(done);
            }
        }
        None
    }

    /// A fault is an event: the map goes on with another engine, or mapping ends.
    fn react<T>(&mut self, done: Result<T, EngineError>) -> Option<T> {
        let error = match done {
            Ok(done) => return Some(done),
            Err(error) => error,
        };
        if self.recovery.error.is_none() {
            self.report(|status| status.recovering = Some(error.to_string()));
            self.recovery.recover(&mut self.map, &error);
            self.report(|status| status.recovering = None);
        }
        None
    }

    /// After a stop, geometry gets a moment for the batch that it is at, and no more: a network can take minutes.
    pub(crate) fn timed_out(&mut self) -> bool {
        self.grace.is_over(SECS_AFTER_STOP)
    }

    /// Changes the map's part of the status; nothing where no status goes out.
    fn report(&self, change: impl FnOnce(&mut MapStatus)) {
        if let Some(reports) = &self.reports {
            reports.map.update(change);
        }
    }

    fn report_counts(&self) {
        let (map, optimise_secs) = (&self.map, self.figures.optimise_secs);
        let load_shed = self.figures.latency.load_shed;
        self.report(|status| {
            status.load_shed = load_shed;
            status.n_registered = map.n_keyframes() as u64;
            status.n_submaps = map.submaps().len() as u64;
            status.n_splats = map.n_splats() as u64;
            status.n_steps = map.n_steps();
            status.gpu_bytes = map.peak_gpu_bytes();
            if optimise_secs > 0.0 {
                status.steps_per_s = map.n_steps() as f64 / optimise_secs;
            }
        });
    }

    fn step_until(&mut self, target: u64, publish: &mut Publish<'_>) {
        let watch = Stopwatch::start();
        let end = schedule::end_of_run(&self.params, self.live.is_none());
        self.make_steps(target, &|_| end, publish);
        self.figures.optimise_secs += watch.secs();
        self.snapshot_if_due(publish);
    }

    /// Steps up to `target`, as long as nobody asks to stop; `end` of the steps made so far.
    fn make_steps(&mut self, target: u64, end: &dyn Fn(u64) -> End, publish: &mut Publish<'_>) {
        while self.map.n_steps() < target && !self.recovery.stop.is_asked() {
            let n_steps = self.map.n_steps();
            let n = STEPS_AT_ONCE.min(self.figures.milestones.next(target) - n_steps);
            if !self.make_steps_at_once(n, end(n_steps)) {
                break;
            }
            self.snapshot_if_due(publish);
            if self.figures.milestones.is_due(self.map.n_steps()) {
                self.measure_milestone(publish);
            }
        }
    }

    /// Quality as it is after these steps; no time of optimisation.
    fn measure_milestone(&mut self, publish: &mut Publish<'_>) {
        let since = Stopwatch::start();
        self.refine_held_out(publish);
        let measured = self.figures.milestones.measure(&mut self.map, &since);
        self.react(measured);
        self.figures.optimise_secs -= since.secs();
    }

    /// Also serves calls from outside. `false`: there is nothing to train on, or mapping has ended.
    fn make_steps_at_once(&mut self, n: u64, end: End) -> bool {
        let map = &mut self.map;
        let made = match self.live.as_ref().and_then(|live| live.pool.as_ref()) {
            Some(pool) => pool.install(|| map.step(n, end)),
            None => map.step(n, end),
        };
        // After a fault the count of steps says how many are left.
        if self.react(made) == Some(0) || self.recovery.error.is_some() {
            return false;
        }
        let served = self.request_handler.serve(&mut self.map);
        self.react(served);
        true
    }

    pub(crate) fn snapshot_if_due(&mut self, publish: &mut Publish<'_>) {
        let is_due = self.snapshots.since_last.secs() >= self.params.map.snapshot_secs;
        if is_due
            && self.map.n_splats() > 0
            && let Some(snapshot) = self.snapshot()
        {
            self.hand_over(snapshot, self.progress(), publish);
        }
        if self.recovery.error.is_none() {
            let autosave = self.autosave.as_mut();
            let saved = Autosave::save_if_due(autosave, &mut self.map, &mut self.request_handler);
            self.react(saved);
        }
    }

    /// The status counts the splats of what goes out: fewer than the engine's where some are not finite.
    fn hand_over(
        &mut self,
        snapshot: Arc<Snapshot>,
        progress: Progress,
        publish: &mut Publish<'_>,
    ) {
        self.report(|status| status.n_splats = snapshot.splats.len() as u64);
        let grid = self.snapshots.has_grid.then(|| GridInput {
            keyframes: self.keyframe_views(),
            snapshot: Arc::clone(&snapshot),
            is_last: progress.has_ended,
        });
        let submaps = self.map.submap_reports().into_iter();
        let submaps = submaps.filter_map(|submap| submap.parked);
        let outgoing = Outgoing {
            snapshot,
            submaps: submaps.filter(|parked| !parked.splats.is_empty()).collect(),
            grid,
        };
        publish(Some(outgoing), progress);
    }

    /// `None` once mapping has ended.
    fn snapshot(&mut self) -> Option<Arc<Snapshot>> {
        self.report_counts();
        if let Some(frame) = self.snapshots.frames.as_ref().and_then(|f| f.map_frame()) {
            self.map.set_map_frame(frame);
        }
        if let (Some(moved), Some(reports)) = (self.map.take_correction(), &self.reports) {
            reports.correction.add(moved);
        }
        let snapshot = self.on_map(Mapper::snapshot)?;
        self.snapshots.since_last = Stopwatch::start();
        self.figures.shown(&snapshot);
        Some(snapshot)
    }

    fn progress(&self) -> Progress {
        Progress {
            activity: Activity::Mapping,
            n_keyframes: self.figures.n_keyframes,
            n_registered: self.map.n_keyframes(),
            n_splats: self.map.n_splats(),
            n_steps: self.map.n_steps(),
            steps_planned: self.live.is_none().then_some(self.params.train.steps),
            has_ended: false,
        }
    }
}
