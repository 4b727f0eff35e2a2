//! The outcome of a run -> its map from above, for the report.

use crate::formats::planner_map;
use crate::node::grid_thread::keyframes_of;
use crate::node::job::Outcome;
use crate::report::top_view::TopView;
use splat_ros::odometry::beginning_at;
use splat_slam::track::landmarks::KeyframeView;
use splat_volume::params::GridParams;

/// Keyframes that are fused, five milliseconds each; of a run that was stopped, whose files are waited for.
const MAX_VIEWS: usize = 400;
const MAX_STOPPED_VIEWS: usize = 60;
/// Where the scale is unknown, half of all that was seen is taken to be nearer, metres.
const ASSUMED_DEPTH: f64 = 2.5;

/// The map as planners see it; `None` where no ground was seen. A stopped run has little time: fewer keyframes.
pub(crate) fn top_view(outcome: &mut Outcome, params: &GridParams) -> Option<TopView> {
    // A fault of the engine leaves the poses that were last read.
    let views = outcome.map.keyframe_views();
    let views = views.unwrap_or_else(|_| outcome.map.last_keyframe_views());
    let max = if outcome.was_stopped {
        MAX_STOPPED_VIEWS
    } else {
        MAX_VIEWS
    };
    let every = views.len().div_ceil(max).max(1);
    let metres = outcome.snapshot.scale.metres_per_unit;
    // Without a scale, one that makes rooms of rooms.
    let guess = || {
        let mut depths: Vec<f32> = views.iter().filter_map(|v| v.depth.median()).collect();
        depths.sort_by(f32::total_cmp);
        let middle = depths.get(depths.len() / 2)?;
        Some(ASSUMED_DEPTH / f64::from(*middle))
    };
    let first = views.first()?.world_from_cam;
    let frame = outcome.map.map_frame();
    let frame = frame.unwrap_or_else(|| beginning_at(first));
    let map_from_world = frame.map_from_world(metres.or_else(guess)?);
    let keyframes = keyframes_of(views.iter().step_by(every), &map_from_world);
    let mut volume = planner_map::fused(&keyframes, params);
    let level = volume.level_from_map();
    let place = |view: &KeyframeView| {
        let place = map_from_world.transform_point(view.world_from_cam.translation);
        (level * place).truncate()
    };
    Some(TopView {
        grid: planner_map::grid_of(&mut volume).ok()?,
        path: views.iter().map(place).collect(),
        is_metric: metres.is_some(),
    })
}
