//! Keyframes whose place is known in a map and in a model's frame -> the similarity that lays the model over the map.
//!
//! Each keyframe alone proposes one; the one that most others agree with counts, then the mean of those. Places a few
//! steps apart hardly report the scale; depth, which the map shows and the model states, does.

use splat_geometry::similarity;
use splat_geometry::stats::median;
use splat_types::transform::{Rigid, Similarity};

/// Keyframes that must agree, and their share of all that were found.
const MIN_INLIERS: usize = 3;
const MIN_SHARE: f64 = 0.5;
/// Two agree within this angle, this share of the depth of the scene plus of the way between them, and this factor.
const MAX_TURN_RAD: f64 = 0.035;
const MAX_OFF: f64 = 0.06;
const MAX_OFF_OF_WAY: f64 = 0.03;
const MAX_FACTOR_LOG: f64 = 0.15;
/// Standard deviation of a scale by depth, which all keyframes have in common; and of a place, as a share of the depth.
const DEPTH_STD: f64 = 0.01;
const PLACE_STD: f64 = 0.01;
const ROUNDS: usize = 3;

/// A keyframe that was found in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PriorMatch {
    pub(crate) submap: u32,
    pub(crate) world_from_cam: Rigid,
    pub(crate) submap_from_cam: Rigid,
    /// Map units of one unit of the model, by depth alone.
    pub(crate) scale: Option<f64>,
    /// Median depth of what it sees, in map units, where known.
    pub(crate) depth: Option<f64>,
}

/// `world_from_submap`, and how many agree on it.
pub(crate) fn align_to_prior(observations: &[PriorMatch]) -> Option<(Similarity, usize)> {
    let scale = median_positive(observations.iter().filter_map(|s| s.scale))?;
    let depth = median_positive(observations.iter().filter_map(|s| s.depth))?;
    let needed = MIN_INLIERS.max((MIN_SHARE * observations.len() as f64).ceil() as usize);
    let by_one = |observation: &PriorMatch| {
        let rotation = (observation.world_from_cam.rotation
            * observation.submap_from_cam.rotation.conjugate())
        .normalize();
        let scale = observation.scale.unwrap_or(scale);
        Similarity {
            scale,
            rotation,
            translation: observation.world_from_cam.translation
                - rotation * observation.submap_from_cam.translation * scale,
        }
    };
    let proposals = observations.iter().map(by_one);
    let mut best = proposals
        .map(|proposal| find_inliers(observations, &proposal, depth))
        .max_by_key(Vec::len)?;
    let mut found = None;
    for _ in 0..ROUNDS {
        if best.len() < needed {
            return None;
        }
        let mean = mean(&best, scale, depth)?;
        found = Some((mean, best.len()));
        best = find_inliers(observations, &mean, depth);
    }
    found.filter(|_| best.len() >= needed)
}

fn find_inliers(
    observations: &[PriorMatch],
    world_from_submap: &Similarity,
    depth: f64,
) -> Vec<PriorMatch> {
    let centre = observations
        .iter()
        .map(|s| s.world_from_cam.translation)
        .sum::<glam::DVec3>()
        / observations.len().max(1) as f64;
    let agrees = |observation: &&PriorMatch| {
        let wanted = world_from_submap.transform_pose(&observation.submap_from_cam);
        let off = (wanted.translation - observation.world_from_cam.translation).length();
        let way = (observation.world_from_cam.translation - centre).length();
        let factor = observation
            .scale
            .map_or(0.0, |s| (s / world_from_submap.scale).ln());
        wanted.angle_to(&observation.world_from_cam) < MAX_TURN_RAD
            && off < MAX_OFF * depth + MAX_OFF_OF_WAY * way
            && factor.abs() < MAX_FACTOR_LOG
    };
    observations.iter().filter(agrees).copied().collect()
}

/// Scale by depth and by the spread of the places, each as far as it is known; rotation and place as means.
fn mean(observations: &[PriorMatch], scale: f64, depth: f64) -> Option<Similarity> {
    let by_depth = median_positive(observations.iter().filter_map(|s| s.scale)).unwrap_or(scale);
    let pairs: Vec<(Rigid, Rigid)> = observations
        .iter()
        .map(|s| (s.world_from_cam, s.submap_from_cam))
        .collect();
    let by_poses = similarity::of_poses(&pairs)?;
    let n = observations.len() as f64;
    let centre = |place: &dyn Fn(&PriorMatch) -> glam::DVec3| {
        observations.iter().map(place).sum::<glam::DVec3>() / n
    };
    let in_world = centre(&|s| s.world_from_cam.translation);
    let in_model = centre(&|s| s.submap_from_cam.translation);
    let squares = observations
        .iter()
        .map(|s| (s.world_from_cam.translation - in_world).length_squared());
    let spread = squares.sum::<f64>().sqrt().max(1e-9);
    let std_of_poses = PLACE_STD * depth / spread;
    let [by_depth_weight, by_poses_weight] =
        [DEPTH_STD, std_of_poses].map(|std| (std * std).recip());
    let log = (by_depth.ln() * by_depth_weight + by_poses.scale.ln() * by_poses_weight)
        / (by_depth_weight + by_poses_weight);
    let scale = log.exp();
    let rotation = by_poses.rotation;
    let found = Similarity {
        scale,
        rotation,
        translation: in_world - rotation * in_model * scale,
    };
    (scale > 0.0 && scale.is_finite() && found.translation.is_finite()).then_some(found)
}

/// Of those that can be scales or depths.
fn median_positive(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut usable: Vec<f64> = values.filter(|v| v.is_finite() && *v > 0.0).collect();
    median(&mut usable)
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn truth() -> Similarity {
        Similarity {
            scale: 2.5,
            rotation: DQuat::from_scaled_axis(DVec3::new(0.4, -1.0, 0.7)),
            translation: DVec3::new(1.0, -2.0, 3.0),
        }
    }

    /// Places a few steps apart, each off by up to a hundredth of the depth, which is 4.
    fn observations(n: usize) -> Vec<PriorMatch> {
        let observation = |i: usize| {
            let t = i as f64;
            let submap_from_cam = Rigid::exp(
                DVec3::new(0.05 * t, 0.01 * t * t, -0.02 * t),
                DVec3::new(0.02 * t, -0.05, 0.1),
            );
            let off = Rigid::exp(
                DVec3::new((7.0 * t).sin(), (5.0 * t).cos(), (3.0 * t).sin()) * 0.03,
                DVec3::new((2.0 * t).sin(), (11.0 * t).cos(), 0.0) * 0.004,
            );
            PriorMatch {
                submap: 0,
                world_from_cam: truth().transform_pose(&submap_from_cam) * off,
                submap_from_cam,
                scale: Some(2.5 * (1.0 + 0.01 * (9.0 * t).sin())),
                depth: Some(4.0),
            }
        };
        (0..n).map(observation).collect()
    }

    fn assert_found(observations: &[PriorMatch], n: usize) {
        let (found, n_inliers) = align_to_prior(observations).unwrap();
        assert_eq!(n_inliers, n);
        assert!((found.scale / 2.5 - 1.0).abs() < 0.02, "{found:?}");
        assert!(found.rotation.angle_between(truth().rotation) < 0.01);
        let place = DVec3::new(0.2, 0.1, -0.1);
        let off = found.transform_point(place) - truth().transform_point(place);
        assert!(off.length() < 0.06, "{off}");
    }

    #[test]
    fn several_keyframes_that_agree_lay_one_run_over_the_other() {
        assert_found(&observations(3), 3);
        assert_found(&observations(12), 12);
    }

    #[test]
    fn keyframes_in_wrong_places_are_outvoted_or_nothing_is_said() {
        let mut some = observations(9);
        for wrong in &mut some[2..5] {
            wrong.world_from_cam.translation += DVec3::X;
        }
        assert_found(&some, 6);
        assert_eq!(align_to_prior(&observations(2)), None);
        let mut torn = observations(6);
        for (i, observation) in torn.iter_mut().enumerate() {
            observation.world_from_cam.translation += DVec3::Y * i as f64;
        }
        assert_eq!(align_to_prior(&torn), None);
        assert_eq!(align_to_prior(&[]), None);
    }
}
