//! A job -> the stages that hold a map: begun anew, or gone on with from a saved one.

use std::path::Path;
use std::sync::mpsc::Receiver as Calls;

use anyhow::anyhow;

use crate::map::snapshot::Scale;
use crate::map::{SplatMap, checkpoint};
use crate::node::autosave::Autosave;
use crate::node::stages::MapStage;
use crate::node::track_stage::TrackStage;
use crate::node::{Grace, Job, engine};
use crate::publish::service::Call;
use crate::queue::{WhenFull, queue};

/// The map, who tracks by it, and the first id of keyframes that come.
pub(super) struct Opened {
    pub(super) map: MapStage,
    pub(super) track: TrackStage,
    pub(super) first_id: u32,
}

pub(super) fn open(job: &Job, scale: Scale, calls: Option<Calls<Call>>) -> anyhow::Result<Opened> {
    let params = &job.params;
    let engine = engine(params.backend, params.deterministic)?;
    let mut map = SplatMap::new(params.map.clone(), params.seed, scale, engine)
        .measuring_scale(&params.scale)
        .spilling_to(job.out.as_deref());
    let mut track = TrackStage::new(&params.track, job.is_live);
    track.grace = Grace::new(job.stop.clone());
    if !params.map.load.is_empty() {
        let saved = checkpoint::read(Path::new(&params.map.load))?;
        track.begin_in(&saved.landmarks, &params.track)?;
        map = map
            .continued(saved, &params.track)
            .map_err(|reason| anyhow!("cannot go on from {}: {reason}", params.map.load))?;
    }
    let first_id = map.first_id();
    let n_frames = job.source.len_hint().filter(|n| *n > 0);
    let mut map = MapStage::new(
        map,
        params,
        (job.is_live, n_frames),
        job.stop.clone(),
        job.outbox.clone(),
    );
    map.clerk.keep_calls(calls);
    map.autosave = Autosave::start(job.out.as_deref(), params.map.autosave_secs)?;
    if map.autosave.is_some() || job.outbox.is_some() {
        let (told, landmarks) = queue("landmarks", 1, WhenFull::DropOldest);
        track.tell_landmarks(params.map.autosave_secs, told);
        map.clerk.hear_landmarks(landmarks);
    }
    Ok(Opened {
        map,
        track,
        first_id,
    })
}
