//! One frame -> its pose: by the motion, by the keyframes around it, or by all keyframes without a hint; and the gates
//! that a pose must pass.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, Vector3};

use crate::track::align::{AlignedPoint, AlignmentFrame};
use crate::track::keyframe_poses::Revisions;
use crate::track::landmarks::{Landmarks, StoredKeyframe};
use crate::track::map_points::{MapPoints, PointKeyframe};
use crate::track::matching::{Pairs, guided, unguided};
use crate::track::motion::Motion;
use crate::track::observation::{Observation, UndistortedObservation};
use crate::track::odometry_link::LinkedPose;
use crate::track::params::TrackParams;
use crate::track::pose_fit::{self, Fit};
use crate::working_camera::WorkingCamera;
use splat_types::tracking::LostReason;
use splat_types::transform::{Rigid, skew};

/// Keyframes that a frame is tracked by.
const N_LOCAL: usize = 5;
/// How far from the predicted pixel a corner is looked for, shares of the longer side: by an even motion, by an uneven one,
/// and by a pose that was measured on this frame.
const NARROW: f64 = 0.04;
const WIDE: f64 = 0.11;
const EXACT: f64 = 0.015;
/// Images with fewer corners show nothing: black, white, a blank wall.
const MIN_CORNERS: usize = 30;
/// Landmarks that agree, as a share of those that the keyframe with most of them has in view.
const MIN_SHARE: f64 = 0.1;
const MIN_SHARE_SEARCHED: f64 = 0.18;
/// Of the pairs that were looked for where the pose puts them; a pose that half of them contradict is that of another place.
const MIN_SHARE_OF_PAIRS: f64 = 0.5;
/// Of the points that were looked for.
const MIN_SHARE_ALIGNED: f64 = 0.2;
/// Least standard deviation of the inliers over the image, across where they spread most, share of the longer side;
/// an even spread over an image of 4:3 has 0.22.
const MIN_SPREAD: f64 = 0.05;
/// Residuals that are larger by so much are those of another place.
const MAX_SCALE: f64 = 2.5;
/// The same of patches, which are found more exactly.
const MAX_SCALE_ALIGNED: f64 = 6.0;
/// A pose that is known no better says nothing: share of the depth of the scene, and radians.
const MAX_STD_DEPTHS: f64 = 0.05;
const MAX_STD_RAD: f64 = 0.05;
/// Keyframes that look most alike, and the newest ones, that a search begins with.
const N_ALIKE: usize = 3;
const N_NEWEST: usize = 2;
/// Part of a depth's error that all landmarks of a keyframe have in common: its neighbours, which gave the depth, stand
/// where they stand for all of them. No residual shows it: the camera is nearer or farther from the keyframe in proportion.
const COMMON_SHARE: f64 = 0.25;

/// A frame with a measured pose.
#[derive(Debug, Clone)]
pub(crate) struct Localized {
    pub(crate) cam_from_world: Rigid,
    /// As `Fit::covariance`.
    pub(crate) covariance: Matrix6<f64>,
    pub(crate) design: f64,
    pub(crate) n_inliers: usize,
    /// Of the landmarks that the keyframe with most of them has in view.
    pub(crate) share: f64,
    /// The keyframe with most of the inliers.
    pub(crate) reference: u32,
}

struct Gates {
    min_inliers: usize,
    min_share: f64,
}

/// What is known of the camera before a frame is looked at.
pub(crate) struct Hint<'a> {
    pub(crate) motion: Option<&'a Motion>,
    /// `cam_from_world` by odometry.
    pub(crate) guess: Option<Rigid>,
    pub(crate) is_lost: bool,
    /// Frames without a measured pose since the last one with.
    pub(crate) n_failed: usize,
    /// Of the keyframe last tracked by.
    pub(crate) scene_depth: f64,
    pub(crate) last_keyframe: Option<u32>,
}

/// The landmarks that frames are localised among.
#[derive(Clone, Copy)]
pub(crate) struct Localizer<'a> {
    pub(crate) landmarks: &'a Landmarks,
    pub(crate) points: &'a MapPoints,
    pub(crate) revisions: &'a Revisions,
    pub(crate) params: &'a TrackParams,
    /// Design effect of the frames so far.
    pub(crate) design: f64,
    /// Share of the landmarks that must agree otherwise: a pose that alignment has to confirm need not be clear.
    pub(crate) share_needed: f64,
}

impl Localizer<'_> {
    /// The pose of the newest frame, and whether it was searched for without a hint; then whether keyframes were searched,
    /// from number `start` on.
    pub(crate) fn find(
        &self,
        seen: &Observation,
        hint: &Hint<'_>,
        start: usize,
    ) -> (Result<(Localized, bool), LostReason>, bool) {
        let undistorted = match self.undistorted(seen) {
            Ok(undistorted) => undistorted,
            Err(reason) => return (Err(reason), false),
        };
        let frame = (seen, &undistorted);
        let mut failure = LostReason::NotRecognised;
        let motion = hint.motion.filter(|_| !hint.is_lost);
        let ahead = motion.map(|motion| motion.ahead(seen.stamp));
        if let Some(guess) = hint.guess.or(ahead) {
            for radius in [NARROW, WIDE] {
                match self.around(&guess, radius, frame, &self.tracking_gates()) {
                    Ok(located) if self.is_plausible(seen, &located, hint) => {
                        return (Ok((located, false)), false);
                    }
                    Ok(_) => failure = LostReason::Implausible,
                    Err(reason) => failure = reason,
                }
            }
            // One frame may be blurred, and odometry goes on by itself; a search is for what lasts.
            if hint.n_failed == 0 || hint.guess.is_some() {
                return (Err(failure), false);
            }
        }
        let ids = self.candidates(seen, hint.last_keyframe, start);
        let located = self.search(&ids, frame, &self.search_gates());
        (located.map(|located| (located, true)).ok_or(failure), true)
    }

    /// Whether the motion before could have led there; what could not must be as clear as if there had been none.
    fn is_plausible(&self, seen: &Observation, located: &Localized, hint: &Hint<'_>) -> bool {
        let is_far = hint.motion.is_some_and(|motion| {
            motion.is_elsewhere(seen.stamp, &located.cam_from_world, hint.scene_depth)
        });
        let gates = self.search_gates();
        let is_clear = located.n_inliers >= gates.min_inliers && located.share >= gates.min_share;
        !is_far || is_clear
    }

    /// The pose of an earlier frame, which the map has reached since, from a guess or the keyframes next to it in time.
    pub(crate) fn find_again(&self, seen: &Observation, guess: Option<Rigid>) -> Option<Localized> {
        let undistorted = self.undistorted(seen).ok()?;
        let frame = (seen, &undistorted);
        // Where nothing was measured before, what is found must be as clear as what a search finds.
        let (radii, gates): (&[f64], Gates) = if guess.is_some() {
            (&[NARROW], self.tracking_gates())
        } else {
            (&[NARROW, WIDE], self.search_gates())
        };
        let start = guess
            .map(|pose| pose.inverse())
            .or_else(|| self.between(seen));
        let near = start.and_then(|start| {
            let mut tries = radii.iter();
            tries.find_map(|radius| self.around(&start, *radius, frame, &gates).ok())
        });
        near.or_else(|| self.search(&self.beside(seen), frame, &self.search_gates()))
    }

    /// `cam_from_world` halfway between the keyframes on both sides.
    fn between(&self, seen: &Observation) -> Option<Rigid> {
        let held = || self.landmarks.held.values();
        let after = held().find(|held| held.seen.stamp >= seen.stamp)?;
        let before = held().rev().find(|held| held.seen.stamp <= seen.stamp)?;
        let whole = after.seen.stamp.secs_since(before.seen.stamp).max(1e-9);
        let share = seen.stamp.secs_since(before.seen.stamp) / whole;
        Some(
            before
                .world_from_cam
                .between(&after.world_from_cam, share)
                .inverse(),
        )
    }

    /// Keyframes next to a frame in time.
    fn beside(&self, seen: &Observation) -> Vec<u32> {
        let held = || self.landmarks.held.values();
        let before = held().rev().filter(|held| held.seen.stamp <= seen.stamp);
        let after = held().filter(|held| held.seen.stamp > seen.stamp);
        let next = before.take(N_NEWEST).chain(after.take(N_NEWEST));
        next.map(|held| held.id).collect()
    }

    fn tracking_gates(&self) -> Gates {
        Gates {
            min_inliers: self.needed(self.params.min_inliers),
            min_share: self.share_needed * MIN_SHARE,
        }
    }

    fn search_gates(&self) -> Gates {
        Gates {
            min_inliers: self.needed(self.params.relocalise_inliers),
            min_share: self.share_needed * MIN_SHARE_SEARCHED,
        }
    }

    fn needed(&self, n: usize) -> usize {
        (self.share_needed * n as f64).ceil() as usize
    }

    /// The frame's corners where a pinhole would show them.
    fn undistorted(&self, seen: &Observation) -> Result<UndistortedObservation, LostReason> {
        if self.landmarks.held.is_empty() {
            return Err(LostReason::NoKeyframes);
        }
        if seen.len() < MIN_CORNERS {
            return Err(LostReason::Blank {
                n_corners: seen.len(),
            });
        }
        let (width_px, height_px) = seen.frame_px;
        let unknown = LostReason::NoCamera {
            width_px,
            height_px,
        };
        let camera = self.camera_of(seen).ok_or(unknown)?;
        Ok(UndistortedObservation::of(seen, camera))
    }

    /// The camera of the newest keyframe that was taken by the same one, refined as it is; else what the source says. A
    /// frame without a calibration is one of the keyframes' camera if it has their size.
    fn camera_of(&self, seen: &Observation) -> Option<WorkingCamera> {
        let is_same = |held: &&StoredKeyframe| {
            let is_stated = held.seen.intrinsics == seen.intrinsics;
            held.seen.frame_px == seen.frame_px && (is_stated || seen.intrinsics.is_none())
        };
        let newest = self.landmarks.held.values().rev().find(is_same);
        newest
            .map(|held| held.camera)
            .or_else(|| WorkingCamera::of(&seen.intrinsics?, None, seen.working_px))
    }

    /// The pose near a guess, measured twice: the second time by landmarks that are looked for where the first put them.
    fn around(
        &self,
        guess: &Rigid,
        radius: f64,
        frame: (&Observation, &UndistortedObservation),
        gates: &Gates,
    ) -> Result<Localized, LostReason> {
        let pinhole = frame.1.camera.pinhole;
        let longest = f64::from(pinhole.width_px.max(pinhole.height_px));
        let error = self.params.depth_error;
        let pairs_at = |pose: &Rigid, radius: f64| {
            let visible = self.landmarks.visible(pose, &pinhole, N_LOCAL);
            let most = visible.first().map_or(0, |(_, n)| *n);
            let keyframes: Vec<&StoredKeyframe> =
                visible.into_iter().map(|(held, _)| held).collect();
            (
                guided(&keyframes, pose, frame, radius * longest, error),
                most,
            )
        };
        let (first, most) = pairs_at(guess, radius);
        let needed = gates.min_inliers;
        if most == 0 {
            return Err(LostReason::Unseen);
        }
        if first.observations.len() < needed {
            return Err(LostReason::TooFew {
                found: first.observations.len(),
                needed,
            });
        }
        let enough = |fit: &Fit| 2 * fit.inliers.len() >= first.observations.len();
        let rough = pose_fit::fit(&first.observations, &pinhole, guess).filter(enough);
        let rough = match rough {
            Some(fit) => fit.cam_from_world,
            // Wrong pairs outnumber the right ones.
            None => first
                .consensus(frame.1, needed.div_ceil(2).max(8), frame.0.seq)
                .ok_or(LostReason::TooFew { found: 0, needed })?,
        };
        let (pairs, most) = pairs_at(&rough, EXACT);
        let fit = pose_fit::fit(&pairs.observations, &pinhole, &rough).ok_or(LostReason::Open)?;
        self.judged(&fit, &pairs, most, (frame.1, gates))
    }

    /// The pose near a guess by the points that keyframes show, and those that agree.
    pub(crate) fn align(
        &self,
        frame: &AlignmentFrame<'_>,
        keyframes: &[&PointKeyframe],
        guess: &Rigid,
    ) -> Result<(Localized, Vec<AlignedPoint>), LostReason> {
        let needed = self.params.min_inliers;
        let aligned = frame.align(keyframes, guess);
        let aligned = aligned.ok_or(LostReason::TooFew { found: 0, needed })?;
        let found = aligned.fit.inliers.len();
        let needed = needed.max((MIN_SHARE_ALIGNED * aligned.n_asked as f64) as usize);
        if found < needed {
            return Err(LostReason::TooFew { found, needed });
        }
        let pinhole = &frame.camera.pinhole;
        let longest = f64::from(pinhole.width_px.max(pinhole.height_px));
        let pixels = aligned.points.iter().map(|point| point.pixel);
        if spread(&pixels.collect::<Vec<_>>()) < MIN_SPREAD * longest {
            return Err(LostReason::Crowded);
        }
        let reference = self.points.held.get(&aligned.reference);
        let depth = reference.ok_or(LostReason::Unseen)?.median_depth();
        self.is_known(&aligned.fit, MAX_SCALE_ALIGNED, depth)?;
        let located = Localized {
            cam_from_world: aligned.fit.cam_from_world,
            covariance: aligned.fit.covariance,
            design: aligned.fit.design,
            n_inliers: found,
            share: found as f64 / aligned.n_asked.max(1) as f64,
            reference: aligned.reference,
        };
        Ok((located, aligned.points))
    }

    /// Whether a pose is known well enough to say something.
    fn is_known(&self, fit: &Fit, max_scale: f64, scene_depth: f64) -> Result<(), LostReason> {
        if fit.scale > max_scale {
            return Err(LostReason::Inexact { times: fit.scale });
        }
        let std = |axis: usize| (fit.covariance[(axis, axis)] * self.design.max(1.0)).sqrt();
        let far = (0..3).map(std).fold(0.0, f64::max);
        let turned = (3..6).map(std).fold(0.0, f64::max);
        if far > MAX_STD_DEPTHS * scene_depth || turned > MAX_STD_RAD {
            return Err(LostReason::Open);
        }
        Ok(())
    }

    fn judged(
        &self,
        fit: &Fit,
        pairs: &Pairs,
        most: usize,
        (undistorted, gates): (&UndistortedObservation, &Gates),
    ) -> Result<Localized, LostReason> {
        let pinhole = &undistorted.camera.pinhole;
        let longest = f64::from(pinhole.width_px.max(pinhole.height_px));
        let of_seen = (gates.min_share * most as f64) as usize;
        let of_pairs =
            (self.share_needed * MIN_SHARE_OF_PAIRS * pairs.observations.len() as f64) as usize;
        let needed = gates.min_inliers.max(of_seen).max(of_pairs);
        let found = fit.inliers.len();
        if found < needed {
            return Err(LostReason::TooFew { found, needed });
        }
        let pixels = fit.inliers.iter().map(|i| pairs.observations[*i].pixel);
        if spread(&pixels.collect::<Vec<_>>()) < MIN_SPREAD * longest {
            return Err(LostReason::Crowded);
        }
        let reference = most_frequent(fit.inliers.iter().map(|i| pairs.keyframes[*i]));
        let held = self
            .landmarks
            .held
            .get(&reference)
            .ok_or(LostReason::Unseen)?;
        self.is_known(fit, MAX_SCALE, held.median_depth())?;
        Ok(Localized {
            cam_from_world: fit.cam_from_world,
            covariance: fit.covariance,
            design: fit.design,
            n_inliers: found,
            share: found as f64 / most.max(1) as f64,
            reference,
        })
    }

    /// Of the landmarks, with what they have in common, and of the keyframe itself.
    pub(crate) fn covariance(&self, located: &Localized) -> Matrix6<f64> {
        let mut covariance = located.covariance * self.design.max(1.0);
        let Some((world_from_key, of_key)) = self.keyframe(located.reference) else {
            return covariance;
        };
        let cam_from_key = located.cam_from_world * world_from_key;
        let away = cam_from_key.translation * (COMMON_SHARE * self.params.depth_error);
        let away = Vector3::new(away.x, away.y, away.z);
        let mut place = covariance.fixed_view_mut::<3, 3>(0, 0);
        place += away * away.transpose();
        covariance
            + of_key.map_or_else(Matrix6::zeros, |of_key| transported(&of_key, &cam_from_key))
    }

    /// Where a keyframe stands, and where the geometry states its covariance, that and what the map will yet move it by.
    fn keyframe(&self, id: u32) -> Option<(Rigid, Option<Matrix6<f64>>)> {
        let (by_points, by_corners) = (self.points.held.get(&id), self.landmarks.held.get(&id));
        let by_points =
            by_points.map(|held| (held.world_from_cam, held.covariance, held.median_depth()));
        let (world_from_cam, stated, depth) = by_points.or_else(|| {
            by_corners.map(|held| (held.world_from_cam, held.covariance, held.median_depth()))
        })?;
        let stated = stated.map(|stated| {
            let stated = Matrix6::from_fn(|i, j| stated[i][j]);
            stated + self.revisions.covariance(id, depth)
        });
        Some((world_from_cam, stated))
    }

    /// What the keyframe's own covariance is worth at a camera that odometry has led away from it.
    pub(crate) fn covariance_of_key(&self, linked: &LinkedPose) -> Matrix6<f64> {
        let of_key = self.keyframe(linked.keyframe_id);
        let of_key = of_key.and_then(|(_, of_key)| of_key);
        of_key.map_or_else(Matrix6::zeros, |of_key| {
            transported(&of_key, &linked.key_from_cam.inverse())
        })
    }

    /// Keyframes that a search compares a frame with: the newest ones and the last one tracked by, the most alike, and
    /// of the others some, which next time are others. Bounded by `track.relocalise_keyframes`.
    fn candidates(&self, seen: &Observation, last_keyframe: Option<u32>, start: usize) -> Vec<u32> {
        let n = self.params.relocalise_keyframes;
        let held = &self.landmarks.held;
        let mut ids: Vec<u32> = held.keys().rev().take(N_NEWEST).copied().collect();
        ids.extend(last_keyframe);
        let mut alike: Vec<(f32, u32)> = held
            .values()
            .map(|held| (held.seen.likeness(seen), held.id))
            .filter(|(likeness, _)| *likeness > 0.0)
            .collect();
        alike.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
        ids.extend(alike.iter().take(N_ALIKE).map(|(_, id)| *id));
        let others = held.keys().cycle().skip(start % held.len().max(1));
        ids.extend(others.take(n.min(held.len())));
        let mut known = std::collections::BTreeSet::new();
        ids.retain(|id| known.insert(*id));
        ids.truncate(n);
        ids
    }

    fn search(
        &self,
        ids: &[u32],
        frame: (&Observation, &UndistortedObservation),
        gates: &Gates,
    ) -> Option<Localized> {
        let held = ids.iter().filter_map(|id| self.landmarks.held.get(id));
        let keyframes: Vec<&StoredKeyframe> = held.collect();
        let mut poses = unguided(&keyframes, frame, self.params).into_iter();
        poses.find_map(|pose| self.around(&pose, 2.0 * EXACT, frame, gates).ok())
    }
}

/// Standard deviation of the inliers' pixels across where they spread most.
fn spread(pixels: &[DVec2]) -> f64 {
    let n = pixels.len().max(1) as f64;
    let mean = pixels.iter().sum::<DVec2>() / n;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for off in pixels.iter().map(|pixel| *pixel - mean) {
        xx += off.x * off.x / n;
        xy += off.x * off.y / n;
        yy += off.y * off.y / n;
    }
    let middle = 0.5 * (xx + yy);
    let apart = (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
    (middle - apart).max(0.0).sqrt()
}

/// Of equals the newest; 0 of none.
fn most_frequent(ids: impl Iterator<Item = u32>) -> u32 {
    let mut counts = std::collections::BTreeMap::new();
    for id in ids {
        *counts.entry(id).or_insert(0_usize) += 1;
    }
    let most = counts.into_iter().max_by_key(|(id, n)| (*n, *id));
    most.map_or(0, |(id, _)| id)
}

/// The covariance of one camera in the axes of another that is rigidly beside it.
pub(crate) fn transported(of_source: &Matrix6<f64>, target_from_source: &Rigid) -> Matrix6<f64> {
    let carry = adjoint(target_from_source);
    carry * of_source * carry.transpose()
}

/// Takes a small motion of the source in its own axes to that of the target, translation first.
fn adjoint(target_from_source: &Rigid) -> Matrix6<f64> {
    let turn = matrix(&target_from_source.rotation_matrix());
    let lever = matrix(&skew(target_from_source.translation)) * turn;
    let mut out = Matrix6::zeros();
    out.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    out.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    out.fixed_view_mut::<3, 3>(0, 3).copy_from(&lever);
    out
}

fn matrix(m: &glam::DMat3) -> Matrix3<f64> {
    let columns = [m.x_axis, m.y_axis, m.z_axis];
    Matrix3::from_columns(&columns.map(|c: DVec3| Vector3::new(c.x, c.y, c.z)))
}
