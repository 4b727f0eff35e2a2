//! What a run is made of, and what it leaves behind.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};

use crate::eval::report_json::QualityAt;
use crate::machine::probe;
use crate::node::engines::Engines;
use crate::node::requests::RequestHandler;
use crate::node::stop::Stop;
use crate::node::track_thread::TrackingSummary;
use crate::params::params::Params;
use splat_geometry::alignment::aligner::Aligner;
use splat_geometry::foundation::estimator::FoundationModel;
use splat_geometry::foundation::model::Model;
use splat_geometry::ground_truth::model::GroundTruthModel;
use splat_geometry::model::GeometryModel;
use splat_geometry::sfm::estimator::Sfm;
use splat_io::frame_source::{MetricInput, Source, SourceCounts};
use splat_ros::output::Output;
use splat_ros::publisher::Publisher;
use splat_ros::transport::Transport;
use splat_slam::mapper::mapper::Mapper;
use splat_types::load_shed::LoadShed;
use splat_types::snapshot::{KeyframePose, Scale, Snapshot};
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

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
    /// Where anything is to go out before the end.
    pub output: Option<Output>,
    pub engines: Engines,
}

impl std::fmt::Debug for Job {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Job(live: {}, {:?})", self.is_live, self.params)
    }
}

/// What a run is at.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Activity {
    /// Frames come, or are gone through.
    #[default]
    Mapping,
    /// Live: the last frame has come, and the map gets better for as long as `map.finish_secs` says.
    Finishing { secs: f64, of_secs: f64 },
    /// Views that were kept out of optimisation get their poses, with the splats frozen.
    HeldOutPoses { done: usize, of: usize },
    /// The map is written.
    Saving,
    /// What the map shows is compared with images.
    Quality { done: usize, of: usize },
}

/// How far a run is: for progress bars and logs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    pub activity: Activity,
    pub n_keyframes: usize,
    pub n_registered: usize,
    pub n_splats: usize,
    pub n_steps: u64,
    /// `None`: nobody knows when the frames end.
    pub steps_planned: Option<u64>,
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

/// Seconds from the selection of each keyframe.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct KeyframeLatency {
    /// What gave way for it.
    pub load_shed: LoadShed,
    pub to_pose_secs: Vec<f64>,
    /// To the first snapshot that has it.
    pub to_snapshot_secs: Vec<f64>,
}

/// What came of the input before it was tracked and mapped.
#[derive(Debug)]
pub struct InputSummary {
    pub counts: SourceCounts,
    /// Live: frames that made room for newer ones before selection.
    pub n_dropped: u64,
    /// Keyframes.
    pub n_selected: usize,
    /// Stamps of all frames that arrived, in order.
    pub frame_stamps: Vec<Stamp>,
    /// Ground truth of the keyframes, where the recording has it.
    pub truth: Vec<(Stamp, Rigid)>,
}

/// What a run leaves behind. Many fields: what each stage gathered.
pub struct Outcome {
    pub snapshot: Arc<Snapshot>,
    pub map: Mapper,
    pub input: InputSummary,
    /// Poses of all frames that the tracker saw.
    pub tracking: TrackingSummary,
    pub secs: StageSecs,
    pub latency: KeyframeLatency,
    /// At the steps that `eval.at_steps` names.
    pub quality_at: Vec<QualityAt>,
    /// Why keyframes are missing, in the geometry model's words.
    pub geometry_note: Option<String>,
    /// Times that the engine was lost.
    pub n_engine_faults: u64,
    /// The stage that failed, and how; what was gathered before is kept.
    pub error: Option<String>,
    /// Somebody asked for the end.
    pub was_stopped: bool,
    /// Stays up for late joiners until `linger` has closed it.
    pub publisher: Option<Arc<Publisher>>,
    pub(crate) request_handler: RequestHandler,
}

impl Outcome {
    /// Keyframes of this run, without those of a saved map.
    pub fn own_poses(&self) -> &[KeyframePose] {
        self.map.own(&self.snapshot.poses)
    }
}

impl Outcome {
    /// As it stands at the end.
    pub(crate) fn progress(&self) -> Progress {
        Progress {
            activity: Activity::Saving,
            n_keyframes: self.input.n_selected,
            n_registered: self.map.n_keyframes(),
            n_splats: self.map.n_splats(),
            n_steps: self.map.n_steps(),
            steps_planned: None,
            has_ended: true,
        }
    }
}

impl std::fmt::Debug for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "Outcome({} of {} keyframes, {:?})",
            self.snapshot.poses.len(),
            self.input.n_selected,
            self.error
        )
    }
}

/// The geometry model that the parameters name, and where its lengths come from.
pub(crate) fn model(
    params: &Params,
    source: &dyn Source,
) -> anyhow::Result<(Box<dyn GeometryModel>, Scale)> {
    let sfm = || Sfm::new(&params.sfm, &params.mvs, params.seed);
    let input = source.metric_input();
    match params.geometry.as_str() {
        "rgbd" if input != MetricInput::Depth => bail!(
            "--geometry rgbd: the source has no depth images; name their topic by source.depth_topic, or use --geometry sfm, which needs none"
        ),
        "stereo" if input != MetricInput::Stereo => bail!(
            "--geometry stereo: the source has no second camera; name its topic by source.second_image_topic (CameraInfo beside it, with the baseline in P, or /tf_static says where it is), or use --geometry sfm, which needs none"
        ),
        "auto" | "rgbd" if input == MetricInput::Depth => {
            tracing::info!(
                "geometry rgbd: poses, depth and the metre by colour and depth images; --geometry sfm uses colour alone"
            );
            Ok((Box::new(sfm()?.with_sensors()), Scale::UP_TO_SCALE))
        }
        "auto" | "stereo" if input == MetricInput::Stereo => {
            tracing::info!(
                "geometry stereo: poses, depth and the metre by both cameras; --geometry sfm uses the first alone"
            );
            Ok((Box::new(sfm()?.with_sensors()), Scale::UP_TO_SCALE))
        }
        "auto" | "sfm" => Ok((Box::new(sfm()?), Scale::UP_TO_SCALE)),
        "ground_truth" => {
            let known = GroundTruthModel::new(
                params.ground_truth.clone(),
                (&params.sfm, &params.mvs),
                source.truth_extent(),
                params.seed,
            )?;
            // Windows have units of their own, as a foundation model's have.
            let scale = if params.ground_truth.windows {
                Scale::UP_TO_SCALE
            } else {
                Scale::GIVEN
            };
            let mut known = known.in_windows(&params.align, &params.sfm)?;
            if params.train.epipolar_weight > 0.0 {
                known = known.with_matches(&params.sfm)?;
            }
            Ok((Box::new(known), scale))
        }
        name => match name.strip_prefix("onnx:") {
            Some(file) => {
                let network = Model::open(Path::new(file), &params.onnx)?;
                let aligner = Aligner::new(&params.align, &params.sfm, params.seed)?;
                let free = probe::free_bytes(network.provider());
                let foundation = FoundationModel::of(network, &params.onnx, aligner, free);
                Ok((Box::new(foundation), Scale::UP_TO_SCALE))
            }
            None => bail!(
                "{name:?} is no geometry; expected auto, sfm, rgbd, stereo, ground_truth or onnx:FILE"
            ),
        },
    }
}

/// Runs a closure on a named thread (at most 15 bytes, as Linux shows them).
pub(crate) fn spawn<T: Send + 'static>(
    name: &'static str,
    body: impl FnOnce() -> T + Send + 'static,
) -> anyhow::Result<std::thread::JoinHandle<T>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(body)
        .with_context(|| format!("cannot start thread {name}"))
}

/// The way out that the parameters ask for, if any, and over `more`.
pub fn output(params: &Params, more: Vec<Box<dyn Transport>>) -> anyhow::Result<Option<Output>> {
    let publish = &params.publish;
    if !(publish.zenoh || !more.is_empty() || !publish.record.is_empty()) {
        return Ok(None);
    }
    Ok(Some(Output::open(publish, more)?))
}

/// Keeps the way out up for late joiners and services, then closes it; Ctrl-C cuts the wait short.
pub fn linger(outcome: &mut Outcome, secs: f64, stop: &Stop) {
    let Some(publisher) = outcome.publisher.take() else {
        return;
    };
    let watch = Stopwatch::start();
    while watch.secs() < secs && !stop.is_asked() {
        // Whoever asked was reported; the files are written.
        outcome.request_handler.serve(&mut outcome.map).ok();
        std::thread::sleep(LINGER_TICK);
    }
    if let Err(e) = publisher.close() {
        tracing::warn!("the way out did not close cleanly: {e}");
    }
}
