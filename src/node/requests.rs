//! Service calls -> replies, between steps of the map.

use std::path::Path;
use std::sync::mpsc::Receiver as Calls;

use crate::formats::file::{self, SplatFormat};
use crate::formats::spz::SpzVersion;
use crate::node::save_map::{MapFile, save_map};
use crate::node::stop::Stop;
use splat_engine::error::EngineError;
use splat_io::queue::Receiver;
use splat_ros::service_server::{ServiceCall, ServiceReply, ServiceRequest};
use splat_slam::mapper::map_file::checkpoint;
use splat_slam::mapper::mapper::Mapper;
use splat_slam::track::params::TrackParams;
use splat_slam::track::tracker::Tracker;

/// What calls from outside are answered with, besides the map.
#[derive(Debug)]
pub(crate) struct RequestHandler {
    /// To begin again from a saved map; `None` once the input has ended.
    stop: Option<Stop>,
    wanted: String,
    calls: Option<Calls<ServiceCall>>,
    track: TrackParams,
    /// What the tracker indicates its landmarks now and then, and the newest of it.
    reported: Option<Receiver<Vec<u8>>>,
    landmarks: Vec<u8>,
}

impl RequestHandler {
    pub(crate) fn new(calls: Option<Calls<ServiceCall>>, track: &TrackParams, stop: Stop) -> Self {
        Self {
            calls,
            stop: Some(stop),
            wanted: String::new(),
            track: track.clone(),
            reported: None,
            landmarks: Vec::new(),
        }
    }

    pub(crate) fn receive_landmarks(&mut self, reported: Receiver<Vec<u8>>) {
        self.reported = Some(reported);
    }

    /// The newest that the tracker has reported; empty before.
    pub(crate) fn landmarks(&mut self) -> &[u8] {
        while let Some(Ok(Some(newest))) = self.reported.as_ref().map(Receiver::try_recv) {
            self.landmarks = newest;
        }
        &self.landmarks
    }

    /// For the time after this map.
    pub(crate) fn take_calls(&mut self) -> Option<Calls<ServiceCall>> {
        self.calls.take()
    }

    /// Answers what has been asked since.
    pub(crate) fn serve(&mut self, map: &mut Mapper) -> Result<(), EngineError> {
        while let Some(call) = self.calls.as_ref().and_then(|calls| calls.try_recv().ok()) {
            let (answer, fault) = match self.answer(map, &call.request) {
                Ok(answer) => (answer, Ok(())),
                Err(error) => (ServiceReply::Refused(error.to_string()), Err(error)),
            };
            if let ServiceReply::Refused(reason) = &answer {
                tracing::warn!("a service was refused: {reason}");
            }
            call.reply(answer);
            fault?;
        }
        Ok(())
    }

    fn answer(
        &mut self,
        map: &mut Mapper,
        request: &ServiceRequest,
    ) -> Result<ServiceReply, EngineError> {
        let done = |what: &str, written: Result<(), String>| match written {
            Ok(()) => ServiceReply::Done(what.to_owned()),
            Err(reason) => ServiceReply::Refused(reason),
        };
        Ok(match request {
            ServiceRequest::Save(path) => done("the map was saved", self.save(map, path)?),
            ServiceRequest::Export(path) => {
                let snapshot = map.snapshot()?;
                let format = SplatFormat::of(path, SpzVersion::V3);
                let format = format.ok_or_else(|| file::unknown_ending(path));
                let written = format.and_then(|format| {
                    let written = save_map(MapFile::As(format, &snapshot.splats), path);
                    written.map_err(|e| e.to_string())
                });
                done("the splats were written", written)
            }
            ServiceRequest::Load(path) => match self.load(path) {
                Ok(()) => ServiceReply::Done("mapping goes on from the saved map".to_owned()),
                Err(reason) => ServiceReply::Refused(reason),
            },
            ServiceRequest::Render {
                world_from_cam,
                intrinsics,
            } => match map.render(world_from_cam, intrinsics)? {
                Some(image) => ServiceReply::Image(image),
                None => ServiceReply::Refused("there is no map yet".to_owned()),
            },
        })
    }

    /// The map that mapping is to go on from after a restart; empty for a fresh one.
    pub(crate) fn take_wanted(&mut self) -> String {
        std::mem::take(&mut self.wanted)
    }

    /// No restart from here on: the input has ended.
    pub(crate) fn at_end(mut self) -> Self {
        self.stop = None;
        self
    }

    /// What cannot be read is refused, and the present map goes on.
    fn load(&mut self, path: &Path) -> Result<(), String> {
        let Some(stop) = &self.stop else {
            return Err(
                "the input has ended; start a run on the saved map with --resume".to_owned(),
            );
        };
        let saved = checkpoint::read(path).map_err(|e| e.to_string())?;
        Tracker::in_saved(&saved.landmarks, &self.track)
            .map_err(|reason| format!("no camera could be found in that map: {reason}"))?;
        self.wanted = path.to_string_lossy().into_owned();
        stop.ask_restart();
        Ok(())
    }

    /// With landmarks, so that a later run finds its place.
    fn save(&mut self, map: &mut Mapper, path: &Path) -> Result<Result<(), String>, EngineError> {
        let mut landmarks = Vec::new();
        if map.has_all_images() {
            let mut tracker = Tracker::new(&self.track);
            tracker.update(&map.keyframe_views()?);
            landmarks = match tracker.saved() {
                Ok(landmarks) => landmarks,
                Err(reason) => return Ok(Err(reason)),
            };
        }
        // Keyframes of a saved map, and those on disk, only the tracker remembers.
        if landmarks.is_empty() {
            landmarks = self.landmarks().to_vec();
        }
        map.snapshot()?;
        let checkpoint = map.checkpoint(landmarks);
        let saved = save_map(MapFile::Checkpoint(&checkpoint), path);
        Ok(saved.map_err(|e| e.to_string()))
    }
}
