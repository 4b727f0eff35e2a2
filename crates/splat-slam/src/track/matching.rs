//! A frame and landmarks -> pairs: near where a pose predicts them, or anywhere by their bits alone.

use glam::{DVec2, DVec3};

use crate::track::landmarks::{StoredKeyframe, shown};
use crate::track::observation::{Observation, UndistortedObservation};
use crate::track::params::TrackParams;
use crate::track::pose_fit::Correspondence;
use splat_geometry::features::descriptor::Descriptors;
use splat_geometry::matching::{PreparedDescriptors, matches};
use splat_geometry::pnp;
use splat_types::transform::Rigid;

/// Bits in which a pair may differ; unrelated corners differ in 128 +- 8.
const MAX_BITS: u32 = 64;
/// The next best corner in reach differs in so many times as many bits, or it is not known which one it is.
const MIN_RATIO: f64 = 1.15;
/// Levels are 1.2 apart; a corner turns up two levels beside the predicted one at most.
const MAX_LEVEL_RATIO: f32 = 1.5;
/// Standard deviation of a corner of the finest level, and so many times more at the coarser ones.
const CORNER_STD_PX: f64 = 0.7;
/// Pairs by bits alone up to this error, in pixels of the working image, agree in a first pose.
const MAX_ERROR_PX: f64 = 4.0;
/// Fewer pairs by bits alone are as likely chance.
const MIN_PAIRS: usize = 15;
/// First poses from bits alone that are tried out on one frame.
const MAX_POSES: usize = 2;

/// Observations of one frame, and the keyframe that each landmark is of.
#[derive(Debug, Default)]
pub(crate) struct Pairs {
    pub(crate) observations: Vec<Correspondence>,
    pub(crate) keyframes: Vec<u32>,
}

struct Best {
    bits: u32,
    keyframe_ix: usize,
    landmark_ix: usize,
}

/// Landmarks of some keyframes, each paired with the corner within `radius_px` of where `cam_from_world` puts it that is
/// most like it. A corner is paired once: two landmarks of one place are no two measurements.
pub(crate) fn guided(
    keyframes: &[&StoredKeyframe],
    cam_from_world: &Rigid,
    frame: (&Observation, &UndistortedObservation),
    radius_px: f64,
    depth_error: f64,
) -> Pairs {
    let (seen, undistorted) = frame;
    let mut best: Vec<Option<Best>> = (0..seen.len()).map(|_| None).collect();
    for (keyframe_ix, held) in keyframes.iter().enumerate() {
        let cam_from_key = *cam_from_world * held.world_from_cam;
        for (landmark_ix, landmark) in held.landmarks.iter().enumerate() {
            let Some((at, level)) = shown(landmark, &cam_from_key, &undistorted.camera.pinhole)
            else {
                continue;
            };
            let is_level = |i: &usize| {
                let ratio = seen.levels[*i] / level;
                (1.0 / MAX_LEVEL_RATIO..=MAX_LEVEL_RATIO).contains(&ratio)
            };
            let near = undistorted.near(at, radius_px).filter(is_level);
            let Some((corner, bits)) = most_alike(near, &landmark.bits, seen) else {
                continue;
            };
            if best[corner].as_ref().is_none_or(|other| bits < other.bits) {
                best[corner] = Some(Best {
                    bits,
                    keyframe_ix,
                    landmark_ix,
                });
            }
        }
    }
    let mut pairs = Pairs::default();
    for (corner, found) in best.iter().enumerate() {
        if let Some(found) = found {
            let held = keyframes[found.keyframe_ix];
            pairs.push(
                held,
                found.landmark_ix,
                (seen, undistorted),
                corner,
                depth_error,
            );
        }
    }
    pairs
}

/// (corner, differing bits), where it is clear which one it is.
fn most_alike(
    corners: impl Iterator<Item = usize>,
    bits: &[u64; 4],
    seen: &Observation,
) -> Option<(usize, u32)> {
    let (mut first, mut second) = ((usize::MAX, u32::MAX), u32::MAX);
    for corner in corners {
        let pairs = bits.iter().zip(&seen.bits[corner]);
        let differing = pairs.map(|(a, b)| (a ^ b).count_ones()).sum();
        if differing < first.1 {
            (first, second) = ((corner, differing), first.1);
        } else {
            second = second.min(differing);
        }
    }
    let is_clear = f64::from(second) >= MIN_RATIO * f64::from(first.1);
    (first.1 <= MAX_BITS && is_clear).then_some(first)
}

impl Pairs {
    fn push(
        &mut self,
        held: &StoredKeyframe,
        landmark_ix: usize,
        (seen, undistorted): (&Observation, &UndistortedObservation),
        corner: usize,
        depth_error: f64,
    ) {
        let landmark = &held.landmarks[landmark_ix];
        let ray_in_world = held.world_from_cam.rotation * landmark.point_in_cam;
        self.observations.push(Correspondence {
            point_in_world: ray_in_world + held.world_from_cam.translation,
            depth_std_in_world: ray_in_world * depth_error,
            pixel: undistorted.pixels[corner],
            std_px: CORNER_STD_PX * f64::from(seen.levels[corner]),
        });
        self.keyframes.push(held.id);
    }

    /// Points and pixels for `pnp`.
    pub(crate) fn points(&self) -> (Vec<DVec3>, Vec<DVec2>) {
        let pairs = self
            .observations
            .iter()
            .map(|s| (s.point_in_world, s.pixel));
        pairs.unzip()
    }

    /// The pose that most pairs agree on, whatever the others say.
    pub(crate) fn consensus(
        &self,
        undistorted: &UndistortedObservation,
        min_inliers: usize,
        seed: u64,
    ) -> Option<Rigid> {
        let (points, pixels) = self.points();
        let limits = (MAX_ERROR_PX, min_inliers);
        let placement = pnp::place(&points, &pixels, &undistorted.camera.pinhole, limits, seed)?;
        Some(placement.cam_from_world)
    }
}

/// First poses of a frame from keyframes whose landmarks it shows by their bits alone, the best first.
pub(crate) fn unguided(
    keyframes: &[&StoredKeyframe],
    frame: (&Observation, &UndistortedObservation),
    params: &TrackParams,
) -> Vec<Rigid> {
    let (seen, undistorted) = frame;
    let ours = PreparedDescriptors::new(&Descriptors::Orb(seen.bits.clone()));
    let compare = |held: &&StoredKeyframe| {
        let bits = held.landmarks.iter().map(|landmark| landmark.bits);
        let theirs = PreparedDescriptors::new(&Descriptors::Orb(bits.collect()));
        let mut pairs = Pairs::default();
        for (landmark_ix, corner) in matches(&theirs, &ours) {
            let corner = corner as usize;
            if undistorted.pixels[corner].is_finite() {
                let landmark_ix = landmark_ix as usize;
                pairs.push(held, landmark_ix, frame, corner, params.depth_error);
            }
        }
        pairs
    };
    let mut found: Vec<Pairs> = keyframes.iter().map(compare).collect();
    found.retain(|pairs| pairs.observations.len() >= MIN_PAIRS);
    found.sort_by_key(|pairs| std::cmp::Reverse(pairs.observations.len()));
    found.truncate(MAX_POSES);
    let poses = found.iter();
    let poses = poses.filter_map(|pairs| {
        pairs.consensus(undistorted, params.min_inliers.div_ceil(2).max(8), seen.seq)
    });
    poses.collect()
}
