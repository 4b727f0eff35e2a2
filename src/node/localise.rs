//! Frames and a map of an earlier run -> where the camera is in it. The map stays as it is.

use std::path::Path;

use anyhow::{Context as _, anyhow, bail};
use serde::Serialize;

use crate::eval::frames;
use crate::eval::report_json::TrackingFigures;
use crate::eval::trajectory::write_tum;
use crate::node::engines::Engines;
use crate::node::page_file::PageFile;
use crate::node::publish_threads::LiveEvent;
use crate::node::run_dir::tracking_figures;
use crate::node::stop::{ShutdownTimeout, Stop};
use crate::node::track_thread::TrackStage;
use crate::params::params::Params;
use splat_io::frame_source::Source;
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::track::params::Photometric;
use splat_slam::track::tracker::Tracker;
use splat_types::snapshot::Scale;
use splat_types::time::Stopwatch;
use splat_view::hub::Hub;

/// What came of it, `localisation.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Localisation {
    /// Keyframes of the map that can be recognised.
    pub map_keyframes: usize,
    #[serde(flatten)]
    pub tracking: TrackingFigures,
    /// Seconds of the recording from the first frame to the first pose.
    pub first_pose_s: Option<f64>,
    /// Why the last frame without a pose has none.
    pub reason: Option<String>,
}

/// Tracks a source through a map until it ends, shown in `viewer` where there is one; writes `trajectory.tum`, `frames.csv` and `localisation.json` to `out`.
pub fn localise(
    map: &Path,
    source: &mut dyn Source,
    params: &Params,
    out: Option<&Path>,
    (stop, viewer): (&Stop, Option<&Hub>),
) -> anyhow::Result<Localisation> {
    let saved = checkpoint::read(map)?;
    let landmarks = saved.landmarks.clone();
    if landmarks.is_empty() {
        bail!(
            "the map holds no landmarks to find a place by: it was written with track.enabled=false or by an older version; map again: {}",
            map.display()
        );
    }
    let tracker = Tracker::in_saved(&landmarks, &params.track)
        .map_err(anyhow::Error::msg)
        .with_context(|| format!("cannot find a place in {}", map.display()))?;
    let map_keyframes = tracker.n_keyframes();
    let mut splats = if params.track.photometric == Photometric::Always {
        let engine = Engines::default().best(params.backend, params.deterministic)?;
        let pages = PageFile::new(None, params.map.max_page_file_mib << 20);
        let empty = Mapper::new(params.mapper(), params.seed, Scale::UP_TO_SCALE, engine)
            .paging_to(Box::new(pages));
        let loaded = empty.resume_report(saved, &params.track);
        Some(loaded.map_err(|reason| anyhow!("cannot look at {}: {reason}", map.display()))?)
    } else {
        None
    };
    let mut stage = TrackStage::of(Some(tracker), false).received(viewer.is_some());
    stage.grace = ShutdownTimeout::new(stop.clone());
    while let Some(frame) = source.next().filter(|_| !stop.is_asked()) {
        stage.track(&frame, &Stopwatch::start());
        for event in stage.take_events() {
            if let (LiveEvent::Frame(event), Some(viewer)) = (event, viewer) {
                viewer.frame(&event.tracked);
            }
        }
        if let Some(splats) = &mut splats {
            let mut fault = None;
            stage.fit(&mut |placement| {
                let found = splats.fit_placement(placement, &frame);
                found.unwrap_or_else(|error| {
                    fault = Some(error);
                    None
                })
            });
            if let Some(error) = fault {
                return Err(error).context("cannot compare frames with the map");
            }
        }
    }
    let tracking = stage.finish(0);
    let tracks = &tracking.tracks.frames;
    let rows = frames::rows(&[], tracks, &[]);
    let first_posed = tracks.iter().find(|track| track.live.is_some());
    let first_pose = tracks.first().zip(first_posed);
    let last_missed = tracks.iter().rev().find(|track| track.live.is_none());
    let found = Localisation {
        map_keyframes,
        tracking: tracking_figures(&tracking, &rows),
        first_pose_s: first_pose.map(|(first, posed)| posed.stamp.secs_since(first.stamp)),
        reason: last_missed.and_then(|track| Some(track.reason?.to_string())),
    };
    if let Some(out) = out {
        write_tum(&frames::trajectory(&rows), &out.join("trajectory.tum"))?;
        frames::write_frames(&rows, &out.join("frames.csv"))?;
        let text = serde_json::to_vec_pretty(&found)?;
        let path = out.join("localisation.json");
        splat_io::whole_file::write_file(&path, |file| std::io::Write::write_all(file, &text))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(found)
}
