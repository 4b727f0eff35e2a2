//! Sparse views -> views with depth: each new keyframe is swept against those it shares landmarks with.

use super::report::{SparseBatch, SparseView};
use super::scene::Scene;
use crate::config::MvsParams;
use crate::frame::DepthMap;
use crate::geometry::mvs::MvsView;
use crate::geometry::mvs::neighbours::depth_range;
use crate::geometry::mvs::state::MvsState;
use crate::geometry::{GeometryBatch, View};

/// Keyframes that can serve as sources; about 1 MB each.
const MAX_HELD: usize = 96;

#[derive(Debug)]
pub(super) struct Dense {
    state: MvsState,
}

impl Dense {
    pub(super) fn new(params: &MvsParams) -> Self {
        Self { state: MvsState::new(params.clone(), MAX_HELD) }
    }

    /// Depth for all views of a batch, and the held keyframes moved to their revised poses.
    pub(super) fn densify(&mut self, scene: &Scene, sparse: SparseBatch) -> GeometryBatch {
        for (keyframe_id, _, pose) in &sparse.revised {
            if let Some(intrinsics) = scene.intrinsics_of(*keyframe_id) {
                self.state.revise(*keyframe_id, intrinsics, *pose);
            }
        }
        // All are held before any is swept: later keyframes are as good sources as earlier ones.
        for view in &sparse.views {
            if self.state.holds(view.keyframe_id) {
                self.state.revise(view.keyframe_id, view.intrinsics, view.batch_from_cam);
            } else if let Some(image) = scene.image_of(view.keyframe_id) {
                let mvs_view = MvsView { image, intrinsics: view.intrinsics, world_from_cam: view.batch_from_cam };
                self.state.add(view.keyframe_id, &mvs_view, 0.0, 0.0, &[]);
            }
        }
        for view in &sparse.views {
            let cam_from_batch = view.batch_from_cam.inverse();
            let depths: Vec<f64> =
                view.landmarks.iter().map(|l| cam_from_batch.transform_point(l.point_in_batch).z).collect();
            if let Some((near, far)) = depth_range(&depths) {
                let sources: Vec<u32> = view.neighbours.iter().map(|n| n.keyframe_id).collect();
                self.state.resweep(view.keyframe_id, near, far, &sources);
            }
        }
        let view = |view: SparseView| View {
            keyframe_id: view.keyframe_id,
            component: view.component,
            intrinsics: view.intrinsics,
            batch_from_cam: view.batch_from_cam,
            depth: self.state.depth_of(view.keyframe_id).unwrap_or_else(no_depth),
            health: view.health,
        };
        let views = sparse.views.into_iter().map(view).collect();
        GeometryBatch { batch_id: sparse.batch_id, views, revised: sparse.revised, note: sparse.note }
    }
}

fn no_depth() -> DepthMap {
    DepthMap { width_px: 1, height_px: 1, depth: vec![0.0], confidence: vec![0.0] }
}
