use std::f64::consts::TAU;
use std::sync::Arc;

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use splat_types::image::RgbImage;
use splat_types::inertial::{ImuModel, ImuSample, ImuSpan};

const IMU_HZ: f64 = 200.0;
const FRAME_HZ: f64 = 15.0;
/// Metres in a unit of the map.
const UNIT: f64 = 0.5;

/// A hand in a room, in metres.
fn pose(secs: f64) -> Rigid {
    let wave = |hertz: f64, phase: f64| (TAU * hertz * secs + phase).sin();
    let place = DVec3::new(
        0.3 * wave(0.25, 0.0) + 0.05 * wave(0.9, 1.0),
        0.25 * wave(0.35, 0.4),
        1.4 + 0.05 * wave(1.3, 0.0),
    );
    let turn = DVec3::new(
        0.1 * wave(0.4, 0.3),
        0.3 * wave(0.2, 1.0),
        0.1 * wave(0.7, 2.0),
    );
    Rigid::new(DQuat::from_scaled_axis(turn), place)
}

fn world_from_cam(secs: f64) -> Rigid {
    let pose = pose(secs);
    Rigid::new(pose.rotation, pose.translation / UNIT)
}

struct Sensors {
    random: Pcg32,
}

impl Sensors {
    fn noise(&mut self, std: f64) -> DVec3 {
        let mut one = || {
            let radius = (-2.0 * (1.0 - self.random.random::<f64>()).ln()).sqrt();
            radius * (TAU * self.random.random::<f64>()).cos()
        };
        DVec3::new(one(), one(), one()) * std
    }

    fn sample(&mut self, secs: f64) -> ImuSample {
        const H: f64 = 5e-4;
        let [a, b, c] = [-H, 0.0, H].map(|off| pose(secs + off));
        let pull = (a.translation + c.translation - 2.0 * b.translation) / (H * H);
        let rate = (a.rotation.inverse() * c.rotation).to_scaled_axis() / (2.0 * H);
        ImuSample {
            stamp: Stamp::from_secs(secs),
            angular_velocity: rate + DVec3::new(0.01, -0.02, 0.01) + self.noise(0.014),
            acceleration: b.rotation.inverse() * (pull + 9.81 * DVec3::Z)
                + DVec3::new(0.05, 0.02, -0.05)
                + self.noise(0.14),
        }
    }

    /// The samples of a frame as a fault makes them; `None` leaves one out.
    fn frame(&mut self, seq: u64, fault: impl Fn(ImuSample) -> Option<ImuSample>) -> Frame {
        let at = seq as f64 / FRAME_HZ;
        let first = ((at - 1.0 / FRAME_HZ) * IMU_HZ).floor() as i64;
        let last = (at * IMU_HZ).ceil() as i64;
        let samples = (first..=last).filter_map(|ix| fault(self.sample(ix as f64 / IMU_HZ)));
        Frame {
            seq,
            stamp: Stamp::from_secs(at),
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
        }
    }

    fn measured(&mut self, seq: u64) -> MeasuredFrame {
        let secs = seq as f64 / FRAME_HZ;
        let mut seen = world_from_cam(secs);
        seen.translation += self.noise(0.002 / UNIT);
        seen.rotation *= DQuat::from_scaled_axis(self.noise(0.001));
        MeasuredFrame {
            seq,
            stamp: Stamp::from_secs(secs),
            anchor: Anchor {
                keyframe_id: 0,
                key_from_cam: seen,
                unit: 1.0,
            },
        }
    }
}

fn by_anchor(anchor: &Anchor) -> Rigid {
    anchor.key_from_cam
}

/// Seconds after which the IMU was left out, and taken back, of 30.
fn run(fault: impl Fn(ImuSample) -> Option<ImuSample>) -> (Option<f64>, Option<f64>) {
    let mut sensors = Sensors {
        random: Pcg32::seed_from_u64(3),
    };
    let mut imu = InertialOdometry::default();
    let (mut out, mut back) = (None, None);
    for seq in 1..450 {
        imu.push(&sensors.frame(seq, &fault));
        imu.measured(sensors.measured(seq), 2.0 / UNIT, |anchor| {
            Some(by_anchor(anchor))
        });
        let secs = seq as f64 / FRAME_HZ;
        match imu.fault() {
            Some(_) if out.is_none() => out = Some(secs),
            None if out.is_some() && back.is_none() => back = Some(secs),
            _ => {}
        }
    }
    (out, back)
}

fn is_in(sample: &ImuSample, secs: std::ops::Range<f64>) -> bool {
    secs.contains(&sample.stamp.secs())
}

#[test]
fn an_imu_that_agrees_is_never_left_out() {
    assert_eq!(run(Some), (None, None));
}

#[test]
fn frozen_scaled_and_silent_imus_are_left_out_and_taken_back() {
    let frozen = |s: ImuSample| {
        Some(if is_in(&s, 10.0..15.0) {
            ImuSample {
                angular_velocity: DVec3::new(0.3, 0.1, 0.0),
                acceleration: DVec3::Z * 9.0,
                ..s
            }
        } else {
            s
        })
    };
    let scaled = |s: ImuSample| {
        Some(if is_in(&s, 10.0..15.0) {
            ImuSample {
                angular_velocity: 1.2 * s.angular_velocity,
                acceleration: 1.2 * s.acceleration,
                ..s
            }
        } else {
            s
        })
    };
    let silent = |s: ImuSample| (!is_in(&s, 10.0..15.0)).then_some(s);
    for (name, found) in [
        ("frozen", run(frozen)),
        ("scaled", run(scaled)),
        ("silent", run(silent)),
    ] {
        let (out, back) = (found.0.unwrap(), found.1.unwrap());
        assert!((10.5..12.6).contains(&out), "{name}: out after {out} s");
        assert!((15.0..28.0).contains(&back), "{name}: back after {back} s");
    }
}

#[test]
fn stamps_that_jump_by_a_tenth_of_a_second_are_noticed() {
    let late = |s: ImuSample| {
        let mut s = s;
        if s.stamp.secs() > 10.0 {
            s.stamp = Stamp::from_nanos(s.stamp.nanos + 100_000_000);
        }
        Some(s)
    };
    let out = run(late).0.unwrap();
    assert!((10.0..12.6).contains(&out), "out after {out} s");
}

/// The map moves and takes another unit while nothing is seen; the prediction goes with it.
#[test]
fn a_frame_without_an_image_stands_where_the_samples_lead() {
    let mut sensors = Sensors {
        random: Pcg32::seed_from_u64(5),
    };
    let mut imu = InertialOdometry::default();
    for seq in 1..220 {
        imu.push(&sensors.frame(seq, Some));
        if seq < 195 {
            imu.measured(sensors.measured(seq), 2.0 / UNIT, |anchor| {
                Some(by_anchor(anchor))
            });
        }
    }
    let secs = 217.0 / FRAME_HZ;
    let at = Stamp::from_secs(secs);
    let (linked, found) = imu
        .locate(at, 2.0 / UNIT, |anchor| Some(by_anchor(anchor)))
        .unwrap();
    let truth = world_from_cam(secs);
    let off = found.translation.distance(truth.translation) * UNIT;
    assert!(off < 0.05, "off by {off} m after 1.5 s");
    assert!(found.angle_to(&truth) < 0.01);
    let std = (0..3)
        .map(|i| linked.covariance[(i, i)])
        .sum::<f64>()
        .sqrt()
        * UNIT;
    assert!((0.3 * off..0.08).contains(&std), "off by {off}, said {std}");
    let moved = Rigid::new(DQuat::from_rotation_x(0.4), DVec3::new(3.0, -1.0, 2.0));
    let in_moved = |anchor: &Anchor| Some(moved * anchor.key_from_cam);
    let (_, again) = imu.locate(at, 2.0 / UNIT, in_moved).unwrap();
    let off = (moved.inverse() * again)
        .translation
        .distance(found.translation);
    assert!(off < 1e-9, "off by {off}");
}
