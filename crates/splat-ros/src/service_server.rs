//! Services of the node: a question as CDR -> its answer as CDR, whatever transport it came by.
//!
//! What the map alone can do is asked of its thread and waited for, at most `PATIENCE`. Files are written to and read
//! from one folder only, and not at all where the parameters name none.

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::box_services::{self, Refused};
use crate::distances;
use crate::latched::LatchedStore;
use crate::render_view::{Frames, RenderViewRequest, RenderViewResponse};
use crate::shared_volume::SharedVolume;
use splat_msgs::map_messages::{MAX_MESSAGE_BYTES, SplatChunk, SplatManifest};
use splat_msgs::ros;
use splat_msgs::ros::standard::TriggerResponse;
use splat_msgs::services::Kind;
use splat_types::camera::Intrinsics;
use splat_types::rendering::Rendering;
use splat_types::snapshot::Snapshot;
use splat_types::transform::Rigid;

/// How long a client waits for the map's thread, which may be at geometry of a large batch.
const PATIENCE: Duration = Duration::from_secs(30);
/// Questions that may wait for the map's thread.
const MAX_CALLS: usize = 8;
/// Forms that `export` writes.
const EXPORTS: &[&str] = &["ply", "spz", "glb", "splat"];
/// Chunks of one answer: below the bound on messages at the largest chunk.
const MAX_CHUNKS: u32 = 3;

/// What is asked of the map's thread.
#[derive(Debug, Clone, PartialEq)]
pub enum ServiceRequest {
    Save(PathBuf),
    Load(PathBuf),
    Export(PathBuf),
    Render {
        world_from_cam: Rigid,
        intrinsics: Intrinsics,
    },
}

/// What it says.
#[derive(Debug)]
pub enum ServiceReply {
    Done(String),
    Refused(String),
    Image(Rendering),
}

#[derive(Debug)]
pub struct ServiceCall {
    pub request: ServiceRequest,
    answer: SyncSender<ServiceReply>,
}

impl ServiceCall {
    pub fn reply(self, answer: ServiceReply) {
        // Who lost patience misses the answer.
        self.answer.try_send(answer).ok();
    }
}

/// What services switch; the source looks at it with every frame.
#[derive(Debug, Default)]
pub struct Controls {
    pub is_paused: AtomicBool,
    /// Asks for a fresh map; taken back when that begins.
    pub wants_reset: AtomicBool,
}

/// Answers services.
#[derive(Debug)]
pub struct ServiceServer {
    calls: SyncSender<ServiceCall>,
    latched: Arc<LatchedStore>,
    controls: Arc<Controls>,
    frames: Frames,
    /// `None`: no files.
    folder: Option<PathBuf>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct PathRequest {
    path: String,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct PathResponse {
    success: bool,
    message: String,
    path: String,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct GetSplatsRequest {
    revision: u32,
    first_chunk: u32,
    max_chunks: u32,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct GetSplatsResponse {
    success: bool,
    message: String,
    manifest: SplatManifest,
    chunks: Vec<SplatChunk>,
}

impl ServiceServer {
    /// The service server, and the end at which the map's thread takes calls.
    pub fn new(
        latched: Arc<LatchedStore>,
        controls: Arc<Controls>,
        frames: Frames,
        folder: &str,
    ) -> (Self, Receiver<ServiceCall>) {
        let (calls, taken) = sync_channel(MAX_CALLS);
        let service_server = Self {
            calls,
            latched,
            controls,
            frames,
            folder: (!folder.is_empty()).then(|| PathBuf::from(folder)),
        };
        (service_server, taken)
    }

    /// CDR of the question -> CDR of the answer. Bad questions are answered, too. Waits; not for threads that must not.
    pub fn answer(&self, kind: Kind, question: &[u8]) -> Vec<u8> {
        match kind {
            Kind::SaveMap => self.file(question, &["splatmap"], ServiceRequest::Save),
            Kind::LoadMap => self.file(question, &["splatmap"], ServiceRequest::Load),
            Kind::Export => self.file(question, EXPORTS, ServiceRequest::Export),
            Kind::Reset => self.trigger(|controls| {
                controls.wants_reset.store(true, Ordering::Relaxed);
                "the map is thrown away and begun again"
            }),
            Kind::Pause => self.trigger(|controls| {
                controls.is_paused.store(true, Ordering::Relaxed);
                "images are not looked at until resume"
            }),
            Kind::Resume => self.trigger(|controls| {
                controls.is_paused.store(false, Ordering::Relaxed);
                "images are looked at"
            }),
            Kind::GetSplats => self.get_splats(question),
            Kind::RenderView => self.render_view(question),
            Kind::GetDistances => self.of_volume(question, |volume, _, asked| {
                distances::answer(volume, asked)
            }),
            Kind::GetDistanceBox => self.of_volume(question, |volume, _, asked| {
                box_services::distance_box(volume, asked)
            }),
            Kind::GetEllipsoids => self.of_volume(question, box_services::ellipsoids),
            Kind::GetMesh => self.of_volume(question, box_services::mesh),
        }
    }

    fn trigger(&self, act: impl FnOnce(&Controls) -> &'static str) -> Vec<u8> {
        let message = act(&self.controls).to_owned();
        encoded(&TriggerResponse {
            success: true,
            message,
        })
    }

    fn ask(&self, request: ServiceRequest) -> ServiceReply {
        let (answer, answered) = sync_channel(1);
        match self.calls.try_send(ServiceCall { request, answer }) {
            Ok(()) => answered.recv_timeout(PATIENCE).unwrap_or_else(|_| {
                ServiceReply::Refused(format!(
                    "the map had no time within {} s; ask again",
                    PATIENCE.as_secs()
                ))
            }),
            Err(TrySendError::Full(_)) => {
                ServiceReply::Refused(format!("{MAX_CALLS} others are being served; ask again"))
            }
            Err(TrySendError::Disconnected(_)) => {
                ServiceReply::Refused("the map has ended; start the node again".to_owned())
            }
        }
    }

    fn file(
        &self,
        question: &[u8],
        endings: &[&str],
        request: impl FnOnce(PathBuf) -> ServiceRequest,
    ) -> Vec<u8> {
        let refused = |message: String| PathResponse {
            message,
            ..PathResponse::default()
        };
        let response = match decoded::<PathRequest>(question) {
            Err(reason) => refused(reason),
            Ok(asked) => match self.confined(&asked.path, endings) {
                Err(reason) => refused(reason),
                Ok(path) => match self.ask(request(path.clone())) {
                    ServiceReply::Done(message) => PathResponse {
                        success: true,
                        message,
                        path: path.to_string_lossy().into_owned(),
                    },
                    ServiceReply::Refused(reason) => refused(reason),
                    ServiceReply::Image(_) => refused("an image came instead of a file".to_owned()),
                },
            },
        };
        encoded(&response)
    }

    /// The path of a file in the folder of services.
    fn confined(&self, name: &str, endings: &[&str]) -> Result<PathBuf, String> {
        let folder = self.folder.as_ref().ok_or(
            "services may not touch files: start the node with --set publish.map_directory=FOLDER",
        )?;
        let name = if name.is_empty() {
            "map.splatmap"
        } else {
            name
        };
        let inside = Path::new(name);
        let is_plain = inside
            .components()
            .all(|part| matches!(part, Component::Normal(_)));
        if !is_plain || name.len() > 255 {
            return Err(format!(
                "{name:?} leads out of the folder of services; name a file below it"
            ));
        }
        let ending = inside.extension().and_then(|e| e.to_str()).unwrap_or("");
        if !endings.contains(&ending) {
            return Err(format!(
                "{name:?} should end with .{}",
                endings.join(" or .")
            ));
        }
        std::fs::create_dir_all(folder)
            .map_err(|e| format!("cannot make the folder of services: {e}"))?;
        let fault = |e: std::io::Error| format!("{name:?} cannot be reached: {e}");
        let root = folder.canonicalize().map_err(fault)?;
        let path = root.join(inside);
        // A link may point anywhere: what counts is where the file's folder really is.
        let parent = path
            .parent()
            .unwrap_or(&root)
            .canonicalize()
            .map_err(fault)?;
        let is_link = path.symlink_metadata().is_ok_and(|m| m.is_symlink());
        if !parent.starts_with(&root) || is_link {
            return Err(format!(
                "{name:?} leads out of the folder of services by a link"
            ));
        }
        Ok(path)
    }

    fn get_splats(&self, question: &[u8]) -> Vec<u8> {
        let refused = |message: String| GetSplatsResponse {
            message,
            ..GetSplatsResponse::default()
        };
        let response = match (decoded::<GetSplatsRequest>(question), self.latched.map()) {
            (Err(reason), _) => refused(reason),
            (_, None) => refused("there is no map yet".to_owned()),
            (Ok(asked), Some(map))
                if asked.revision != 0 && asked.revision != map.snapshot.revision =>
            {
                refused(format!(
                    "revision {} is gone, the newest is {}; begin again with it",
                    asked.revision, map.snapshot.revision
                ))
            }
            (Ok(asked), Some(map)) => {
                let messages = self.latched.messages(&map);
                let n = asked.max_chunks.min(MAX_CHUNKS) as usize;
                GetSplatsResponse {
                    success: true,
                    message: String::new(),
                    manifest: messages.manifest(),
                    chunks: messages
                        .chunks_from(asked.first_chunk as usize, n)
                        .collect(),
                }
            }
        };
        encoded(&response)
    }

    /// What the volume and the published map say to a question.
    fn of_volume<Q: for<'a> Deserialize<'a>, R: Refused>(
        &self,
        question: &[u8],
        answer: impl FnOnce(Option<&SharedVolume>, Option<&Snapshot>, &Q) -> Result<R, String>,
    ) -> Vec<u8> {
        let (volume, map) = (self.latched.volume(), self.latched.map());
        let snapshot = map.as_ref().map(|map| &*map.snapshot);
        let asked = decoded::<Q>(question);
        let response = asked.and_then(|asked| answer(volume.as_deref(), snapshot, &asked));
        encoded(&response.unwrap_or_else(R::refused))
    }

    fn render_view(&self, question: &[u8]) -> Vec<u8> {
        let asked = decoded::<RenderViewRequest>(question);
        let view = asked.and_then(|asked| {
            let view = self.frames.view(&asked)?;
            let request = ServiceRequest::Render {
                world_from_cam: view.world_from_cam,
                intrinsics: view.intrinsics,
            };
            match self.ask(request) {
                ServiceReply::Image(rendering) => Ok(view.response(&rendering)),
                ServiceReply::Refused(reason) => Err(reason),
                ServiceReply::Done(_) => Err("no image came".to_owned()),
            }
        });
        encoded(&view.unwrap_or_else(RenderViewResponse::refused))
    }
}

fn decoded<T: for<'a> Deserialize<'a>>(question: &[u8]) -> Result<T, String> {
    if question.len() > MAX_MESSAGE_BYTES {
        return Err(format!("a question of {} bytes", question.len()));
    }
    ros::decode_plain(question).map_err(|e| format!("the question does not decode: {e}"))
}

/// Our own answers encode.
fn encoded<T: Serialize>(answer: &T) -> Vec<u8> {
    ros::encode_plain(answer).unwrap_or_else(|e| {
        tracing::warn!("an answer was lost: {e}");
        vec![0, 1, 0, 0]
    })
}
