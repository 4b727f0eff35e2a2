//! The node: stages on threads with bounded queues between them, or one after the other in sequence.
//!
//! The end of the input is the only way to end: each stage ends when its queue does. Ctrl-C tells the source alone.

pub mod autosave;
mod fitting;
mod geometry_stage;
pub mod localise;
mod opening;
mod outward;
mod pace;
pub mod pipeline;
pub mod ros2;
pub mod run_dir;
mod source_stage;
mod stages;
mod threads;
pub mod track_stage;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};

use crate::clock::{Stamp, Stopwatch};
use crate::config::{Backend, Params};
use crate::geometry::GeometryModel;
use crate::geometry::align::Aligner;
use crate::geometry::known::Known;
use crate::geometry::onnx::Foundation;
use crate::geometry::onnx::model::Model;
use crate::geometry::sfm::Sfm;
use crate::gpu::device::Wanted;
use crate::map::SplatMap;
use crate::map::snapshot::{KeyframePose, Scale, Snapshot};
use crate::node::outward::Clerk;
use crate::node::track_stage::Tracking;
use crate::pose::Rigid;
use crate::publish::face::Face;
use crate::publish::outbox::Outbox;
use crate::source::{Source, SourceCounts};
use crate::splat::Engine;
use crate::splat::cpu::CpuEngine;
use crate::splat::wgpu::WgpuEngine;

/// How often a lingering node looks for Ctrl-C.
const LINGER_TICK: Duration = Duration::from_millis(50);

/// What a run is made of.
pub struct Job {
    pub source: Box<dyn Source>,
    pub params: Params,
    /// A live source drops frames rather than wait, and the map is optimised as long as frames come.
    pub is_live: bool,
    pub stop: Stop,
    /// Run directory: autosaves go there, and what memory has no room for.
    pub out: Option<PathBuf>,
    /// The way out, where anything is to go out before the end.
    pub outbox: Option<Arc<Outbox>>,
}

impl std::fmt::Debug for Job {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Job(live: {}, {:?})", self.is_live, self.params)
    }
}

/// Asks the source to end; everything behind it then ends in order, without the final steps.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    is_asked: Arc<AtomicBool>,
    is_restarting: Arc<AtomicBool>,
}

impl Stop {
    pub fn ask(&self) {
        self.is_asked.store(true, Ordering::Relaxed);
    }

    /// For sources, which know no nodes.
    pub fn flag(&self) -> &Arc<AtomicBool> {
        &self.is_asked
    }

    /// Ends this map for a fresh one from the same source.
    fn ask_restart(&self) {
        self.is_restarting.store(true, Ordering::Relaxed);
    }

    /// Whether a fresh map is to begin; forgets it.
    fn takes_restart(&self) -> bool {
        self.is_restarting.swap(false, Ordering::Relaxed) && !self.is_asked()
    }

    pub fn is_asked(&self) -> bool {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        is_set(&self.is_asked) || is_set(&self.is_restarting)
    }
}

/// Seconds since a stop was asked for, as far as who waits for it has looked.
#[derive(Debug, Default)]
struct Grace {
    stop: Stop,
    since: Option<Stopwatch>,
}

impl Grace {
    fn new(stop: Stop) -> Self {
        Self { stop, since: None }
    }

    /// Whether a stop was asked for more than so many seconds ago. The first look after a stop counts as its moment.
    fn is_over(&mut self, secs: f64) -> bool {
        if self.since.is_none() && self.stop.is_asked() {
            self.since = Some(Stopwatch::start());
        }
        self.since.is_some_and(|watch| watch.secs() > secs)
    }
}

/// How far a run is: for progress bars and logs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    pub n_keyframes: usize,
    pub n_placed: usize,
    pub n_splats: usize,
    pub n_steps: u64,
    pub steps_planned: u64,
    /// The map changes no more.
    pub has_ended: bool,
}

/// Wall seconds, summed over the run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageSecs {
    pub wall: f64,
    pub decode: f64,
    pub geometry: f64,
    pub optimise: f64,
    pub track: f64,
}

/// What a run leaves behind.
pub struct Outcome {
    pub snapshot: Arc<Snapshot>,
    pub map: SplatMap,
    pub counts: SourceCounts,
    pub n_dropped: u64,
    pub n_selected: usize,
    /// Stamps of all frames that arrived, in order.
    pub frame_stamps: Vec<Stamp>,
    /// Poses of all frames that the tracker saw.
    pub tracking: Tracking,
    /// Ground truth of the keyframes, where the recording has it.
    pub truth: Vec<(Stamp, Rigid)>,
    pub secs: StageSecs,
    /// Seconds from the selection of a keyframe to its pose, and to the first snapshot that has it.
    pub keyframe_to_pose_secs: Vec<f64>,
    pub keyframe_to_snapshot_secs: Vec<f64>,
    /// Why keyframes are missing, in the geometry model's words.
    pub geometry_note: Option<String>,
    /// The stage that failed, and how; what was gathered before is kept.
    pub error: Option<String>,
    /// Somebody asked for the end.
    pub was_stopped: bool,
    /// Stays up for late joiners until `linger` has closed it.
    pub outbox: Option<Arc<Outbox>>,
    clerk: Clerk,
}

impl Outcome {
    /// Keyframes of this run, without those of a saved map.
    pub fn own_poses(&self) -> &[KeyframePose] {
        self.map.own(&self.snapshot.poses)
    }
}

impl std::fmt::Debug for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "Outcome({} of {} keyframes, {:?})",
            self.snapshot.poses.len(),
            self.n_selected,
            self.error
        )
    }
}

/// The geometry model that the parameters name, and where its lengths come from.
fn model(
    params: &Params,
    truth_extent: Option<f64>,
) -> anyhow::Result<(Box<dyn GeometryModel>, Scale)> {
    match params.geometry.as_str() {
        "sfm" => Ok((
            Box::new(Sfm::new(&params.sfm, &params.mvs, params.seed)?),
            Scale::UP_TO_SCALE,
        )),
        "known" => {
            let known = Known::new(
                params.known.clone(),
                (&params.sfm, &params.mvs),
                truth_extent,
                params.seed,
            )?;
            // Windows have units of their own, as a foundation model's have.
            let scale = if params.known.windows {
                Scale::UP_TO_SCALE
            } else {
                Scale::GIVEN
            };
            let known = known.in_windows(&params.align, &params.sfm)?;
            Ok((Box::new(known), scale))
        }
        name => match name.strip_prefix("onnx:") {
            Some(file) => {
                let network = Model::open(Path::new(file), &params.onnx)?;
                let aligner = Aligner::new(&params.align, &params.sfm, params.seed)?;
                let foundation = Foundation::of(network, &params.onnx, aligner);
                Ok((Box::new(foundation), Scale::UP_TO_SCALE))
            }
            None => bail!("{name:?} is no geometry; expected sfm, known or onnx:FILE"),
        },
    }
}

/// The best engine that the parameters allow.
pub fn engine(backend: Backend, deterministic: bool) -> anyhow::Result<Box<dyn Engine>> {
    let wgpu = |any_kind| {
        let wanted = Wanted {
            any_kind,
            subgroups: true,
            float_atomics: !deterministic,
        };
        WgpuEngine::new(wanted)
    };
    match backend {
        Backend::Cpu => Ok(Box::new(CpuEngine::new())),
        Backend::Wgpu => Ok(Box::new(wgpu(true)?)),
        // Software Vulkan is slower than the native engine, so only hardware will do.
        Backend::Auto => Ok(match wgpu(false) {
            Ok(engine) => Box::new(engine),
            Err(error) => {
                tracing::info!("mapping on the CPU: {error}");
                Box::new(CpuEngine::new())
            }
        }),
    }
}

/// Runs a closure on a named thread (at most 15 bytes, as Linux shows them).
fn spawn<T: Send + 'static>(
    name: &'static str,
    body: impl FnOnce() -> T + Send + 'static,
) -> anyhow::Result<std::thread::JoinHandle<T>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(body)
        .with_context(|| format!("cannot start thread {name}"))
}

/// The way out that the parameters ask for, if any, and over `face`.
pub fn outbox(params: &Params, face: Option<Box<dyn Face>>) -> anyhow::Result<Option<Arc<Outbox>>> {
    let (publish, has_face) = (&params.publish, face.is_some());
    if !(publish.zenoh || has_face || !publish.record.is_empty()) {
        return Ok(None);
    }
    let outbox = Outbox::open(publish)?;
    Ok(Some(Arc::new(match face {
        Some(face) => outbox.with_face(face),
        None => outbox,
    })))
}

/// Keeps the way out up for late joiners and services, then closes it; Ctrl-C cuts the wait short.
pub fn linger(outcome: &mut Outcome, secs: f64, stop: &Stop) {
    let Some(outbox) = outcome.outbox.take() else {
        return;
    };
    let watch = Stopwatch::start();
    while watch.secs() < secs && !stop.is_asked() {
        outcome.clerk.serve(&mut outcome.map);
        std::thread::sleep(LINGER_TICK);
    }
    if let Err(e) = outbox.close() {
        tracing::warn!("the way out did not close cleanly: {e}");
    }
}
