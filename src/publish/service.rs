//! Services of the node: a question as CDR -> its answer as CDR, whatever face it came by.
//!
//! What the map alone can do is asked of its thread and waited for, at most `PATIENCE`. Files are written to and read
//! from one folder only, and not at all where the parameters name none.

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::camera::Intrinsics;
use crate::pose::Rigid;
use crate::publish::archive::Archive;
use crate::publish::offered::Kind;
use crate::publish::wire::{MAX_MESSAGE_BYTES, SplatChunk, SplatManifest};
use crate::ros::standard::TriggerResponse;
use crate::ros::{self, CameraInfo, Header, Image, Pose};
use crate::splat::Rendering;

/// How long an asker waits for the map's thread, which may be at geometry of a large batch.
const PATIENCE: Duration = Duration::from_secs(30);
/// Questions that may wait for the map's thread.
const MAX_CALLS: usize = 8;
const MAX_PICTURE_PX: u32 = 2048;
/// Forms that `export` writes.
const EXPORTS: &[&str] = &["ply"];
/// Chunks of one answer: below the bound on messages at the largest chunk.
const MAX_CHUNKS: u32 = 3;

/// What is asked of the map's thread.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    Save(PathBuf),
    Load(PathBuf),
    Export(PathBuf),
    Render {
        splats_from_cam: Rigid,
        intrinsics: Intrinsics,
    },
}

/// What it says.
#[derive(Debug)]
pub enum Answer {
    Done(String),
    Refused(String),
    Picture(Rendering),
}

#[derive(Debug)]
pub struct Call {
    pub request: Request,
    answer: SyncSender<Answer>,
}

impl Call {
    pub fn reply(self, answer: Answer) {
        // Who lost patience misses the answer.
        self.answer.try_send(answer).ok();
    }
}

/// What services switch; the source looks at it with every frame.
#[derive(Debug, Default)]
pub struct Switches {
    pub is_paused: AtomicBool,
    /// Asks for a fresh map; taken back when that begins.
    pub wants_reset: AtomicBool,
}

/// Answers services.
#[derive(Debug)]
pub struct Desk {
    calls: SyncSender<Call>,
    archive: Arc<Archive>,
    switches: Arc<Switches>,
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

#[derive(Debug, Default, Serialize, Deserialize)]
struct RenderViewRequest {
    pose: Pose,
    camera: CameraInfo,
    with_depth: bool,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct RenderViewResponse {
    success: bool,
    message: String,
    image: Image,
    depth: Image,
}

impl Desk {
    /// The desk, and the end at which the map's thread takes calls.
    pub fn new(
        archive: Arc<Archive>,
        switches: Arc<Switches>,
        folder: &str,
    ) -> (Self, Receiver<Call>) {
        let (calls, taken) = sync_channel(MAX_CALLS);
        let desk = Self {
            calls,
            archive,
            switches,
            folder: (!folder.is_empty()).then(|| PathBuf::from(folder)),
        };
        (desk, taken)
    }

    /// CDR of the question -> CDR of the answer. Bad questions are answered, too. Waits; not for threads that must not.
    pub fn answer(&self, kind: Kind, question: &[u8]) -> Vec<u8> {
        match kind {
            Kind::SaveMap => self.file(question, &["splatmap"], Request::Save),
            Kind::LoadMap => self.file(question, &["splatmap"], Request::Load),
            Kind::Export => self.file(question, EXPORTS, Request::Export),
            Kind::Reset => self.trigger(|switches| {
                switches.wants_reset.store(true, Ordering::Relaxed);
                "the map is thrown away and begun again"
            }),
            Kind::Pause => self.trigger(|switches| {
                switches.is_paused.store(true, Ordering::Relaxed);
                "pictures are not looked at until resume"
            }),
            Kind::Resume => self.trigger(|switches| {
                switches.is_paused.store(false, Ordering::Relaxed);
                "pictures are looked at"
            }),
            Kind::GetSplats => self.get_splats(question),
            Kind::RenderView => self.render_view(question),
        }
    }

    fn trigger(&self, act: impl FnOnce(&Switches) -> &'static str) -> Vec<u8> {
        let message = act(&self.switches).to_owned();
        encoded(&TriggerResponse {
            success: true,
            message,
        })
    }

    fn ask(&self, request: Request) -> Answer {
        let (answer, answered) = sync_channel(1);
        match self.calls.try_send(Call { request, answer }) {
            Ok(()) => answered.recv_timeout(PATIENCE).unwrap_or_else(|_| {
                Answer::Refused(format!(
                    "the map had no time within {} s; ask again",
                    PATIENCE.as_secs()
                ))
            }),
            Err(TrySendError::Full(_)) => {
                Answer::Refused(format!("{MAX_CALLS} others are being served; ask again"))
            }
            Err(TrySendError::Disconnected(_)) => {
                Answer::Refused("the map has ended; start the node again".to_owned())
            }
        }
    }

    fn file(
        &self,
        question: &[u8],
        endings: &[&str],
        request: impl FnOnce(PathBuf) -> Request,
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
                    Answer::Done(message) => PathResponse {
                        success: true,
                        message,
                        path: path.to_string_lossy().into_owned(),
                    },
                    Answer::Refused(reason) => refused(reason),
                    Answer::Picture(_) => refused("a picture came instead of a file".to_owned()),
                },
            },
        };
        encoded(&response)
    }

    /// The path of a file in the folder of services.
    fn confined(&self, name: &str, endings: &[&str]) -> Result<PathBuf, String> {
        let folder = self.folder.as_ref().ok_or(
            "services may not touch files: start the node with --set publish.folder=FOLDER",
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
        let response = match (decoded::<GetSplatsRequest>(question), self.archive.map()) {
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
                let messages = self.archive.messages(&map);
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

    fn render_view(&self, question: &[u8]) -> Vec<u8> {
        let refused = |message: String| RenderViewResponse {
            message,
            ..RenderViewResponse::default()
        };
        let response = match decoded::<RenderViewRequest>(question) {
            Err(reason) => refused(reason),
            Ok(asked) => match view_of(&asked) {
                Err(reason) => refused(reason),
                Ok(request) => match self.ask(request) {
                    Answer::Picture(picture) => pictured(&picture, asked.with_depth),
                    Answer::Refused(reason) => refused(reason),
                    Answer::Done(_) => refused("no picture came".to_owned()),
                },
            },
        };
        encoded(&response)
    }
}

fn view_of(asked: &RenderViewRequest) -> Result<Request, String> {
    let camera = &asked.camera;
    let intrinsics = Intrinsics {
        width_px: camera.width,
        height_px: camera.height,
        fx: camera.k[0],
        fy: camera.k[4],
        // Outside, pixel centres are at integers.
        cx: camera.k[2] + 0.5,
        cy: camera.k[5] + 0.5,
    };
    let sides = [camera.width, camera.height];
    if sides
        .iter()
        .any(|side| !(1..=MAX_PICTURE_PX).contains(side))
    {
        return Err(format!(
            "a picture of {}x{} px, expected 1 to {MAX_PICTURE_PX} a side",
            camera.width, camera.height
        ));
    }
    if !intrinsics.is_plausible() {
        return Err(format!("camera.k = {:?} is no camera's", camera.k));
    }
    let splats_from_cam = asked
        .pose
        .to_rigid()
        .ok_or("the pose is not finite, or its quaternion has no length")?;
    Ok(Request::Render {
        splats_from_cam,
        intrinsics,
    })
}

fn pictured(picture: &Rendering, with_depth: bool) -> RenderViewResponse {
    let image = |encoding: &str, step: u32, data: Vec<u8>| Image {
        header: Header::default(),
        height: picture.height_px,
        width: picture.width_px,
        encoding: encoding.to_owned(),
        is_bigendian: 0,
        step,
        data,
    };
    let bytes = picture
        .rgb
        .iter()
        .map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8);
    let depth = |(depth, alpha): (&f32, &f32)| {
        let seen = if *alpha > 0.5 { *depth } else { f32::NAN };
        seen.to_le_bytes()
    };
    RenderViewResponse {
        success: true,
        message: String::new(),
        image: image("rgb8", 3 * picture.width_px, bytes.collect()),
        depth: if with_depth {
            let depths = picture.depth.iter().zip(&picture.alpha).flat_map(depth);
            image("32FC1", 4 * picture.width_px, depths.collect())
        } else {
            Image::default()
        },
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
