//! The keyframes of the map -> what a tracker needs of them.

use std::sync::Arc;

use crate::frame::DepthMap;
use crate::geometry::uncertainty::Covariance;
use crate::map::SplatMap;
use crate::map::keyframes::Placed;
use crate::track::KeyframeView;

impl SplatMap {
    /// All keyframes as they stand at this moment, in order of id. Held-out ones come without depth: nothing else moves
    /// them along while the others are refined, so that they are none to go by.
    pub fn keyframe_views(&mut self) -> Vec<KeyframeView> {
        let map_poses = self.engine.poses();
        let focal_factor = self.engine.focal_factor();
        let unit = self.map_from_model(&map_poses).scale;
        let stated = self.stated_covariance();
        let no_depth = Arc::new(DepthMap::none());
        let view = |placed: &Placed| KeyframeView {
            keyframe: Arc::clone(&placed.keyframe),
            map_from_cam: map_poses[placed.view_ix].inverse(),
            intrinsics: placed.intrinsics.refocused(focal_factor),
            lens: placed.lens,
            // What came with a saved map, or back from disk, has its landmarks already.
            depth: Arc::clone(
                if placed.is_held_out || placed.home.is_past || placed.home.copy.is_some() {
                    &no_depth
                } else {
                    &placed.depth
                },
            ),
            covariance: placed.health.rescaled(unit).covariance.or(stated),
        };
        self.keyframes.placed.values().map(view).collect()
    }

    /// What the model says of all its poses alike.
    fn stated_covariance(&self) -> Option<Covariance> {
        let [turn, shift] = self.pose_error.map(f64::from);
        let variance = |axis: usize| if axis < 3 { shift * shift } else { turn * turn };
        let covariance = std::array::from_fn(|i| {
            std::array::from_fn(|j| if i == j { variance(i) } else { 0.0 })
        });
        (turn > 0.0 || shift > 0.0).then_some(covariance)
    }
}
