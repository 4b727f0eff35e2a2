//! A batch of keyframes -> cameras, depth and confidence, in the model's own frame and scale.

pub mod align;
pub mod bundle;
pub mod features;
pub mod focal;
pub mod known;
pub mod matching;
pub mod mvs;
pub mod onnx;
pub mod pnp;
pub mod pose_graph;
pub mod scale_space;
pub mod seen_again;
pub mod sfm;
pub mod triangulate;
pub mod two_view;
pub mod umeyama;
pub mod uncertainty;

use crate::camera::{Intrinsics, Lens};
use crate::frame::{Batch, DepthMap};
use crate::geometry::uncertainty::Covariance;
use crate::gpu::GpuError;
use crate::pose::Rigid;

/// How far a view can be trusted.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Health {
    /// Landmarks (or matches) that agree with the pose.
    pub n_inliers: u32,
    /// Median triangulation angle of those, in degrees; 0 where unknown.
    pub parallax_deg: f64,
    /// Median reprojection error in pixels of the working picture; 0 where unknown.
    pub reprojection_px: f64,
    /// Of the pose, if the landmarks were exact; `None` where unknown.
    pub covariance: Option<Covariance>,
}

impl Health {
    /// In another unit of length, `factor` of which make one of the old.
    pub fn rescaled(&self, factor: f64) -> Self {
        let unit = |axis: usize| if axis < 3 { factor } else { 1.0 };
        let covariance = self.covariance.map(|old| {
            std::array::from_fn(|i| std::array::from_fn(|j| old[i][j] * unit(i) * unit(j)))
        });
        Self {
            covariance,
            ..*self
        }
    }

    /// Standard deviations of the pose along and about its least certain axes: (unit of the poses, degrees).
    pub fn std(&self) -> Option<(f64, f64)> {
        let covariance = self.covariance?;
        let worst = |axes: std::ops::Range<usize>| {
            let variances = axes.map(|i| covariance[i][i]);
            variances.fold(0.0, f64::max).sqrt()
        };
        Some((worst(0..3), worst(3..6).to_degrees()))
    }
}

/// One keyframe that the model placed.
#[derive(Debug, Clone)]
pub struct View {
    pub keyframe_id: u32,
    /// Views with equal numbers share one frame and scale; different numbers have no known relation.
    pub component: u32,
    pub intrinsics: Intrinsics,
    /// Of the keyframe's picture, where that is no pinhole's: whoever uses the picture first straightens it to
    /// `intrinsics` (`source::rectify`). May change with a later view of the same keyframe.
    pub lens: Option<Lens>,
    pub batch_from_cam: Rigid,
    /// In the unit of `batch_from_cam`. May be smaller than the picture; same field of view.
    pub depth: DepthMap,
    pub health: Health,
}

/// What a model has learned since of a keyframe that it placed in an earlier batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Revision {
    pub keyframe_id: u32,
    pub component: u32,
    pub intrinsics: Intrinsics,
    pub batch_from_cam: Rigid,
    /// In the unit of the pose, what was told of its depth is so many times as long; 1 where only the pose moved.
    pub depth_factor: f64,
}

/// Standard deviation of poses that the model itself states; 0 where it states none and poses are taken for good.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseError {
    pub rotation_rad: f64,
    /// In the unit of the poses.
    pub translation: f64,
}

/// Where a keyframe saw points that other keyframes saw too.
#[derive(Debug, Clone, PartialEq)]
pub struct Sightings {
    pub keyframe_id: u32,
    /// (number of the point, the same in all keyframes; pixel of the keyframe's picture).
    pub landmarks: Vec<(u32, [f32; 2])>,
}

/// What a model says of one batch. Keyframes that cannot be placed are absent, never guessed; a model that keeps
/// state may deliver them with a later batch, and may revise poses it gave before.
#[derive(Debug, Clone, Default)]
pub struct GeometryBatch {
    pub batch_id: u32,
    /// Newly placed keyframes (of this batch or left over from earlier ones) and the shared ones again.
    pub views: Vec<View>,
    /// Keyframes of earlier batches whose camera changed, in the same frame as `views`.
    pub revised: Vec<Revision>,
    /// How far off the poses of `views` may be.
    pub pose_error: PoseError,
    /// Of models that match points; empty from others.
    pub sightings: Vec<Sightings>,
    /// A place was seen again since: `revised` brings both ends of the way together.
    pub is_loop: bool,
    /// Why keyframes are missing, one plain sentence, for status and errors.
    pub note: Option<String>,
}

impl GeometryBatch {
    /// Adds later news: of views of this batch, which take it over, and of others.
    pub fn revise(&mut self, revised: impl IntoIterator<Item = Revision>) {
        for news in revised {
            let id = news.keyframe_id;
            if let Some(view) = self.views.iter_mut().find(|v| v.keyframe_id == id) {
                (view.batch_from_cam, view.intrinsics) = (news.batch_from_cam, news.intrinsics);
                view.component = news.component;
                view.depth.scale(news.depth_factor);
            } else if let Some(old) = self.revised.iter_mut().find(|r| r.keyframe_id == id) {
                *old = Revision {
                    depth_factor: old.depth_factor * news.depth_factor,
                    ..news
                };
            } else {
                self.revised.push(news);
            }
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum GeometryError {
    #[error("{model} needs {needs} for keyframe {keyframe_id}, found none; {way_out}")]
    Missing {
        model: &'static str,
        needs: &'static str,
        keyframe_id: u32,
        way_out: &'static str,
    },
    #[error(
        "known.translation_noise_extent and known.drift_extent are shares of the distance between the outermost true positions, which this source does not know beforehand; use known.translation_noise"
    )]
    NoExtent,
    #[error(
        "mvs.backend is wgpu, so that depth is matched on a GPU, and none will do; mvs.backend=cpu needs none: {0}"
    )]
    NoGpu(#[from] GpuError),
    #[error("{name:?} is no geometry; expected sfm, known or onnx:FILE")]
    UnknownModel { name: String },
    #[error(transparent)]
    Features(#[from] features::FeaturesError),
    #[error(transparent)]
    Model(#[from] onnx::ModelError),
}

/// Estimates cameras and depth. One thread owns it; calls come in order of batches.
pub trait GeometryModel: Send {
    fn infer(&mut self, batch: &Batch) -> Result<GeometryBatch, GeometryError>;

    /// Called once after the last batch: whatever can still be placed or improved.
    fn finish(&mut self) -> Result<GeometryBatch, GeometryError>;

    /// Live, instead of `infer`: poses of a batch without depth, where they are known long before it is.
    fn poses(&mut self, _batch: &Batch) -> Option<GeometryBatch> {
        None
    }

    /// Depth of one keyframe whose pose `poses` told; `None` when it is known of all.
    fn depth(&mut self) -> Option<GeometryBatch> {
        None
    }

    /// Keyframes that `depth` has still to tell of for the first time.
    fn n_without_depth(&self) -> usize {
        0
    }

    /// Whether it answers a batch of one new keyframe as well as a full one, once it has placed some.
    fn takes_small_batches(&self) -> bool {
        false
    }
}
