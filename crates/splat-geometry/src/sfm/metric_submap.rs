//! Measured depth of landmarks -> the metre as the unit of a submap, and whether a view's depth is to be believed.

use crate::answer::MetricUnit;
use crate::sfm::reconstruction::{NONE, Reconstruction};
use crate::stats::median;
use splat_types::transform::{Rigid, Similarity};

/// Measured features that give a submap its unit, and the largest spread of their ratios, as a share.
const MIN_RATIOS: usize = 50;
const MAX_SPREAD: f64 = 0.1;
/// A view's measured depth that is off by more, in the median, than its neighbours' is not believed; and the features that this
/// takes.
const MAX_OFF: f64 = 0.05;
const MIN_COMPARED: usize = 30;

/// Gives a submap the metre as its unit, by the measured depth of its landmarks, if there is enough of it that agrees.
pub(crate) fn make_metric(scene: &mut Reconstruction, submap: u32) {
    let own = &scene.submaps[submap as usize];
    if own.is_metric {
        return;
    }
    let views = own.views.clone();
    let mut logs: Vec<f64> = views.iter().flat_map(|v| log_ratios(scene, *v)).collect();
    let Some(log) = median(&mut logs).filter(|_| logs.len() >= MIN_RATIOS) else {
        return;
    };
    let mut off: Vec<f64> = logs.iter().map(|l| (l - log).abs()).collect();
    if median(&mut off).is_none_or(|spread| spread > MAX_SPREAD) {
        return;
    }
    let scale = log.exp();
    tracing::debug!(submap, scale, "the submap is in metres by measured depth");
    scene.transform(
        submap,
        &Similarity {
            scale,
            ..Similarity::IDENTITY
        },
    );
    scene.submaps[submap as usize].is_metric = true;
    scene.n_rebuilt += 1;
}

/// The unit of the largest submap; `None` where nothing was measured.
pub(crate) fn metric_unit(scene: &Reconstruction) -> Option<MetricUnit> {
    let largest = scene.submaps.iter().max_by_key(|submap| submap.views.len());
    let views = &largest.filter(|submap| submap.is_metric)?.views;
    let mut measured = views
        .iter()
        .filter_map(|v| scene.views[*v].measured.as_ref());
    Some(measured.next()?.unit())
}

/// Logarithms of measured over present depth, of the landmarks that a view sees.
fn log_ratios(scene: &Reconstruction, view_ix: usize) -> Vec<f64> {
    let view = &scene.views[view_ix];
    let Some(registered) = &view.registered else {
        return Vec::new();
    };
    let seen = (0..).zip(view.landmark_of.iter().copied());
    let seen: Vec<(u32, u32)> = seen.filter(|(_, landmark)| *landmark != NONE).collect();
    log_ratios_at(scene, view_ix, &registered.cam_from_world, &seen)
}

/// The same at a pose, of (feature, landmark).
fn log_ratios_at(
    scene: &Reconstruction,
    view_ix: usize,
    cam_from_world: &Rigid,
    pairs: &[(u32, u32)],
) -> Vec<f64> {
    let depths = scene.views[view_ix].measured.as_ref();
    let log = |&(feature, landmark): &(u32, u32)| {
        let measured = depths?.of(feature as usize)?;
        let point = scene.landmarks[landmark as usize].point;
        let z = cam_from_world.transform_point(point).z;
        let log = -(measured.inverse * z).ln();
        log.is_finite().then_some(log)
    };
    pairs.iter().filter_map(log).collect()
}

/// Forgets what was measured in a view where that disagrees with the landmarks of a submap in metres, (feature, landmark), which
/// the view is about to be registered by: a sensor that is wrong must not bend the map.
pub(crate) fn drop_wrong_depth(
    scene: &mut Reconstruction,
    view_ix: usize,
    submap: u32,
    cam_from_world: &Rigid,
    pairs: &[(u32, u32)],
) {
    if !scene.submaps[submap as usize].is_metric {
        return;
    }
    let mut logs = log_ratios_at(scene, view_ix, cam_from_world, pairs);
    let off = median(&mut logs).filter(|_| logs.len() >= MIN_COMPARED);
    if let Some(off) = off.filter(|off| off.abs() > MAX_OFF) {
        let percent = 100.0 * (off.exp() - 1.0);
        let id = scene.views[view_ix].keyframe.id;
        tracing::debug!(id, percent, "measured depth is left out");
        if scene.n_wrong_depths == 0 {
            tracing::warn!(
                "measured depth of keyframe {id} is {percent:.0} % off what the map has there and is left out, and so is that of others like it; said once"
            );
        }
        scene.views[view_ix].measured = None;
        scene.n_wrong_depths += 1;
    }
}
