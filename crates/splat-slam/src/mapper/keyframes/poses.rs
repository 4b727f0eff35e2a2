//! Registered keyframes and the cameras of the engine -> poses as snapshots have them.

use crate::mapper::cameras::Cameras;
use crate::mapper::keyframes::store::KeyframeStore;
use splat_types::snapshot::KeyframePose;

/// In order of id.
pub(crate) fn keyframe_poses(keyframes: &KeyframeStore, cameras: &Cameras) -> Vec<KeyframePose> {
    keyframes
        .registered()
        .values()
        .map(|registered| KeyframePose {
            keyframe_id: registered.keyframe.id,
            stamp: registered.keyframe.frame.stamp,
            world_from_cam: cameras.cam_from_maps[registered.view_ix].inverse(),
            intrinsics: registered.intrinsics.refocused(cameras.focal_scale),
        })
        .collect()
}
