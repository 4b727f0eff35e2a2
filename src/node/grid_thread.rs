//! Keyframes with their depth -> grids for planners. Nobody waits for it: of snapshots that come too fast, the newest counts.

use std::sync::Arc;

use glam::DVec3;

use crate::node::rate_limited::RateLimitedLog;
use splat_io::queue::Receiver;
use splat_ros::grid_stream::{GridStream, LevelGrid};
use splat_ros::publisher::Publisher;
use splat_slam::track::landmarks::KeyframeView;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;
use splat_types::transform::Similarity;
use splat_volume::error::VolumeError;
use splat_volume::grid::grid;
use splat_volume::params::GridParams;
use splat_volume::volume::{KeyframeDepth, Volume};

/// Keyframes that are fused between looks at whether there are newer ones.
const KEYFRAMES_AT_ONCE: usize = 8;
/// Ellipsoids and voxels go out every so many seconds, and seldomer where they take more than this share of the time.
const OBSTACLES_SECS: f64 = 2.0;
const OBSTACLES_SHARE: f64 = 0.05;
/// They lie within so many times the range of depth of the newest keyframe.
const OBSTACLES_REACH: f64 = 2.0;

/// All keyframes as a snapshot has them.
#[derive(Debug, Clone)]
pub(crate) struct GridInput {
    pub(crate) snapshot: Arc<Snapshot>,
    pub(crate) keyframes: Vec<KeyframeView>,
    pub(crate) is_last: bool,
}

/// The volume and its way out.
pub(crate) struct GridStage {
    params: GridParams,
    volume: Volume,
    map_id: Option<[u8; 16]>,
    publisher: Arc<Publisher>,
    stream: GridStream,
    pool: Option<rayon::ThreadPool>,
    since_grid: Option<Stopwatch>,
    since_obstacles: Option<Stopwatch>,
    /// Least time between two messages of obstacles, seconds.
    obstacles_period: f64,
    rate_limited: RateLimitedLog,
}

impl GridStage {
    pub(crate) fn new(params: &GridParams, publisher: &Arc<Publisher>, stream: GridStream) -> Self {
        Self {
            params: params.clone(),
            volume: Volume::new(params),
            map_id: None,
            publisher: Arc::clone(publisher),
            stream,
            pool: None,
            since_grid: None,
            since_obstacles: None,
            obstacles_period: OBSTACLES_SECS,
            rate_limited: RateLimitedLog::default(),
        }
    }

    /// What goes on with the next map.
    pub(crate) fn into_stream(self) -> GridStream {
        self.stream
    }

    /// Fuses what is new or has moved, as long as nothing newer waits, and sends the grid.
    pub(crate) fn take(&mut self, input: &GridInput, has_newer: &dyn Fn() -> bool) {
        let metres = input.snapshot.scale.metres_per_unit;
        if metres.is_none() && !self.params.allow_unscaled {
            let reason = "the scale is unknown, so that heights and distances are; give a baseline, depth, odometry or \
                          scale.camera_height, or set grid.allow_unscaled";
            return self.stream.report(reason);
        }
        if self.map_id != Some(input.snapshot.map_id) {
            self.volume = Volume::new(&self.params);
            self.map_id = Some(input.snapshot.map_id);
        }
        let keyframes = keyframes_of(&input.keyframes, &self.stream.map_from_world(metres));
        let faults = self.volume.set_keyframes(&keyframes);
        self.warn_of(&faults);
        loop {
            let volume = &mut self.volume;
            let (n_left, faults) = match &self.pool {
                Some(pool) => pool.install(|| volume.fuse(KEYFRAMES_AT_ONCE)),
                None => volume.fuse(KEYFRAMES_AT_ONCE),
            };
            self.warn_of(&faults);
            if n_left == 0 || (has_newer() && !input.is_last) {
                break;
            }
        }
        let is_due = self
            .since_grid
            .is_none_or(|watch| watch.secs() >= self.params.period);
        if is_due || input.is_last {
            self.send(input, &keyframes);
        }
    }

    fn send(&mut self, input: &GridInput, keyframes: &[KeyframeDepth]) {
        let snapshot = &input.snapshot;
        self.stream
            .keep_volume(&self.publisher, &self.volume, snapshot);
        let newest = keyframes.last().map_or(DVec3::ZERO, |keyframe| {
            self.volume.level_from_map() * keyframe.map_from_camera.translation
        });
        self.send_obstacles(input, newest);
        let Some(ground) = self.volume.ground() else {
            let reason = "no ground was seen: a plane below the camera that leans by less than 25 degrees from level";
            return self.stream.report(reason);
        };
        self.since_grid = Some(Stopwatch::start());
        tracing::debug!(
            "grid: {} keyframes, {:.1} MiB, ground at {:.2} m with {:.0} % of the points",
            self.volume.n_keyframes(),
            self.volume.bytes() as f64 / f64::from(1 << 20),
            ground.height,
            100.0 * ground.share
        );
        self.stream.report("");
        let resolution = self.params.resolution;
        let focus = (newest / resolution).floor().truncate().as_ivec2();
        let before = self.stream.extent();
        let Some(grid) = grid(&mut self.volume, before, focus) else {
            return;
        };
        let params = &self.params;
        let level_grid = LevelGrid {
            grid,
            stamp: input.snapshot.stamp,
            ground: ground.height,
            height: ground.height + (params.min_height + params.max_height) / 2.0,
            level_from_map: self.volume.level_from_map(),
        };
        if let Err(e) = self.stream.publish(&self.publisher, level_grid) {
            self.rate_limited
                .warn(format_args!("a grid did not go out: {e}"));
        }
    }

    /// What lies around the newest keyframe.
    fn send_obstacles(&mut self, input: &GridInput, newest: DVec3) {
        let since = self.since_obstacles.as_ref();
        let is_due = since.is_none_or(|watch| watch.secs() >= self.obstacles_period);
        if !is_due && !input.is_last {
            return;
        }
        let watch = Stopwatch::start();
        let reach = OBSTACLES_REACH * self.params.max_range;
        let n = self.params.max_ellipsoids as usize;
        let (stream, publisher) = (&self.stream, &self.publisher);
        let send = || stream.publish_obstacles(publisher, &input.snapshot, (newest, reach), n);
        let sent = match &self.pool {
            Some(pool) => pool.install(send),
            None => send(),
        };
        if let Err(e) = sent {
            let text = format_args!("ellipsoids and voxels did not go out: {e}");
            self.rate_limited.warn(text);
        }
        self.obstacles_period = OBSTACLES_SECS.max(watch.secs() / OBSTACLES_SHARE);
        tracing::debug!("obstacles took {:.1} ms", 1e3 * watch.secs());
        self.since_obstacles = Some(Stopwatch::start());
    }

    fn warn_of(&mut self, faults: &[VolumeError]) {
        if let Some(first) = faults.first() {
            let text = format_args!("{first} ({} in all)", faults.len());
            self.rate_limited.warn(text);
        }
    }
}

/// `map_from_world` has metres a unit for its scale.
pub(crate) fn keyframes_of<'a>(
    views: impl IntoIterator<Item = &'a KeyframeView>,
    map_from_world: &Similarity,
) -> Vec<KeyframeDepth> {
    let keyframe = |view: &KeyframeView| KeyframeDepth {
        id: view.keyframe.id,
        map_from_camera: *map_from_world * Similarity::from(view.world_from_cam),
        intrinsics: view.intrinsics,
        depth: Arc::clone(&view.depth),
    };
    views.into_iter().map(keyframe).collect()
}

/// Runs until the map has ended.
pub(crate) fn run_grid(
    mut stage: Option<GridStage>,
    inputs: &Receiver<GridInput>,
    pool: Option<rayon::ThreadPool>,
) -> Option<GridStage> {
    if let Some(stage) = &mut stage {
        stage.pool = pool;
    }
    while let Some(input) = inputs.recv() {
        if let Some(stage) = &mut stage {
            stage.take(&input, &|| !inputs.is_empty());
        }
    }
    stage
}
