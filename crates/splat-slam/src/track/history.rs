//! What was said of every frame, and what is known of it in the end.

use crate::track::anchor::Anchor;
use crate::track::map_odometry::MapInitialisation;
use crate::track::odometry_link::MIN_UNIT_STD;
use splat_types::covariance::worst_std;
use splat_types::time::Stamp;
use splat_types::tracking::{LostReason, TrackState, TrackedFrame};
use splat_types::transform::Rigid;

/// Frames beyond this many have no place in the trajectory: nine hours at 30 Hz, some 250 MB.
const MAX_FRAMES: usize = 1_000_000;

/// A frame of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameTrack {
    pub seq: u64,
    pub stamp: Stamp,
    /// As it was said when the frame came.
    pub state: TrackState,
    pub reason: Option<LostReason>,
    pub n_inliers: u32,
    /// Standard deviation along and about the least certain axis: (the map's unit, degrees).
    pub std: Option<(f32, f32)>,
    /// `world_from_cam` as it was measured when the frame came; what was reported before there was a map, in that map.
    pub live: Option<Rigid>,
    /// The same by the last poses of the keyframes, and of frames that had no pose when they came but have one since.
    pub refined: Option<Rigid>,
}

/// All frames, and what befell them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracks {
    /// In order of time.
    pub frames: Vec<FrameTrack>,
    pub n_frames: u64,
    /// Frames with a pose measured when they came.
    pub n_tracked: u64,
    /// Times that the tracker got lost, and was found again without a hint.
    pub n_lost: u64,
    pub n_relocalised: u64,
    /// Frames whose last pose is that at which their image fits the splats best.
    pub n_fitted: u64,
}

#[derive(Debug)]
pub(crate) struct HistoryEntry {
    track: FrameTrack,
    pub(crate) anchor: Option<Anchor>,
    /// `live` is in the frame of this segment of odometry: there was no map.
    pub(crate) segment: Option<u32>,
    /// The map was looked at to find where its image fits.
    pub(crate) is_fitted: bool,
}

#[derive(Debug, Default)]
pub(crate) struct History {
    /// Up to `MAX_FRAMES`, and one more that stands for all later ones.
    pub(crate) frames: Vec<HistoryEntry>,
    n_frames: u64,
    n_tracked: u64,
    pub(crate) n_lost: u64,
    pub(crate) n_relocalised: u64,
}

impl HistoryEntry {
    /// What is known of the frame in the end; `refined` is its pose by the last poses of the keyframes.
    pub(crate) fn summary(&self, refined: Option<Rigid>) -> FrameTrack {
        FrameTrack {
            refined,
            ..self.track
        }
    }
}

impl History {
    /// Returns the frame's number.
    pub(crate) fn push(&mut self, frame: &TrackedFrame, anchor: Option<Anchor>) -> usize {
        self.n_frames += 1;
        self.n_tracked += u64::from(frame.is_measured());
        let std = frame.pose.map(|pose| {
            let (place, turn) = worst_std(&pose.covariance);
            (place as f32, turn.to_degrees() as f32)
        });
        let measured = frame.pose.filter(|pose| !pose.is_predicted);
        let track = FrameTrack {
            seq: frame.seq,
            stamp: frame.stamp,
            state: frame.state,
            reason: frame.reason,
            n_inliers: frame.n_inliers as u32,
            std,
            live: measured.map(|pose| pose.world_from_cam),
            refined: None,
        };
        if self.frames.len() > MAX_FRAMES {
            self.frames.truncate(MAX_FRAMES);
        }
        self.frames.push(HistoryEntry {
            track,
            anchor,
            segment: None,
            is_fitted: false,
        });
        self.frames.len() - 1
    }

    /// The frame pushed last has its pose in the frame of a segment of odometry.
    pub(crate) fn reported_in(&mut self, segment: u32) {
        if let Some(entry) = self.frames.last_mut() {
            entry.segment = Some(segment);
        }
    }

    /// Poses that were reported before there was a map go into its frame, where it is known how.
    pub(crate) fn express_in_map(&mut self, initialisation: &MapInitialisation) {
        let is_of_segment = |entry: &&HistoryEntry| entry.segment == Some(initialisation.segment);
        let newest = self.frames.iter().rev().find(is_of_segment);
        let newest = newest.and_then(|entry| entry.track.live);
        for entry in &mut self.frames {
            if entry.segment.take() == Some(initialisation.segment) {
                let map = initialisation.world_from_odometry;
                let in_map = |pose: &Rigid| Some(map?.transform_pose(pose));
                // The unit is that of the newest frames, and drifts on the way to them.
                let ends = entry.track.live.zip(newest);
                let away = ends.map_or(0.0, |(here, newest)| {
                    (newest.translation - here.translation).length()
                });
                let scale = map.map_or(1.0, |map| map.scale);
                let in_unit = |std: f32| (f64::from(std).hypot(MIN_UNIT_STD * away) * scale) as f32;
                entry.track.std = entry.track.std.map(|(far, turned)| (in_unit(far), turned));
                entry.track.live = entry.track.live.as_ref().and_then(in_map);
            }
        }
    }

    pub(crate) fn into_tracks(self, mut frames: Vec<FrameTrack>) -> Tracks {
        frames.truncate(MAX_FRAMES);
        let fitted = self.frames.iter().filter(|frame| frame.is_fitted);
        Tracks {
            n_fitted: fitted.count() as u64,
            frames,
            n_frames: self.n_frames,
            n_tracked: self.n_tracked,
            n_lost: self.n_lost,
            n_relocalised: self.n_relocalised,
        }
    }
}
