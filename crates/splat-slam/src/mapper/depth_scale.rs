//! Depth that a model gave for one view, beside what the map shows there -> the factor between them.
//!
//! Networks that know no metres err in the scale of single views. The map, learnt from many views, is the better rule;
//! once it has been laid beside a new view's depth a few times, that depth stays.

use std::sync::Arc;

use crate::mapper::keyframes::registered::RegisteredKeyframe;
use crate::mapper::keyframes::store::KeyframeStore;
use crate::mapper::keyframes::training_image::rescaled;
use splat_engine::error::EngineError;
use splat_engine::traits::Engine;
use splat_types::depth::DepthMap;
use splat_types::rendering::Rendering;

/// Looks at a new view before its depth is left alone.
const N_LOOKS: u8 = 2;
/// A factor further from 1 is no error of scale: the map is wrong there, or the depth is.
const MAX_FACTOR: f32 = 1.25;
/// Less changes nothing that the depth loss could see.
const MIN_CHANGE: f32 = 0.002;
/// Where the map shows less, it has no surface yet.
const MIN_ALPHA: f32 = 0.8;

/// Fits the depth of views to the map, where each may have a scale of its own: of `max_views` that were looked at too
/// seldom so far, the oldest first, as each look takes a rendering.
pub(crate) fn scale_depths(
    max_views: usize,
    keyframes: &mut KeyframeStore,
    engine: &mut dyn Engine,
) -> Result<(), EngineError> {
    if engine.len() == 0 {
        return Ok(());
    }
    let is_due =
        |p: &RegisteredKeyframe| p.depth_fit.n_looks < N_LOOKS && !p.is_held_out && p.home.is_here;
    // Reading poses waits for all steps that a GPU has been given.
    if !keyframes.registered().values().any(is_due) {
        return Ok(());
    }
    let map_poses = engine.poses()?;
    let focal_factor = engine.focal_scale()?;
    let due = keyframes.values_mut().filter(|p| is_due(p));
    for registered in due.take(max_views) {
        registered.depth_fit.n_looks += 1;
        let intrinsics = registered.intrinsics.refocused(focal_factor);
        let pose = &map_poses[registered.view_ix];
        let rendering = engine.render(&intrinsics, pose, 0)?;
        let Some(factor) = factor(&registered.depth, &rendering) else {
            continue;
        };
        if (1.0 / MAX_FACTOR..=MAX_FACTOR).contains(&factor) && (factor - 1.0).abs() > MIN_CHANGE {
            rescale_depth(registered, f64::from(factor));
            let depth = Arc::clone(&registered.depth);
            engine.set_depth(registered.view_ix, Some(depth))?;
        }
    }
    Ok(())
}

fn rescale_depth(registered: &mut RegisteredKeyframe, factor: f64) {
    registered.depth = Arc::new(rescaled(&registered.depth, factor));
    registered.depth_fit.factor *= factor;
    registered.depth_fit.median = registered.depth.median();
}

/// Median of rendered over given depth, weighted by confidence: the factor of least absolute error, in closed form.
pub(crate) fn factor(depth: &DepthMap, rendering: &Rendering) -> Option<f32> {
    let (width, height) = (depth.width_px as usize, depth.height_px as usize);
    let (shown_width, shown_height) = (rendering.width_px as usize, rendering.height_px as usize);
    let mut ratios = Vec::new();
    for q in 0..depth.depth.len() {
        let Some((given, confidence)) = depth.verified(q) else {
            continue;
        };
        let p = (q / width * shown_height / height) * shown_width + q % width * shown_width / width;
        if rendering.alpha[p] > MIN_ALPHA {
            ratios.push((rendering.depth[p] / given, confidence));
        }
    }
    ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = ratios.iter().map(|r| f64::from(r.1)).sum::<f64>() / 2.0;
    let mut sum = 0.0;
    let middle = ratios.iter().find(|(_, confidence)| {
        sum += f64::from(*confidence);
        sum >= half
    });
    middle.map(|(ratio, _)| *ratio)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_is_the_weighted_median_where_the_map_has_a_surface() {
        let given = DepthMap {
            width_px: 4,
            height_px: 1,
            depth: vec![1.0, 2.0, 4.0, f32::NAN],
            confidence: vec![1.0, 1.0, 1.0, 1.0],
        };
        let mut rendering = Rendering {
            width_px: 8,
            height_px: 2,
            rgb: vec![0.0; 48],
            alpha: vec![1.0; 16],
            depth: [1.1, 1.1, 2.2, 2.2, 9.0, 9.0, 3.0, 3.0].repeat(2),
        };
        assert!((factor(&given, &rendering).unwrap() - 1.1).abs() < 1e-6);
        rendering.alpha.fill(0.1);
        assert!(factor(&given, &rendering).is_none());
    }
}
