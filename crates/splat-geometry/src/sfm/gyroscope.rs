//! Turns of a gyroscope between keyframes -> how well they fit turns by the images, and motions for bundle adjustment.
//!
//! Its bias is that of the newest views that follow one another; one that fits none of them is not believed.

use std::collections::BTreeMap;

use crate::inertial::alignment::{MAX_DELAY_SECS, MAX_MOUNT};
use crate::inertial::noise::ImuNoise;
use crate::inertial::preintegration::{Bias, Preintegrated};
use crate::inertial::turns::{MeasuredTurn, TurnAlignment, TurnPair, align};
use crate::optim::bundle::problem::RelativeMotion;
use crate::sfm::odometry::{in_time, motion, world_from_cam};
use crate::sfm::reconstruction::{Reconstruction, SfmView};
use splat_types::frame::Keyframe;
use splat_types::inertial::ImuLog;
use splat_types::transform::Rigid;

/// Turns that the bias comes from.
const MAX_TURNS: usize = 60;
/// Standard deviation of a turn by the images about each axis, rad: of a submap, and of one that has just begun.
const SEEN_STD: f64 = 0.001;
const SEEN_STD_OF_START: f64 = 0.004;
/// A gyroscope whose turns are off by so many standard deviations in the median has no part in adjustment.
const MAX_MISFIT: f64 = 4.0;
/// Of a turn, besides its noise and what the bias leaves: scale and axes of MEMS sensors.
const LEAST_TURN: f64 = 5e-4;
const TURN_SHARE: f64 = 0.005;
/// As good as nothing is known of the place.
const NO_PLACE_STD: f64 = 1e12;
/// Longer spans are no motion between neighbours.
const MAX_SECS: f64 = 10.0;

/// The turn from the view before to a keyframe; `None` where samples lack.
pub(crate) fn turn_since(before: Option<&SfmView>, keyframe: &Keyframe) -> Option<MeasuredTurn> {
    let span = keyframe.frame.imu.as_ref()?;
    let from = before?.keyframe.frame.stamp;
    let mut log = ImuLog::new(MAX_SECS);
    log.push(span);
    let samples = log.between(from, keyframe.frame.stamp)?;
    let noise = ImuNoise::of(&span.model);
    let motion = Preintegrated::of(&samples, &Bias::default(), &noise);
    Some(MeasuredTurn::of(&motion))
}

/// From one view to a later one.
fn turn(scene: &Reconstruction, first: usize, second: usize) -> Option<MeasuredTurn> {
    let mut steps = scene.views.get(first + 1..=second)?.iter();
    let start = steps.next()?.gyro?;
    steps.try_fold(start, |so_far, view| Some(so_far.then(&view.gyro?)))
}

/// What the turns between views that follow one another show of the gyroscope.
fn alignment<'a>(
    scene: &Reconstruction,
    poses: impl Iterator<Item = (usize, &'a Rigid)>,
    seen_std: f64,
) -> Option<TurnAlignment> {
    let poses: Vec<(usize, &Rigid)> = poses.collect();
    let first = poses.len().saturating_sub(MAX_TURNS);
    let pair = |two: &[(usize, &Rigid)]| {
        let measured = turn(scene, two[0].0, two[1].0)?;
        (measured.secs < MAX_SECS).then(|| TurnPair {
            seen: two[0].1.rotation.inverse() * two[1].1.rotation,
            seen_std,
            measured,
        })
    };
    let pairs: Vec<TurnPair> = poses[first..].windows(2).filter_map(pair).collect();
    let found = align(&pairs, &ImuNoise::default())?;
    let is_its_mount = found.mount.length() < MAX_MOUNT && found.delay_secs.abs() < MAX_DELAY_SECS;
    is_its_mount.then_some(found)
}

/// By how many standard deviations the gyroscope disagrees with poses on the turns between views that follow one another, in the median;
/// `None` of too few, or where only another mount or wrong stamps would explain them.
pub(crate) fn turn_misfit(
    scene: &Reconstruction,
    world_from_cam: &BTreeMap<usize, Rigid>,
) -> Option<f64> {
    let poses = world_from_cam.iter().map(|(view, pose)| (*view, pose));
    Some(alignment(scene, poses, SEEN_STD_OF_START)?.misfit)
}

/// What the gyroscope says of each two views of a submap that follow one another, where odometry says nothing; `place` is where a view
/// stands among the cameras of an adjustment.
pub(crate) fn motions(
    scene: &Reconstruction,
    submap: u32,
    place: impl Fn(usize) -> Option<u32>,
) -> Vec<RelativeMotion> {
    let views = in_time(scene, submap);
    if views.iter().all(|view| scene.views[*view].gyro.is_none()) {
        return Vec::new();
    }
    let pose = |view: &usize| Some((*view, world_from_cam(scene, *view)?));
    let poses: Vec<(usize, Rigid)> = views.iter().filter_map(pose).collect();
    let poses = poses.iter().map(|(view, pose)| (*view, pose));
    let Some(found) = alignment(scene, poses, SEEN_STD).filter(|f| f.misfit < MAX_MISFIT) else {
        return Vec::new();
    };
    let of_two = |two: &[usize]| {
        let (first_ix, second_ix) = (place(two[0])?, place(two[1])?);
        let measured = turn(scene, two[0], two[1])?;
        if measured.secs > MAX_SECS || motion(scene, two[0], two[1]).is_some() {
            return None;
        }
        let turn = measured.corrected(found.gyro_bias, found.mount, found.delay_secs);
        let size = measured.turn.to_scaled_axis().length();
        let parts = [
            measured.variance.sqrt(),
            found.gyro_bias_std * measured.secs,
            TURN_SHARE * size,
            LEAST_TURN,
        ];
        let std = parts.iter().map(|p| p * p).sum::<f64>().sqrt();
        Some(RelativeMotion {
            first_ix,
            second_ix,
            first_from_second: Rigid {
                rotation: turn,
                ..Rigid::IDENTITY
            },
            std: [NO_PLACE_STD, std],
        })
    };
    views.windows(2).filter_map(of_two).collect()
}

#[cfg(test)]
mod tests;
