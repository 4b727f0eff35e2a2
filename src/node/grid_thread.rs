//! Keyframes with their depth -> grids for planners. Nobody waits for it: of snapshots that come too fast, the newest counts.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;

use crate::node::page_file::PageFile;
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
/// Grids of a large map take longer: they may take this share of the time.
const GRID_SHARE: f64 = 0.2;
/// Ellipsoids and voxels go out every so many seconds, and seldomer where they take more than this share of the time.
const OBSTACLES_SECS: f64 = 2.0;
const OBSTACLES_SHARE: f64 = 0.05;
/// They lie within so many times the range of depth of the newest keyframe.
const OBSTACLES_REACH: f64 = 2.0;

/// When something is done again: after a while, and seldom enough that it takes no more than its share of the time.
#[derive(Debug)]
struct Pace {
    period: f64,
    share: f64,
    since: Option<Stopwatch>,
    /// Seconds that it took.
    took: f64,
}

impl Pace {
    fn new(period: f64, share: f64) -> Self {
        Self {
            period,
            share,
            since: None,
            took: 0.0,
        }
    }

    fn is_due(&self) -> bool {
        let wanted = self.period.max(self.took / self.share);
        self.since.is_none_or(|watch| watch.secs() >= wanted)
    }

    fn done(&mut self, took: f64) {
        (self.since, self.took) = (Some(Stopwatch::start()), took);
    }
}

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
    folder: Option<PathBuf>,
    map_id: Option<[u8; 16]>,
    publisher: Arc<Publisher>,
    stream: GridStream,
    pool: Option<rayon::ThreadPool>,
    grids: Pace,
    obstacles: Pace,
    rate_limited: RateLimitedLog,
}

impl GridStage {
    /// `folder`: of the run, where far parts of the volume go when memory is short.
    pub(crate) fn new(
        params: &GridParams,
        folder: Option<&Path>,
        publisher: &Arc<Publisher>,
        stream: GridStream,
    ) -> Self {
        let folder = folder.map(Path::to_owned);
        Self {
            params: params.clone(),
            volume: empty_volume(params, folder.as_deref()),
            folder,
            map_id: None,
            publisher: Arc::clone(publisher),
            stream,
            pool: None,
            grids: Pace::new(params.period, GRID_SHARE),
            obstacles: Pace::new(OBSTACLES_SECS, OBSTACLES_SHARE),
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
            self.volume = empty_volume(&self.params, self.folder.as_deref());
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
                tracing::debug!(
                    "grid: {n_left} keyframes are still to be fused where they are now"
                );
                break;
            }
        }
        if self.grids.is_due() || input.is_last {
            let watch = Stopwatch::start();
            let is_sent = self.send(input, &keyframes);
            if is_sent {
                self.grids.done(watch.secs());
            }
        }
    }

    /// `false`: there is no grid.
    fn send(&mut self, input: &GridInput, keyframes: &[KeyframeDepth]) -> bool {
        let snapshot = &input.snapshot;
        self.stream
            .keep_volume(&self.publisher, &self.volume, snapshot);
        let newest = keyframes.last().map_or(DVec3::ZERO, |keyframe| {
            self.volume.level_from_map() * keyframe.map_from_camera.translation
        });
        self.send_obstacles(input, newest);
        let Some(ground) = self.volume.ground() else {
            let reason = "no ground was seen: a plane below the camera that leans by less than 25 degrees from level";
            self.stream.report(reason);
            return false;
        };
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
            return false;
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
        true
    }

    /// What lies around the newest keyframe.
    fn send_obstacles(&mut self, input: &GridInput, newest: DVec3) {
        if !self.obstacles.is_due() && !input.is_last {
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
        tracing::debug!("obstacles took {:.1} ms", 1e3 * watch.secs());
        self.obstacles.done(watch.secs());
    }

    fn warn_of(&mut self, faults: &[VolumeError]) {
        if let Some(first) = faults.first() {
            let text = format_args!("{first} ({} in all)", faults.len());
            self.rate_limited.warn(text);
        }
    }
}

fn empty_volume(params: &GridParams, folder: Option<&Path>) -> Volume {
    let pages = PageFile::new(folder, params.max_page_file_mib << 20);
    Volume::new(params).paging_to(Box::new(pages))
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
