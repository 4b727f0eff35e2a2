//! How the stages stand, one struct for each that writes -> the status message and diagnostics.

use std::collections::VecDeque;

use crate::transport::{Delivery, Topic};
use splat_io::frame_source::SourceCounts;
use splat_msgs::ros::Header;
use splat_msgs::ros::standard::{DiagnosticArray, DiagnosticStatus, KeyValue};
use splat_msgs::status_message::MapperStatus;
use splat_types::load_shed::LoadShed;
use splat_types::snapshot::Scale;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::tracking::TrackState;

pub static STATUS: Topic = Topic::of::<MapperStatus>("status", Delivery::Latched { depth: 1 });
pub static DIAGNOSTICS: Topic =
    Topic::of::<DiagnosticArray>("/diagnostics", Delivery::Reliable { depth: 10 });
pub static TOPICS: [&Topic; 2] = [&STATUS, &DIAGNOSTICS];

/// Times that a percentile is taken over.
const MAX_TIMES: usize = 1000;
/// Seconds without an image after which the input counts as slow, and as silent.
const SLOW_SECS: f64 = 1.0;
const SILENT_SECS: f64 = 3.0;
/// STATE_RECOVERING of the message.
const RECOVERING: u8 = 6;
const MIB: f64 = (1 << 20) as f64;

/// The last times of one kind, in seconds.
#[derive(Debug, Clone, Default)]
pub struct Times(VecDeque<f64>);

impl Times {
    pub fn note(&mut self, secs: f64) {
        if self.0.len() == MAX_TIMES {
            self.0.pop_front();
        }
        self.0.push_back(secs);
    }

    /// Milliseconds; NaN while there are none.
    fn percentile_ms(&self, share: f64) -> f32 {
        let mut sorted: Vec<f64> = self.0.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let ix = ((sorted.len() as f64 * share) as usize).min(sorted.len().saturating_sub(1));
        sorted.get(ix).map_or(f32::NAN, |secs| (secs * 1e3) as f32)
    }
}

/// What the source says of the input.
#[derive(Debug, Clone)]
pub struct SourceStatus {
    pub counts: SourceCounts,
    /// Since the last image came; before the first, since the start.
    pub since_image: Stopwatch,
    pub is_calibrated: bool,
    pub is_paused: bool,
    pub has_ended: bool,
    /// A line each, for example that a camera is gone.
    pub warnings: Vec<String>,
}

impl Default for SourceStatus {
    fn default() -> Self {
        Self {
            counts: SourceCounts::default(),
            since_image: Stopwatch::start(),
            is_calibrated: false,
            is_paused: false,
            has_ended: false,
            warnings: Vec::new(),
        }
    }
}

/// What selection says of what it has taken and of what waits for it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SelectStatus {
    pub n_keyframes: u64,
    /// Frames that made room for newer ones before selection looked at them.
    pub n_dropped_frames: u64,
    pub n_queued_frames: usize,
    /// Batches that wait for geometry.
    pub n_queued_batches: usize,
}

/// What tracked frames add up to.
#[derive(Debug, Clone, Default)]
pub struct TrackStatus {
    /// Of the newest frame that was looked at.
    pub stamp: Stamp,
    /// `None` before the first frame.
    pub state: Option<TrackState>,
    pub reason: String,
    pub n_tracked: u64,
    pub n_missed: u64,
    /// Odometry disagrees with the camera.
    pub is_odometry_out: bool,
    /// What is wrong with the IMU.
    pub imu_fault: Option<&'static str>,
    pub frame_to_pose: Times,
}

/// What the map thread says of the map that it works on.
#[derive(Debug, Clone, Default)]
pub struct MapStatus {
    pub n_registered: u64,
    pub n_submaps: u64,
    pub n_splats: u64,
    pub n_steps: u64,
    pub steps_per_s: f64,
    pub gpu_bytes: u64,
    pub keyframe_to_pose: Times,
    /// What was left out, or waited, since poses were more urgent.
    pub load_shed: LoadShed,
    /// Why the map is being put on another engine.
    pub recovering: Option<String>,
}

/// Which snapshot was the last to go out.
#[derive(Debug, Clone, Copy, Default)]
pub struct PublishedStatus {
    pub map_id: [u8; 16],
    pub epoch: u32,
    pub revision: u32,
    pub scale: Scale,
    /// Snapshots that wait behind it.
    pub n_queued: usize,
}

/// What became of the grid.
#[derive(Debug, Clone, Default)]
pub struct GridStatus {
    /// Why there is none; empty: there is one, or none is wanted.
    pub refused: String,
}

/// What all stages say at one moment.
#[derive(Debug, Clone, Copy)]
pub struct Status<'a> {
    pub source: &'a SourceStatus,
    pub select: &'a SelectStatus,
    pub track: &'a TrackStatus,
    pub map: &'a MapStatus,
    pub published: &'a PublishedStatus,
    pub grid: &'a GridStatus,
}

impl Status<'_> {
    fn state(&self) -> u8 {
        match self.track.state {
            _ if self.source.has_ended => 5,
            _ if self.source.is_paused => 4,
            _ if self.map.recovering.is_some() => RECOVERING,
            None | Some(TrackState::Initialising) => 0,
            Some(TrackState::Tracking) => 1,
            Some(TrackState::Lost) => 2,
            Some(TrackState::Relocalised) => 3,
        }
    }

    /// What keeps the mapper from working well.
    pub fn warnings(&self, silent_secs: f64) -> Vec<String> {
        let source = self.source;
        let mut warnings = source.warnings.clone();
        let runs = !source.has_ended && !source.is_paused;
        if runs && silent_secs > SLOW_SECS {
            warnings.push(if source.counts.received == 0 {
                format!("no image has come for {silent_secs:.0} s: is the camera on, and is it this topic?")
            } else {
                format!("no image for {silent_secs:.0} s")
            });
        }
        if let Some(fault) = &source.counts.fault {
            warnings.push(fault.clone());
        }
        if self.map.n_registered > 0 && self.published.scale.metres_per_unit.is_none() {
            warnings.push(
                "lengths are up to scale: no odometry, depth, camera height or baseline is known"
                    .to_owned(),
            );
        }
        if source.counts.received > 0 && !source.is_calibrated {
            warnings.push("the camera is uncalibrated: its focal length is estimated".to_owned());
        }
        if self.map.n_submaps > 1 {
            let n = self.map.n_submaps;
            warnings.push(format!("{n} parts of the input do not hang together"));
        }
        if self.track.is_odometry_out {
            warnings.push(
                "odometry disagrees with the camera and is left out: wheels slip, or its stamps or its mounting are wrong"
                    .to_owned(),
            );
        }
        if let Some(fault) = self.track.imu_fault {
            warnings.push(format!(
                "the IMU {fault} and is left out: look at its topic, its stamps and how it is mounted"
            ));
        }
        if !self.grid.refused.is_empty() {
            warnings.push(format!("no grid: {}", self.grid.refused));
        }
        warnings.extend(short_of_time(&self.map.load_shed));
        warnings
    }

    pub fn message(&self, frame: &str, rss_mib: Option<f64>, silent_secs: f64) -> MapperStatus {
        let (select, track) = (self.select, self.track);
        let (map, published) = (self.map, self.published);
        let counts = &self.source.counts;
        let (scale_source, metres_per_unit, scale_std) = published.scale.to_numbers();
        MapperStatus {
            header: Header::new(track.stamp, frame),
            map_id: published.map_id,
            epoch: published.epoch,
            revision: published.revision,
            state: self.state(),
            reason: map.recovering.as_ref().unwrap_or(&track.reason).clone(),
            frames_received: counts.received,
            frames_dropped: select.n_dropped_frames + counts.dropped,
            frames_undecodable: counts.undecodable,
            frames_out_of_order: counts.out_of_order,
            frames_tracked: track.n_tracked,
            frames_lost: track.n_missed,
            keyframes_selected: select.n_keyframes as u32,
            keyframes_registered: map.n_registered as u32,
            submaps: map.n_submaps as u32,
            splats: map.n_splats as u32,
            steps: map.n_steps,
            steps_per_s: map.steps_per_s as f32,
            frame_to_pose_p50_ms: track.frame_to_pose.percentile_ms(0.5),
            frame_to_pose_p95_ms: track.frame_to_pose.percentile_ms(0.95),
            keyframe_to_pose_p50_ms: map.keyframe_to_pose.percentile_ms(0.5),
            keyframe_to_pose_p95_ms: map.keyframe_to_pose.percentile_ms(0.95),
            rss_mib: rss_mib.map_or(f32::NAN, |mib| mib as f32),
            gpu_mib: (map.gpu_bytes as f64 / MIB) as f32,
            frames_queued: select.n_queued_frames as u32,
            batches_queued: select.n_queued_batches as u32,
            snapshots_queued: published.n_queued as u32,
            scale_source,
            metres_per_unit,
            scale_std,
            warnings: self.warnings(silent_secs),
        }
    }
}

/// `None` where nothing was left out. That steps and depth wait is no fault: they get what poses leave.
fn short_of_time(load_shed: &LoadShed) -> Option<String> {
    let (hurried, unsought) = (load_shed.hurried_keyframes, load_shed.unsought_keyframes);
    (hurried + unsought > 0).then(|| {
        format!(
            "short of time: {hurried} keyframes got fewer features, {unsought} were not compared with places of long ago; \
             depth has waited {:.0} s, steps {:.0} s",
            load_shed.depth_secs, load_shed.steps_secs
        )
    })
}

/// The status as `/diagnostics` has it: input, tracking, map.
pub fn diagnostics(status: &MapperStatus, node: &str, silent_secs: f64) -> DiagnosticArray {
    let part = |name: &str, (level, message): (u8, String), values: &[(&str, String)]| {
        let value = |(key, value): &(&str, String)| KeyValue {
            key: (*key).to_owned(),
            value: value.clone(),
        };
        DiagnosticStatus {
            level,
            name: format!("{node}: {name}"),
            message,
            hardware_id: node.to_owned(),
            values: values.iter().map(value).collect(),
        }
    };
    let input = [
        ("frames_received", status.frames_received.to_string()),
        ("frames_dropped", status.frames_dropped.to_string()),
        ("frames_undecodable", status.frames_undecodable.to_string()),
        (
            "frames_out_of_order",
            status.frames_out_of_order.to_string(),
        ),
        ("frames_queued", status.frames_queued.to_string()),
    ];
    let tracking = [
        ("frames_tracked", status.frames_tracked.to_string()),
        ("frames_lost", status.frames_lost.to_string()),
        (
            "frame_to_pose_p50_ms",
            status.frame_to_pose_p50_ms.to_string(),
        ),
        (
            "frame_to_pose_p95_ms",
            status.frame_to_pose_p95_ms.to_string(),
        ),
    ];
    let map = [
        ("keyframes_selected", status.keyframes_selected.to_string()),
        (
            "keyframes_registered",
            status.keyframes_registered.to_string(),
        ),
        ("submaps", status.submaps.to_string()),
        ("splats", status.splats.to_string()),
        ("steps", status.steps.to_string()),
        ("steps_per_s", status.steps_per_s.to_string()),
        (
            "keyframe_to_pose_p95_ms",
            status.keyframe_to_pose_p95_ms.to_string(),
        ),
        ("epoch", status.epoch.to_string()),
        ("revision", status.revision.to_string()),
        ("rss_mib", status.rss_mib.to_string()),
        ("gpu_mib", status.gpu_mib.to_string()),
        ("metres_per_unit", status.metres_per_unit.to_string()),
    ];
    let [of_input, of_tracking, of_map] = levels(status, silent_secs);
    DiagnosticArray {
        header: Header {
            frame_id: String::new(),
            ..status.header.clone()
        },
        status: vec![
            part("input", of_input, &input),
            part("tracking", of_tracking, &tracking),
            part("map", of_map, &map),
        ],
    }
}

/// (level, message) of input, tracking and map.
fn levels(status: &MapperStatus, silent_secs: f64) -> [(u8, String); 3] {
    let is_running = status.state < 4 || status.state == RECOVERING;
    let silence = format!("no image for {silent_secs:.1} s");
    let input = match silent_secs {
        _ if !is_running => (DiagnosticStatus::OK, "paused or ended".to_owned()),
        secs if secs > SILENT_SECS => (DiagnosticStatus::ERROR, silence),
        secs if secs > SLOW_SECS => (DiagnosticStatus::WARN, silence),
        _ => (DiagnosticStatus::OK, "images come".to_owned()),
    };
    let tracking = match status.state {
        0 => (DiagnosticStatus::WARN, "no map yet".to_owned()),
        2 => (DiagnosticStatus::ERROR, format!("lost: {}", status.reason)),
        _ => (DiagnosticStatus::OK, "tracking".to_owned()),
    };
    let map = match status.warnings.first() {
        _ if status.state == RECOVERING => (DiagnosticStatus::ERROR, status.reason.clone()),
        None => (DiagnosticStatus::OK, "growing".to_owned()),
        Some(first) => (DiagnosticStatus::WARN, first.clone()),
    };
    [input, tracking, map]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn diagnostics_give_a_camera_that_stops_from_one_that_runs() {
        let track = TrackStatus {
            state: Some(TrackState::Tracking),
            ..TrackStatus::default()
        };
        let calibrated = SourceStatus {
            is_calibrated: true,
            ..SourceStatus::default()
        };
        let message = |silent_secs: f64, source: &SourceStatus| {
            let status = Status {
                source,
                select: &SelectStatus::default(),
                track: &track,
                map: &MapStatus::default(),
                published: &PublishedStatus::default(),
                grid: &GridStatus::default(),
            };
            status.message("map", Some(1.0), silent_secs)
        };
        let level = |silent_secs: f64, source: &SourceStatus| {
            diagnostics(&message(silent_secs, source), "mapper", silent_secs).status[0].level
        };
        assert_eq!(
            [0.2, 1.5, 3.5].map(|secs| level(secs, &calibrated)),
            [0, 1, 2]
        );
        let paused = SourceStatus {
            is_paused: true,
            ..calibrated.clone()
        };
        assert_eq!(level(9.0, &paused), DiagnosticStatus::OK);
        let silent = message(5.0, &calibrated);
        assert!(
            silent
                .warnings
                .iter()
                .any(|w| w.contains("no image has come for 5 s"))
        );
    }

    #[test]
    fn what_was_left_out_for_lack_of_time_is_a_warning_and_waiting_alone_is_none() {
        let mut shed = LoadShed {
            depth_secs: 3.0,
            steps_secs: 40.0,
            ..LoadShed::default()
        };
        assert_eq!(short_of_time(&shed), None);
        shed.hurried_keyframes = 5;
        let warning = short_of_time(&shed).unwrap();
        assert!(
            warning.contains("5 keyframes got fewer features"),
            "{warning}"
        );
        assert!(
            warning.contains("depth has waited 3 s, steps 40 s"),
            "{warning}"
        );
    }

    #[test]
    fn percentiles_are_of_the_last_times() {
        let mut times = Times::default();
        assert!(times.percentile_ms(0.5).is_nan());
        for i in 0..3000 {
            times.note(if i < 2000 {
                9.0
            } else {
                f64::from(i - 2000) * 1e-3
            });
        }
        assert!((times.percentile_ms(0.5) - 500.0).abs() < 0.01);
        assert!((times.percentile_ms(0.95) - 950.0).abs() < 0.01);
    }
}
