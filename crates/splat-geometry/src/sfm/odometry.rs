//! Odometry of the keyframes -> metres per unit of a submap, and motions for its adjustment.
//!
//! Only the motion between two keyframes counts, never where odometry says that they are: it drifts. Wheels slip, so its noise
//! grows with the way and the turn, and a motion that is far off what the images show has little weight.

use std::collections::BTreeMap;

use glam::DQuat;

use crate::length_ratio::{LogRatio, of_odometry};
use crate::odometry_step::is_continuous;
use crate::optim::bundle::problem::RelativeMotion;
use crate::sfm::reconstruction::{OdometryNoise, Reconstruction};
use crate::stats::median;
use splat_types::transform::Rigid;

/// Noise that does not add up along the way: a walk of 5 mm and 0.2 degrees in a metre, and what any two readings are off by.
const WALK: f64 = 0.005;
const TURN_WALK: f64 = 0.0035;
const LEAST: f64 = 0.001;
const LEAST_TURN: f64 = 0.001;
/// Of a turn, so large a share is wrong.
const TURN_SHARE: f64 = 0.02;
/// Odometry that is off by so many standard deviations, in the median over the motions beside a gap, joins nothing across it; and the motions
/// that this takes.
pub(crate) const MAX_MISFIT: f64 = 3.0;
const MIN_MOTIONS: usize = 4;
/// The same of turns, between the views that a submap starts from.
const MIN_TURNS: usize = 2;

/// A motion between two keyframes in metres, and its standard deviations: along and about each axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OdometryMotion {
    pub(crate) first_from_second: Rigid,
    pub(crate) std: [f64; 2],
}

impl OdometryMotion {
    /// By how many standard deviations the turn between the images is another one, on average over three axes.
    fn turn_misfit(&self, seen: &Rigid) -> f64 {
        seen.angle_to(&self.first_from_second) / self.std[1] / 3.0_f64.sqrt()
    }

    /// The same of the place, whose unit is so many metres.
    fn place_misfit(&self, seen: &Rigid, unit: f64) -> f64 {
        let off = (seen.translation * unit).distance(self.first_from_second.translation);
        off / self.std[0] / 3.0_f64.sqrt()
    }
}

impl OdometryNoise {
    /// Of a motion in metres: along and about each axis.
    fn std(&self, motion: &Rigid) -> [f64; 2] {
        let way = motion.translation.length();
        let turn = motion.rotation.angle_between(DQuat::IDENTITY);
        let root = way.sqrt();
        let length = [self.length * way, WALK * root, LEAST];
        let angle = [
            self.turn_per_metre * way,
            TURN_WALK * root,
            TURN_SHARE * turn,
            LEAST_TURN,
        ];
        let norm = |parts: &[f64]| parts.iter().map(|p| p * p).sum::<f64>().sqrt();
        [norm(&length), norm(&angle)]
    }
}

/// `None` where one of the keyframes has no odometry, or it was begun anew between them.
pub(crate) fn motion(
    scene: &Reconstruction,
    first: usize,
    second: usize,
) -> Option<OdometryMotion> {
    if scene.odometry_noise.length <= 0.0 {
        return None;
    }
    let [a, b] = [first, second].map(|ix| &scene.views[ix].keyframe.frame);
    let first_from_second = a.odometry?.inverse() * b.odometry?;
    let secs = b.stamp.secs_since(a.stamp);
    is_continuous(&first_from_second, secs).then(|| OdometryMotion {
        first_from_second,
        std: scene.odometry_noise.std(&first_from_second),
    })
}

/// The views of a submap in order of time.
pub(crate) fn in_time(scene: &Reconstruction, submap: u32) -> Vec<usize> {
    let mut views = scene.submaps[submap as usize].views.clone();
    views.sort_unstable();
    views
}

pub(crate) fn world_from_cam(scene: &Reconstruction, view: usize) -> Option<Rigid> {
    let registered = scene.views[view].registered.as_ref()?;
    Some(registered.cam_from_world.inverse())
}

/// Metres per unit of a submap; `None` where odometry does not say, or too little of it.
pub(crate) fn metres_per_unit(scene: &Reconstruction, submap: u32) -> Option<LogRatio> {
    if scene.submaps[submap as usize].is_metric {
        return Some(LogRatio { log: 0.0, std: 0.0 });
    }
    if scene.odometry_noise.length <= 0.0 {
        return None;
    }
    let views = in_time(scene, submap).into_iter();
    let track: Vec<(Rigid, Rigid)> = views
        .filter_map(|view| {
            let odometry = scene.views[view].keyframe.frame.odometry?;
            Some((world_from_cam(scene, view)?, odometry))
        })
        .collect();
    of_odometry(&track, 0.0)
}

/// What odometry says of each two views of a submap that follow one another, in its unit; `place` is where a view stands among the
/// cameras of an adjustment.
pub(crate) fn motions(
    scene: &Reconstruction,
    submap: u32,
    place: impl Fn(usize) -> Option<u32>,
) -> Vec<RelativeMotion> {
    let Some(scale) = metres_per_unit(scene, submap) else {
        return Vec::new();
    };
    let unit = scale.log.exp();
    let views = in_time(scene, submap);
    let motions = views.windows(2).filter_map(|two| {
        let (first_ix, second_ix) = (place(two[0])?, place(two[1])?);
        let OdometryMotion {
            first_from_second,
            std,
        } = motion(scene, two[0], two[1])?;
        Some(RelativeMotion {
            first_ix,
            second_ix,
            first_from_second: Rigid {
                translation: first_from_second.translation / unit,
                ..first_from_second
            },
            std: [std[0] / unit, std[1]],
        })
    });
    motions.collect()
}

/// By how many standard deviations odometry and the images disagree on the motions between views that follow one another, in the
/// median; `None` of too few. `unit` is in metres.
pub(crate) fn misfit(scene: &Reconstruction, views: &[usize], unit: f64) -> Option<f64> {
    let off = |two: &[usize]| {
        let own = motion(scene, two[0], two[1])?;
        let seen = world_from_cam(scene, two[0])?.inverse() * world_from_cam(scene, two[1])?;
        Some(own.place_misfit(&seen, unit).max(own.turn_misfit(&seen)))
    };
    let mut all: Vec<f64> = views.windows(2).filter_map(off).collect();
    let is_enough = all.len() >= MIN_MOTIONS;
    median(&mut all).filter(|_| is_enough)
}

/// By how many standard deviations odometry disagrees with poses on the turns between views that follow one another, in the median;
/// `None` of too few. It needs no unit.
pub(crate) fn turn_misfit(
    scene: &Reconstruction,
    world_from_cam: &BTreeMap<usize, Rigid>,
) -> Option<f64> {
    let views: Vec<(&usize, &Rigid)> = world_from_cam.iter().collect();
    let off = |two: &[(&usize, &Rigid)]| {
        let own = motion(scene, *two[0].0, *two[1].0)?;
        let seen = two[0].1.inverse() * *two[1].1;
        Some(own.turn_misfit(&seen))
    };
    let mut all: Vec<f64> = views.windows(2).filter_map(off).collect();
    let is_enough = all.len() >= MIN_TURNS;
    median(&mut all).filter(|_| is_enough)
}
