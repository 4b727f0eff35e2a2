//! Frames that two windows share -> the similarity between the windows, or why there is none to trust.

use glam::{DQuat, DVec3, DVec4};

use crate::frame::DepthMap;
use crate::pose::{Rigid, Similarity};

/// Pixels of a frame that are compared.
const MAX_PIXELS: usize = 20_000;
const MIN_PIXELS: usize = 100;
/// A ratio of depths this near the median is an inlier, and so many must be.
const INLIER: f64 = 0.1;
const MIN_INLIERS: f64 = 0.3;
/// How far the shared frames may turn against each other.
const MAX_TURN_DEG: f64 = 10.0;

/// A frame with its place and depth in both.
#[derive(Debug, Clone, Copy)]
pub struct Shared<'a> {
    pub map_from_cam: Rigid,
    pub depth_in_map: &'a DepthMap,
    pub window_from_cam: Rigid,
    pub depth_in_window: &'a DepthMap,
}

/// `map_from_window`: scale by the median ratio of depths, rotation and place by the poses.
pub fn similarity(shared: &[Shared<'_>]) -> Result<Similarity, String> {
    let mut ratios: Vec<f64> = shared.iter().flat_map(ratios).collect();
    if ratios.len() < MIN_PIXELS {
        return Err(format!(
            "{} pixels have depth in both windows",
            ratios.len()
        ));
    }
    let middle = ratios.len() / 2;
    let scale = *ratios.select_nth_unstable_by(middle, f64::total_cmp).1;
    let is_inlier = |ratio: &&f64| (**ratio / scale - 1.0).abs() < INLIER;
    let inliers = ratios.iter().filter(is_inlier).count() as f64 / ratios.len() as f64;
    if inliers < MIN_INLIERS {
        return Err(format!(
            "depth agrees at {:.0} % of the pixels, less than {:.0} %",
            100.0 * inliers,
            100.0 * MIN_INLIERS
        ));
    }
    let turns = shared
        .iter()
        .map(|s| s.map_from_cam.rotation * s.window_from_cam.rotation.conjugate());
    let turns: Vec<DQuat> = turns.collect();
    let rotation = mean(&turns);
    let turn = turns
        .iter()
        .map(|turn| turn.angle_between(rotation))
        .fold(0.0, f64::max);
    if turn.to_degrees() > MAX_TURN_DEG {
        return Err(format!(
            "shared frames turn by {:.0} deg against each other, more than {MAX_TURN_DEG}",
            turn.to_degrees()
        ));
    }
    let places = shared
        .iter()
        .map(|s| s.map_from_cam.translation - rotation * s.window_from_cam.translation * scale);
    let translation = places.sum::<DVec3>() / shared.len() as f64;
    Ok(Similarity {
        scale,
        rotation,
        translation,
    })
}

fn ratios(shared: &Shared<'_>) -> Vec<f64> {
    let (map, window) = (shared.depth_in_map, shared.depth_in_window);
    if (map.width_px, map.height_px) != (window.width_px, window.height_px) {
        return Vec::new();
    }
    let stride = map.depth.len().div_ceil(MAX_PIXELS).max(1);
    let ratio = |at: usize| {
        let ((in_map, _), (in_window, _)) = (map.verified(at)?, window.verified(at)?);
        Some(f64::from(in_map) / f64::from(in_window))
    };
    (0..map.depth.len())
        .step_by(stride)
        .filter_map(ratio)
        .collect()
}

/// Of rotations that lie close together (Markley 2007).
fn mean(turns: &[DQuat]) -> DQuat {
    let first = turns.first().copied().unwrap_or(DQuat::IDENTITY);
    let same_side = turns.iter().map(|turn| {
        let sign = if turn.dot(first) < 0.0 { -1.0 } else { 1.0 };
        DVec4::from(*turn) * sign
    });
    let sum: DVec4 = same_side.sum();
    sum.try_normalize().map_or(first, DQuat::from_vec4)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn depth(factor: f32, n_odd: usize) -> DepthMap {
        let odd = |i: usize| if i < n_odd { 1.0 + i as f32 } else { 1.0 };
        DepthMap {
            width_px: 40,
            height_px: 30,
            depth: (0..1200)
                .map(|i| (2.0 + i as f32 * 1e-3) * factor * odd(i))
                .collect(),
            confidence: vec![1.0; 1200],
        }
    }

    fn pose(i: f64) -> Rigid {
        Rigid::exp(
            DVec3::new(i, 0.3, -0.2 * i),
            DVec3::new(0.1 * i, -0.05, 0.2),
        )
    }

    #[test]
    fn windows_of_another_scale_are_joined_by_what_they_share() {
        let truth = Similarity {
            scale: 1.25,
            rotation: DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 0.7)),
            translation: DVec3::new(1.0, -2.0, 3.0),
        };
        let (old, new) = (depth(1.25, 300), depth(1.0, 0));
        let shared = [1.0, 2.0].map(|i| Shared {
            map_from_cam: truth.transform_pose(&pose(i)),
            depth_in_map: &old,
            window_from_cam: pose(i),
            depth_in_window: &new,
        });
        for shared in [&shared[..], &shared[..1]] {
            let found = similarity(shared).unwrap();
            assert!((found.scale - truth.scale).abs() < 1e-6);
            assert!(found.rotation.angle_between(truth.rotation) < 1e-7);
            assert!(found.translation.distance(truth.translation) < 1e-5);
        }
    }

    #[test]
    fn windows_that_disagree_are_not_joined() {
        let (old, new) = (depth(1.0, 1100), depth(1.0, 0));
        let with = |map_from_cam, depth_in_map| Shared {
            map_from_cam,
            depth_in_map,
            window_from_cam: pose(0.0),
            depth_in_window: &new,
        };
        let reason = |shared: &[Shared<'_>]| similarity(shared).unwrap_err();
        assert!(reason(&[]).starts_with("0 pixels"));
        assert!(reason(&[with(pose(0.0), &old)]).contains("depth agrees"));
        let turned = [with(pose(0.0), &new), with(pose(8.0), &new)];
        assert!(reason(&turned).contains("turn by"));
    }
}
