//! Frames and a map of an earlier run -> where the camera is in it. The map stays as it is.

use std::path::Path;

use anyhow::{Context as _, bail};
use serde::Serialize;

use crate::clock::{Stamp, Stopwatch};
use crate::config::Params;
use crate::eval::frames;
use crate::eval::report::percentile;
use crate::eval::trajectory::write_tum;
use crate::map::checkpoint;
use crate::node::Stop;
use crate::source::Source;
use crate::track::{State, Tracker};

/// What came of it, `localisation.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Localisation {
    /// Keyframes of the map that can be recognised.
    pub map_keyframes: usize,
    pub frames: u64,
    /// With a pose measured when they came.
    pub tracked: u64,
    /// Times that the tracker got lost, and was found again without a hint.
    pub lost: u64,
    pub relocalised: u64,
    /// Seconds of the recording from the first frame to the first pose.
    pub first_pose_s: Option<f64>,
    /// Milliseconds of work per frame.
    pub work_ms_p50: Option<f64>,
    pub work_ms_p95: Option<f64>,
    /// Why the last frame without a pose has none.
    pub reason: Option<String>,
}

/// Tracks a source through a map until it ends; writes `trajectory.tum`, `frames.csv` and `localisation.json` to `out`.
pub fn localise(
    map: &Path,
    source: &mut dyn Source,
    params: &Params,
    out: Option<&Path>,
    stop: &Stop,
) -> anyhow::Result<Localisation> {
    let landmarks = checkpoint::read(map)?.landmarks;
    if landmarks.is_empty() {
        bail!(
            "the map holds no landmarks to find a place by: it was written with track.enabled=false or by an older version; map again: {}",
            map.display()
        );
    }
    let mut tracker = Tracker::in_saved(&landmarks, &params.track)
        .map_err(anyhow::Error::msg)
        .with_context(|| format!("cannot find a place in {}", map.display()))?;
    let mut found = Localisation {
        map_keyframes: tracker.n_keyframes(),
        frames: 0,
        tracked: 0,
        lost: 0,
        relocalised: 0,
        first_pose_s: None,
        work_ms_p50: None,
        work_ms_p95: None,
        reason: None,
    };
    let mut first: Option<Stamp> = None;
    let mut work_ms = Vec::new();
    let mut stamps = Vec::new();
    while let Some(frame) = source.next().filter(|_| !stop.is_asked()) {
        let watch = Stopwatch::start();
        let tracked = tracker.track(&frame);
        work_ms.push(watch.secs() * 1e3);
        stamps.push(frame.stamp);
        let start = *first.get_or_insert(frame.stamp);
        if tracked.is_measured() {
            found
                .first_pose_s
                .get_or_insert(frame.stamp.secs_since(start));
        } else {
            found.reason = tracked.reason.map(|reason| reason.to_string());
        }
        if tracked.state == State::Relocalised {
            tracing::info!("found again at {}", frame.stamp);
        }
    }
    let tracks = tracker.finish();
    (found.frames, found.tracked) = (tracks.n_frames, tracks.n_tracked);
    (found.lost, found.relocalised) = (tracks.n_lost, tracks.n_relocalised);
    found.work_ms_p50 = percentile(&work_ms, 0.5);
    found.work_ms_p95 = percentile(&work_ms, 0.95);
    if let Some(out) = out {
        let rows = frames::rows(&[], &tracks.frames, &stamps);
        write_tum(&frames::trajectory(&rows), &out.join("trajectory.tum"))?;
        frames::write_frames(&rows, &out.join("frames.csv"))?;
        let text = serde_json::to_vec_pretty(&found)?;
        let path = out.join("localisation.json");
        crate::atomic::write_file(&path, |file| std::io::Write::write_all(file, &text))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(found)
}
