//! Where every frame was, and how that is known: poses of keyframes, of tracked frames, and between them.

use std::collections::BTreeMap;
use std::path::Path;

use crate::eval::error::{EvalError, write_atomically};
use crate::eval::trajectory::TimedPose;
use splat_slam::track::history::FrameTrack;
use splat_types::time::Stamp;
use splat_types::tracking::TrackState;
use splat_types::transform::Rigid;

const HEADER: &str = "stamp_s,pose,state,inliers,std_translation,std_rotation_deg,reason\n";
/// Poses are carried over a gap between two measured ones up to this: what a tracker may guess before it is lost.
const MAX_GAP_SECS: f64 = 0.5;

/// How a pose is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    Keyframe,
    /// Measured when the frame came.
    Tracked,
    /// Measured since, when the map had reached the frame.
    Late,
    /// Between two measured ones.
    Interpolated,
    /// Unknown.
    Missing,
}

/// A frame of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameRow {
    pub stamp: Stamp,
    pub source: Source,
    pub pose: Option<Rigid>,
    pub track: Option<FrameTrack>,
}

/// One row a frame, in order of time. Without any track (tracking was off), all gaps between keyframes are bridged.
pub fn rows(keyframes: &[TimedPose], tracks: &[FrameTrack], stamps: &[Stamp]) -> Vec<FrameRow> {
    let empty = |stamp: Stamp| FrameRow {
        stamp,
        source: Source::Missing,
        pose: None,
        track: None,
    };
    let mut by_stamp: BTreeMap<Stamp, FrameRow> = stamps.iter().map(|s| (*s, empty(*s))).collect();
    for track in tracks {
        let source = match (track.refined, track.live) {
            (Some(_), Some(_)) => Source::Tracked,
            (Some(_), None) => Source::Late,
            (None, _) => Source::Missing,
        };
        let row = FrameRow {
            source,
            pose: track.refined,
            track: Some(*track),
            ..empty(track.stamp)
        };
        by_stamp.insert(track.stamp, row);
    }
    for keyframe in keyframes {
        let row = by_stamp.entry(keyframe.stamp);
        let row = row.or_insert_with(|| empty(keyframe.stamp));
        (row.source, row.pose) = (Source::Keyframe, Some(keyframe.pose));
    }
    let mut rows: Vec<FrameRow> = by_stamp.into_values().collect();
    bridge(
        &mut rows,
        if tracks.is_empty() {
            f64::INFINITY
        } else {
            MAX_GAP_SECS
        },
    );
    rows
}

/// Frames before the first and after the last measured pose have none, rather than a guessed one.
fn bridge(rows: &mut [FrameRow], max_gap_secs: f64) {
    let known: Vec<usize> = (0..rows.len())
        .filter(|i| rows[*i].pose.is_some())
        .collect();
    for pair in known.windows(2) {
        let (first, last) = (rows[pair[0]], rows[pair[1]]);
        let whole = last.stamp.secs_since(first.stamp);
        let (Some(from), Some(to)) = (first.pose, last.pose) else {
            continue;
        };
        if whole > max_gap_secs {
            continue;
        }
        for row in &mut rows[pair[0] + 1..pair[1]] {
            let share = row.stamp.secs_since(first.stamp) / whole;
            row.pose = Some(from.between(&to, share));
            row.source = Source::Interpolated;
        }
    }
}

/// The poses of all rows that have one.
pub fn trajectory(rows: &[FrameRow]) -> Vec<TimedPose> {
    let timed = |row: &FrameRow| {
        Some(TimedPose {
            stamp: row.stamp,
            pose: row.pose?,
        })
    };
    rows.iter().filter_map(timed).collect()
}

/// Poses as they were measured when the frames came, each by the map of that moment.
pub fn live_trajectory(tracks: &[FrameTrack]) -> Vec<TimedPose> {
    let timed = |track: &FrameTrack| {
        Some(TimedPose {
            stamp: track.stamp,
            pose: track.live?,
        })
    };
    tracks.iter().filter_map(timed).collect()
}

/// A table with one line a frame.
pub fn write_frames(rows: &[FrameRow], path: &Path) -> Result<(), EvalError> {
    write_atomically("the frames' table", table(rows).as_bytes(), path)
}

fn table(rows: &[FrameRow]) -> String {
    use std::fmt::Write;

    let mut text = HEADER.to_owned();
    for row in rows {
        let source = match row.source {
            Source::Keyframe => "keyframe",
            Source::Tracked => "tracked",
            Source::Late => "late",
            Source::Interpolated => "interpolated",
            Source::Missing => "missing",
        };
        let state = row.track.map_or("", |track| match track.state {
            TrackState::Initialising => "initialising",
            TrackState::Tracking => "tracking",
            TrackState::Lost => "lost",
            TrackState::Relocalised => "relocalised",
        });
        let n_inliers = row.track.map_or(0, |track| track.n_inliers);
        let std = row.track.and_then(|track| track.std);
        let std = std.map_or(",".to_owned(), |(along, about)| {
            format!("{along:.3e},{about:.3e}")
        });
        let reason = row.track.and_then(|track| track.reason);
        let reason = reason.map_or(String::new(), |reason| reason.to_string().replace(',', ";"));
        let stamp = row.stamp;
        writeln!(text, "{stamp},{source},{state},{n_inliers},{std},{reason}")
            .expect("a String takes any text");
    }
    text
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn stamp(ix: i64) -> Stamp {
        Stamp::from_nanos(ix * 100_000_000)
    }

    fn pose(x: f64) -> Rigid {
        Rigid::new(DQuat::IDENTITY, DVec3::X * x)
    }

    fn track(ix: i64, live: Option<f64>, refined: Option<f64>) -> FrameTrack {
        FrameTrack {
            seq: ix as u64,
            stamp: stamp(ix),
            state: TrackState::Tracking,
            reason: None,
            n_inliers: 40,
            std: Some((0.01, 0.2)),
            live: live.map(pose),
            refined: refined.map(pose),
        }
    }

    fn keyframe(ix: i64) -> TimedPose {
        TimedPose {
            stamp: stamp(ix),
            pose: pose(ix as f64),
        }
    }

    #[test]
    fn short_gaps_are_bridged_and_said_to_be_and_long_ones_stay_open() {
        let stamps: Vec<Stamp> = (0..16).map(stamp).collect();
        let tracks = [
            track(1, Some(1.2), Some(1.1)),
            track(2, None, None),
            track(4, None, Some(4.0)),
        ];
        let rows = rows(&[keyframe(0), keyframe(5), keyframe(14)], &tracks, &stamps);
        let sources: Vec<Source> = rows.iter().map(|row| row.source).collect();
        let mut wanted = vec![Source::Missing; 16];
        for (ix, source) in [
            (0, Source::Keyframe),
            (1, Source::Tracked),
            (2, Source::Interpolated),
            (3, Source::Interpolated),
            (4, Source::Late),
            (5, Source::Keyframe),
            (14, Source::Keyframe),
        ] {
            wanted[ix] = source;
        }
        assert_eq!(sources, wanted);
        assert_eq!(trajectory(&rows).len(), 7);
        assert_eq!(live_trajectory(&tracks).len(), 1);
        let text = table(&rows);
        let line = text.lines().nth(2).unwrap();
        assert_eq!(line, "0.100000000,tracked,tracking,40,1.000e-2,2.000e-1,");
    }

    #[test]
    fn without_tracks_all_frames_between_keyframes_have_a_pose() {
        let stamps: Vec<Stamp> = (0..13).map(stamp).collect();
        let rows = rows(&[keyframe(1), keyframe(11)], &[], &stamps);
        let found = trajectory(&rows);
        assert_eq!(found.len(), 11);
        assert!((found[5].pose.translation.x - 6.0).abs() < 1e-12);
    }
}
