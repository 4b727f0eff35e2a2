//! All parameters, composed of those that each module owns.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::eval::params::EvalParams;
use crate::params::engine_params::EngineParams;
use splat_geometry::alignment::params::AlignParams;
use splat_geometry::foundation::params::OnnxParams;
use splat_geometry::ground_truth::params::GroundTruthParams;
use splat_geometry::mvs::params::MvsParams;
use splat_geometry::sfm::params::SfmParams;
use splat_gpu::backend::Backend;
use splat_io::params::{RecordParams, SourceParams};
use splat_ros::params::PublishParams;
use splat_ros::ros2::params::Ros2Params;
use splat_slam::mapper::metric_scale_params::ScaleParams;
use splat_slam::mapper::params::{DensifyParams, MapParams, MapperParams, McmcParams, TrainParams};
use splat_slam::select::params::SelectParams;
use splat_slam::track::params::TrackParams;
use splat_volume::params::GridParams;

/// All parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Everything random follows from it.
    #[schemars(range(min = 0, max = 4294967295_u64))]
    pub seed: u64,
    /// Engine that optimises the splats; auto takes the fastest one available.
    pub backend: Backend,
    /// The same input gives the same map on the same adapter; false lets wgpu add floats in any order, where the
    /// adapter can.
    pub deterministic: bool,
    /// sfm (colour images alone), rgbd (depth images, too), stereo (a pair of cameras), onnx:FILE (a network as docs/MODELS.md describes it), or
    /// ground_truth (recorded poses, and depth by stereo where none is recorded, plus the noise under ground_truth.*);
    /// auto takes rgbd or stereo where the source has that, else sfm.
    pub geometry: String,
    /// One thread, stage after stage, for tests and bisecting; the same map as with threads.
    pub sequential: bool,
    /// With ROS 2, time comes from /clock.
    pub use_sim_time: bool,
    /// Engine.
    pub engine: EngineParams,
    /// Sources and cameras.
    pub source: SourceParams,
    /// Recordings.
    pub record: RecordParams,
    /// Keyframe selection.
    pub select: SelectParams,
    /// Noise on ground truth.
    pub ground_truth: GroundTruthParams,
    /// Structure from motion.
    pub sfm: SfmParams,
    /// Multi-view stereo.
    pub mvs: MvsParams,
    /// Alignment of windows.
    pub align: AlignParams,
    /// Foundation models.
    pub onnx: OnnxParams,
    /// Tracker.
    pub track: TrackParams,
    /// Map.
    pub map: MapParams,
    /// Optimisation.
    pub train: TrainParams,
    /// 3DGS-MCMC.
    pub mcmc: McmcParams,
    /// Densification of 3DGS.
    pub densify: DensifyParams,
    /// Metric scale.
    pub scale: ScaleParams,
    /// Evaluation.
    pub eval: EvalParams,
    /// Publishing.
    pub publish: PublishParams,
    /// Grid for planners.
    pub grid: GridParams,
    /// ROS 2.
    pub ros2: Ros2Params,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            seed: 0,
            backend: Backend::Auto,
            deterministic: true,
            geometry: "auto".to_owned(),
            sequential: false,
            use_sim_time: false,
            engine: EngineParams::default(),
            source: SourceParams::default(),
            record: RecordParams::default(),
            select: SelectParams::default(),
            ground_truth: GroundTruthParams::default(),
            sfm: SfmParams::default(),
            mvs: MvsParams::default(),
            align: AlignParams::default(),
            onnx: OnnxParams::default(),
            track: TrackParams::default(),
            map: MapParams::default(),
            train: TrainParams::default(),
            mcmc: McmcParams::default(),
            densify: DensifyParams::default(),
            scale: ScaleParams::default(),
            eval: EvalParams::default(),
            publish: PublishParams::default(),
            grid: GridParams::default(),
            ros2: Ros2Params::default(),
        }
    }
}

impl Params {
    /// The part that the map needs.
    pub fn mapper(&self) -> MapperParams {
        MapperParams {
            map: self.map.clone(),
            train: self.train.clone(),
            mcmc: self.mcmc.clone(),
            densify: self.densify.clone(),
            held_out: self.eval.held_out.clone(),
        }
    }
}
