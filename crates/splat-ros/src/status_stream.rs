//! What all stages report -> the status message and diagnostics. Owned by the thread that follows the tracker.

use std::sync::Arc;

use crate::error::PublishError;
use crate::odometry::PoseEvent;
use crate::params::PublishParams;
use crate::publisher::Publisher;
use crate::reports::Reports;
use crate::status::{DIAGNOSTICS, STATUS, Status, TrackStatus, diagnostics};
use crate::transport::Sample;

/// Composes the status of the cells of the other stages and of what it counts itself.
#[derive(Debug)]
pub struct StatusStream {
    reports: Arc<Reports>,
    track: TrackStatus,
    map_frame: String,
    /// The node's own name, for diagnostics.
    node: String,
}

impl StatusStream {
    pub fn new(params: &PublishParams, reports: Arc<Reports>) -> Self {
        let node = params.namespace.rsplit('/').next().unwrap_or_default();
        Self {
            reports,
            track: TrackStatus::default(),
            map_frame: params.map_frame.clone(),
            node: node.to_owned(),
        }
    }

    /// Counts a tracked frame.
    pub fn count(&mut self, frame: &PoseEvent) {
        let (status, tracked) = (&mut self.track, &frame.tracked);
        status.stamp = tracked.stamp;
        status.state = Some(tracked.state);
        status.reason = tracked.reason.map(|r| r.to_string()).unwrap_or_default();
        status.is_odometry_out = frame.is_odometry_out;
        status.imu_fault = frame.imu_fault;
        status.n_tracked += u64::from(tracked.is_measured());
        status.n_missed += u64::from(!tracked.is_measured());
        status.frame_to_pose.note(frame.latency_secs);
    }

    /// Sends how the mapper stands; `rss_mib` is the memory of the process, where known.
    pub fn send(&self, publisher: &Publisher, rss_mib: Option<f64>) -> Result<(), PublishError> {
        let source = self.reports.source.get();
        let silent_secs = source.since_image.secs();
        let status = Status {
            source: &source,
            select: &self.reports.select.get(),
            track: &self.track,
            map: &self.reports.map.get(),
            published: &self.reports.published.get(),
            grid: &self.reports.grid.get(),
        };
        let message = status.message(&self.map_frame, rss_mib, silent_secs);
        let stamp = self.track.stamp;
        publisher.send(&Sample::of(&STATUS, stamp, &message)?)?;
        let array = diagnostics(&message, &self.node, silent_secs);
        publisher.send(&Sample::of(&DIAGNOSTICS, stamp, &array)?)
    }
}
