//! What a geometry model says of keyframes: cameras, depth and how far they can be trusted, in its own frame and scale.

use splat_types::camera::{CameraModel, Intrinsics};
use splat_types::covariance::{Covariance, worst_std};
use splat_types::depth::DepthMap;
use splat_types::load_shed::LoadShed;
use splat_types::snapshot::ScaleSource;
use splat_types::transform::Rigid;

/// How far a view can be trusted.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseQuality {
    /// Landmarks (or matches) that agree with the pose.
    pub n_inliers: u32,
    /// Median triangulation angle of those, in degrees; 0 where unknown.
    pub parallax_deg: f64,
    /// Median reprojection error in pixels of the working image; 0 where unknown.
    pub reprojection_px: f64,
    /// Of the pose, if the landmarks were exact; `None` where unknown.
    pub covariance: Option<Covariance>,
}

impl PoseQuality {
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
        let (place, turn) = worst_std(&self.covariance?);
        Some((place, turn.to_degrees()))
    }
}

/// One keyframe that the model registered.
#[derive(Debug, Clone)]
pub struct View {
    pub keyframe_id: u32,
    /// Views with equal numbers share one frame and scale; different numbers have no known relation.
    pub submap: u32,
    pub intrinsics: Intrinsics,
    /// Of the keyframe's image, where that is no pinhole's: whoever uses the image first undistorts it to
    /// `intrinsics` (`source::rectify`). May change with a later view of the same keyframe.
    pub lens: Option<CameraModel>,
    pub submap_from_cam: Rigid,
    /// In the unit of `submap_from_cam`. May be smaller than the image; same field of view.
    pub depth: DepthMap,
    pub health: PoseQuality,
}

/// What a model has learned since of a keyframe that it registered in an earlier batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseUpdate {
    pub keyframe_id: u32,
    pub submap: u32,
    pub intrinsics: Intrinsics,
    pub submap_from_cam: Rigid,
    /// In the unit of the pose, what was reported for its depth is so many times as long; 1 where only the pose moved.
    pub depth_factor: f64,
}

/// Standard deviation of poses that the model itself states; 0 where it states none and poses are taken for good.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseStd {
    pub rotation_rad: f64,
    /// In the unit of the poses.
    pub translation: f64,
}

/// Where a keyframe saw points that other keyframes saw too.
#[derive(Debug, Clone, PartialEq)]
pub struct Observations {
    pub keyframe_id: u32,
    pub landmarks: Vec<SeenLandmark>,
}

/// A landmark as one keyframe saw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenLandmark {
    /// The same for the same point in all keyframes.
    pub id: u32,
    /// In the keyframe's image, undistorted where its lens bends.
    pub pixel: [f32; 2],
    /// Along the camera's axis, in the unit of the pose that came with it.
    pub depth: f32,
}

/// Pixels at which two keyframes saw the same points, verified by one rigid motion.
#[derive(Debug, Clone, PartialEq)]
pub struct PairMatches {
    /// In rising order.
    pub keyframe_ids: [u32; 2],
    /// In the image of the first and of the second keyframe, undistorted where its lens bends.
    pub pixels: Vec<[[f32; 2]; 2]>,
}

/// What a model says of one batch. Keyframes that cannot be registered are absent, never guessed; a model that keeps
/// state may deliver them with a later batch, and may revise poses it gave before.
#[derive(Debug, Clone, Default)]
pub struct GeometryBatch {
    pub batch_id: u32,
    /// Newly registered keyframes (of this batch or left over from earlier ones) and the shared ones again.
    pub views: Vec<View>,
    /// Keyframes of earlier batches whose camera changed, in the same frame as `views`.
    pub revised: Vec<PoseUpdate>,
    /// How far off the poses of `views` may be.
    pub pose_error: PoseStd,
    /// Of models that track points through many keyframes; empty from others.
    pub observations: Vec<Observations>,
    /// Of models that match keyframes in pairs: those that were matched since the last batch.
    pub pair_matches: Vec<PairMatches>,
    /// A place was seen again since: `revised` brings both ends of the way together.
    pub is_loop: bool,
    /// Why keyframes are missing, one plain sentence, for status and errors.
    pub note: Option<String>,
    /// What makes the metre the unit of the poses; `None` where a model knows them up to one factor, or knows metres always.
    pub metric: Option<MetricUnit>,
    /// Live, since the start.
    pub load_shed: LoadShed,
}

/// A sensor that makes the metre the unit of a model's poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MetricUnit {
    pub source: ScaleSource,
    /// Standard deviation of all lengths in common, as a share of them.
    pub relative_std: f64,
}

impl GeometryBatch {
    /// Adds later updates: of views of this batch, which take it over, and of others.
    pub fn revise(&mut self, revised: impl IntoIterator<Item = PoseUpdate>) {
        for updates in revised {
            let id = updates.keyframe_id;
            if let Some(view) = self.views.iter_mut().find(|v| v.keyframe_id == id) {
                (view.submap_from_cam, view.intrinsics) =
                    (updates.submap_from_cam, updates.intrinsics);
                view.submap = updates.submap;
                view.depth.scale(updates.depth_factor);
            } else if let Some(old) = self.revised.iter_mut().find(|r| r.keyframe_id == id) {
                *old = PoseUpdate {
                    depth_factor: old.depth_factor * updates.depth_factor,
                    ..updates
                };
            } else {
                self.revised.push(updates);
            }
        }
    }
}
