//! Events of the stages -> the publisher: poses and status on one thread, snapshots on another.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::machine::memory::rss_mib;
use crate::node::grid_thread::{GridInput, GridStage};
use crate::node::rate_limited::RateLimitedLog;
use splat_io::queue::{Received, Receiver};
use splat_ros::error::PublishError;
use splat_ros::map_stream::MapStream;
use splat_ros::navigation::KeyframeDepth;
use splat_ros::odometry::PoseEvent;
use splat_ros::output::Streams;
use splat_ros::pose_stream::PoseStream;
use splat_ros::publisher::Publisher;
use splat_ros::status_stream::StatusStream;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;
use splat_volume::params::GridParams;

/// Transforms go out at least so often: consumers like to look back no further (Nav2: 10 Hz, better 20).
const REPEAT: Duration = Duration::from_millis(30);
const STATUS_SECS: f64 = 1.0;

/// Events of the tracker, to be published.
#[derive(Debug)]
pub(crate) enum LiveEvent {
    Frame(Box<PoseEvent>),
    Keyframe(Box<KeyframeDepth>),
}

/// The map as it is to go out, with all submaps that have no known relation to it.
#[derive(Debug, Clone)]
pub(crate) struct Outgoing {
    pub(crate) snapshot: Arc<Snapshot>,
    pub(crate) submaps: Vec<Arc<Snapshot>>,
    /// For the grid, where there is one.
    pub(crate) grid: Option<GridInput>,
}

/// What goes out, and whether it is the last.
pub(crate) type SnapshotEvent = (Outgoing, bool);

/// A client that is gone or slow must not end the run.
fn warn_of(log: &mut RateLimitedLog, sent: Result<(), PublishError>) {
    if let Err(e) = sent {
        log.warn(format_args!("a message did not go out: {e}"));
    }
}

/// Poses and the status on their way out.
#[derive(Debug)]
pub(crate) struct LiveStage {
    publisher: Arc<Publisher>,
    poses: PoseStream,
    status: StatusStream,
    rate_limited: RateLimitedLog,
}

impl LiveStage {
    /// In sequence: publishes the events that have gathered.
    pub(crate) fn publish(&mut self, events: &[LiveEvent]) {
        events.iter().for_each(|event| self.send_event(event));
    }

    fn send_event(&mut self, event: &LiveEvent) {
        let sent = match event {
            LiveEvent::Frame(frame) => {
                self.status.count(frame);
                self.poses.live(&self.publisher, frame)
            }
            LiveEvent::Keyframe(seen) => self.poses.keyframe(&self.publisher, seen),
        };
        warn_of(&mut self.rate_limited, sent);
    }

    fn repeat_transforms(&mut self) {
        let sent = self.poses.repeat_transforms(&self.publisher);
        warn_of(&mut self.rate_limited, sent);
    }

    fn send_status(&mut self) {
        let sent = self.status.send(&self.publisher, rss_mib());
        warn_of(&mut self.rate_limited, sent);
    }
}

/// Snapshots on their way out.
#[derive(Debug)]
pub(crate) struct SnapshotStage {
    publisher: Arc<Publisher>,
    map: MapStream,
    rate_limited: RateLimitedLog,
}

impl SnapshotStage {
    /// `n_queued` snapshots wait behind it.
    pub(crate) fn publish(&mut self, (outgoing, is_last): &SnapshotEvent, n_queued: usize) {
        let map = &mut self.map;
        let sent = map.publish(&self.publisher, &outgoing.snapshot, *is_last, n_queued);
        let submaps = map.publish_submaps(&self.publisher, &outgoing.submaps);
        warn_of(&mut self.rate_limited, sent.and(submaps));
    }
}

/// All that publish, each for a thread.
pub(crate) struct OutputStages {
    pub(crate) live: LiveStage,
    pub(crate) snapshots: SnapshotStage,
    pub(crate) grid: GridStage,
}

/// Who publishes what; `streams_of` takes it apart again. `folder`: where far parts of the volume may go.
pub(crate) fn stages_of(
    publisher: &Arc<Publisher>,
    streams: Streams,
    (grid, folder): (&GridParams, Option<&Path>),
) -> OutputStages {
    let live = LiveStage {
        publisher: Arc::clone(publisher),
        poses: streams.poses,
        status: streams.status,
        rate_limited: RateLimitedLog::default(),
    };
    let snapshots = SnapshotStage {
        publisher: Arc::clone(publisher),
        map: streams.map,
        rate_limited: RateLimitedLog::default(),
    };
    OutputStages {
        live,
        snapshots,
        grid: GridStage::new(grid, folder, publisher, streams.grid),
    }
}

/// What goes on with the next map.
pub(crate) fn streams_of(stages: OutputStages) -> Streams {
    Streams {
        map: stages.snapshots.map,
        poses: stages.live.poses,
        status: stages.live.status,
        grid: stages.grid.into_stream(),
    }
}

/// Runs until the tracker has ended.
pub(crate) fn run_live(mut stage: LiveStage, events: &Receiver<LiveEvent>) -> LiveStage {
    let mut since_status = Stopwatch::start();
    stage.send_status();
    loop {
        match events.recv_timeout(REPEAT) {
            Received::Item(event) => stage.send_event(&event),
            Received::Nothing => stage.repeat_transforms(),
            Received::Ended => break,
        }
        if since_status.secs() >= STATUS_SECS {
            since_status = Stopwatch::start();
            stage.send_status();
        }
    }
    stage.send_status();
    stage
}

/// Runs until the map has ended.
pub(crate) fn run_publisher(
    mut stage: Option<SnapshotStage>,
    snapshots: &Receiver<SnapshotEvent>,
) -> Option<SnapshotStage> {
    while let Some(outgoing) = snapshots.recv() {
        if let Some(stage) = &mut stage {
            stage.publish(&outgoing, snapshots.len());
        }
    }
    stage
}
