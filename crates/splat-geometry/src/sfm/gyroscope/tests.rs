use std::sync::Arc;

use glam::{DQuat, DVec3};

use super::*;
use crate::features::descriptor::Features;
use crate::matching::PreparedDescriptors;
use crate::sfm::reconstruction::{RegisteredView, Submap};
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::inertial::{ImuModel, ImuSample, ImuSpan};
use splat_types::time::{Stamp, Stopwatch};

const BIAS: DVec3 = DVec3::new(0.03, -0.02, 0.05);
/// Seconds between views, and between samples.
const VIEW_SECS: f64 = 0.3;
const SAMPLE_SECS: f64 = 0.005;

fn turned(secs: f64) -> DQuat {
    let wave = |hertz: f64, phase: f64| (std::f64::consts::TAU * hertz * secs + phase).sin();
    DQuat::from_rotation_y(0.6 * wave(0.2, 0.0)) * DQuat::from_rotation_x(0.2 * wave(0.35, 1.0))
}

fn sample(secs: f64, scale: f64) -> ImuSample {
    const H: f64 = 1e-4;
    let rate = (turned(secs - H).inverse() * turned(secs + H)).to_scaled_axis() / (2.0 * H);
    ImuSample {
        stamp: Stamp::from_secs(10.0 + secs),
        angular_velocity: scale * rate + BIAS,
        acceleration: DVec3::Y * 9.81,
    }
}

/// A submap of views whose rates are `scale` times the true ones; view 3 is registered nowhere.
fn scene(n: usize, scale: f64) -> Reconstruction {
    let mut scene_of = Reconstruction::default();
    for ix in 0..n {
        let at = ix as f64 * VIEW_SECS;
        let n_samples = (VIEW_SECS / SAMPLE_SECS) as i64;
        let samples = (-n_samples - 1..=1).map(|i| sample(at + i as f64 * SAMPLE_SECS, scale));
        let frame = Frame {
            seq: ix as u64,
            stamp: Stamp::from_secs(10.0 + at),
            image: Arc::new(RgbImage::unloaded(4, 4)),
            intrinsics: None,
            truth: None,
            odometry: None,
            imu: Some(ImuSpan {
                samples: samples.collect(),
                model: ImuModel::default(),
            }),
            sensor_depth: None,
            second: None,
            is_held_out: false,
        };
        let keyframe = Keyframe {
            id: ix as u32,
            frame,
            age: Stopwatch::start(),
        };
        let pose = Rigid::new(turned(at), DVec3::X * at);
        let registered = RegisteredView {
            submap: 0,
            cam_from_world: pose.inverse(),
        };
        let features = Features::default();
        let view = SfmView {
            gyro: turn_since(scene_of.views.last(), &keyframe),
            keyframe: Arc::new(keyframe),
            signature: PreparedDescriptors::new(&features.signature()),
            features,
            lens: Intrinsics {
                width_px: 4,
                height_px: 4,
                fx: 4.0,
                fy: 4.0,
                cx: 2.0,
                cy: 2.0,
            },
            is_calibrated: true,
            distorted_pixels: Vec::new(),
            registered: (ix != 3).then_some(registered),
            measured: None,
            landmark_of: Vec::new(),
            matched: Vec::new(),
            failed_with: 0,
        };
        scene_of.views.push(view);
    }
    scene_of.submaps.push(Submap {
        views: (0..n).filter(|ix| *ix != 3).collect(),
        n_adjusted: 0,
        is_metric: false,
    });
    scene_of
}

#[test]
fn turns_between_views_that_follow_one_another_are_those_of_the_camera_without_the_bias() {
    let scene = scene(20, 1.0);
    let found = motions(&scene, 0, |view| Some(view as u32));
    assert_eq!(found.len(), 18);
    for motion in found {
        let [a, b] = [motion.first_ix, motion.second_ix].map(|ix| f64::from(ix) * VIEW_SECS);
        let truth = turned(a).inverse() * turned(b);
        let off = motion.first_from_second.rotation.angle_between(truth);
        assert!(off < 1.5e-3, "{motion:?} is off by {off}");
        assert!(motion.std[1] < 0.01 && motion.std[0] > 1e9);
    }
}

#[test]
fn a_start_whose_turns_are_others_does_not_fit() {
    let scene = scene(9, 1.0);
    let poses = |wrong: f64| -> BTreeMap<usize, Rigid> {
        (0..9)
            .filter_map(|view| {
                let pose = world_from_cam(&scene, view)?;
                let wrong_turn = DQuat::from_rotation_x(wrong * (view as f64 * 1.3).sin());
                Some((
                    view,
                    Rigid::new(pose.rotation * wrong_turn, pose.translation),
                ))
            })
            .collect()
    };
    let (right, wrong) = (
        turn_misfit(&scene, &poses(0.0)),
        turn_misfit(&scene, &poses(0.1)),
    );
    assert!(right.unwrap() < 1.0, "{right:?}");
    assert!(wrong.is_none_or(|misfit| misfit > 3.0), "{wrong:?}");
}

#[test]
fn a_gyroscope_that_lies_has_no_part() {
    assert!(motions(&scene(20, 1.6), 0, |view| Some(view as u32)).is_empty());
}
