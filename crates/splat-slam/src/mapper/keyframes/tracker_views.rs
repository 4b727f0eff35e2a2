//! The keyframes of the map -> what a tracker needs of them.

use std::sync::Arc;

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::track::landmarks::{KeyframeView, TriangulatedLandmarks};
use splat_types::covariance::Covariance;
use splat_types::depth::DepthMap;

/// All keyframes as they stand with these cameras, in order of id. Held-out ones come without depth: nothing else moves
/// them along while the others are refined, so that they are none to go by.
pub(crate) fn views_of(keyframes: &KeyframeStore, cameras: &Cameras) -> Vec<KeyframeView> {
    let map_poses = &cameras.cam_from_maps;
    let unit = keyframes.world_from_submap(map_poses).scale;
    let stated = stated_covariance(keyframes.pose_error());
    let no_depth = Arc::new(DepthMap::none());
    let view = |registered: &RegisteredKeyframe| KeyframeView {
        keyframe: Arc::clone(&registered.keyframe),
        world_from_cam: map_poses[registered.view_ix].inverse(),
        intrinsics: registered.intrinsics.refocused(cameras.focal_scale),
        lens: registered.lens,
        // What came with a saved map, or back from disk, has its landmarks already.
        depth: Arc::clone(
            if registered.is_held_out || registered.home.is_prior || registered.home.copy.is_some()
            {
                &no_depth
            } else {
                &registered.depth
            },
        ),
        landmarks: if registered.is_held_out {
            TriangulatedLandmarks::none()
        } else {
            registered.landmarks.clone()
        },
        covariance: registered.health.rescaled(unit).covariance.or(stated),
    };
    keyframes.registered().values().map(view).collect()
}

/// What the model says of all its poses alike.
fn stated_covariance(pose_error: [f32; 2]) -> Option<Covariance> {
    let [turn, shift] = pose_error.map(f64::from);
    let variance = |axis: usize| if axis < 3 { shift * shift } else { turn * turn };
    let covariance =
        std::array::from_fn(|i| std::array::from_fn(|j| if i == j { variance(i) } else { 0.0 }));
    (turn > 0.0 || shift > 0.0).then_some(covariance)
}
