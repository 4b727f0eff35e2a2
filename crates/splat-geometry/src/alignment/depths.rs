//! The network's depth at features, and the points that it puts them at.

use glam::DVec3;

use crate::alignment::matched::Matched;
use crate::alignment::tracks::Track;

/// What depth each feature of each view has; `None` where the network gave none.
pub type Depths = Vec<Vec<Option<f64>>>;

/// Mean of where the depth of each observation puts the point; `None` without any.
pub(crate) fn by_depth(matched: &Matched, track: &Track, depths: &Depths) -> Option<DVec3> {
    let registered: Vec<DVec3> = track
        .iter()
        .filter_map(|&(view, feature)| {
            let aligned_view = &matched.views[view];
            let in_cam =
                aligned_view.lens.ray_in_cam(aligned_view.pixels[feature]) * depths[view][feature]?;
            Some(
                aligned_view
                    .cam_from_submap
                    .inverse()
                    .transform_point(in_cam),
            )
        })
        .collect();
    (!registered.is_empty()).then(|| registered.iter().sum::<DVec3>() / registered.len() as f64)
}
