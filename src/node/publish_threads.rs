//! Events of the stages -> the publisher: poses and status on one thread, snapshots on another.

use std::sync::Arc;
use std::time::Duration;

use crate::machine::memory::rss_mib;
use splat_io::queue::{Received, Receiver};
use splat_ros::error::PublishError;
use splat_ros::navigation::KeyframeDepth;
use splat_ros::odometry::PoseEvent;
use splat_ros::publisher::Publisher;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;

/// Transforms go out at least so often: consumers like to look back no further (Nav2: 10 Hz, better 20).
const REPEAT: Duration = Duration::from_millis(30);
const STATUS_SECS: f64 = 1.0;
/// Seconds between warnings of one kind.
const LOG_SECS: f64 = 10.0;

/// Events of the tracker, to be published.
#[derive(Debug)]
pub(crate) enum LiveEvent {
    Frame(Box<PoseEvent>),
    Keyframe(Box<KeyframeDepth>),
}

/// A snapshot, and whether it is the last one.
pub(crate) type SnapshotEvent = (Arc<Snapshot>, bool);

/// Logs failures to send, at most once per `LOG_SECS`.
#[derive(Debug, Default)]
pub(crate) struct RateLimitedLog {
    since: Option<Stopwatch>,
}

impl RateLimitedLog {
    fn of(&mut self, sent: Result<(), PublishError>) {
        let Err(e) = sent else { return };
        // A client that is gone or slow must not end the run.
        if self.since.is_none_or(|watch| watch.secs() > LOG_SECS) {
            tracing::warn!("a message did not go out: {e}");
            self.since = Some(Stopwatch::start());
        }
    }
}

fn send_event(publisher: &Publisher, event: &LiveEvent) -> Result<(), PublishError> {
    match event {
        LiveEvent::Frame(frame) => publisher.live(frame),
        LiveEvent::Keyframe(seen) => publisher.keyframe(seen),
    }
}

/// Runs until the tracker has ended.
pub(crate) fn run_live(publisher: &Publisher, events: &Receiver<LiveEvent>) {
    let mut rate_limited = RateLimitedLog::default();
    let mut since_status = Stopwatch::start();
    rate_limited.of(publisher.status(rss_mib()));
    loop {
        match events.recv_timeout(REPEAT) {
            Received::Item(event) => rate_limited.of(send_event(publisher, &event)),
            Received::Nothing => rate_limited.of(publisher.repeat_transforms()),
            Received::Ended => break,
        }
        if since_status.secs() >= STATUS_SECS {
            since_status = Stopwatch::start();
            rate_limited.of(publisher.status(rss_mib()));
        }
    }
    rate_limited.of(publisher.status(rss_mib()));
}

/// Runs until the map has ended.
pub(crate) fn run_publisher(publisher: Option<&Publisher>, snapshots: &Receiver<SnapshotEvent>) {
    let mut rate_limited = RateLimitedLog::default();
    while let Some(outgoing) = snapshots.recv() {
        if let Some(publisher) = publisher {
            publish_snapshot(publisher, &outgoing, &mut rate_limited);
        }
    }
}

/// In sequence: publishes the events that have gathered.
pub(crate) fn publish_events(
    publisher: &Publisher,
    events: &[LiveEvent],
    rate_limited: &mut RateLimitedLog,
) {
    events
        .iter()
        .for_each(|event| rate_limited.of(send_event(publisher, event)));
}

pub(crate) fn publish_snapshot(
    publisher: &Publisher,
    outgoing: &SnapshotEvent,
    rate_limited: &mut RateLimitedLog,
) {
    rate_limited.of(publish(publisher, outgoing));
}

fn publish(publisher: &Publisher, (snapshot, is_last): &SnapshotEvent) -> Result<(), PublishError> {
    if *is_last {
        publisher.publish_last(snapshot)
    } else {
        publisher.publish(snapshot)
    }
}
