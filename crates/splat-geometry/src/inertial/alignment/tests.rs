use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use splat_types::inertial::ImuSample;
use splat_types::inertial::{ImuModel, ImuSpan};

const RATE_HZ: f64 = 200.0;
const METRES_PER_UNIT: f64 = 2.7;
const LEVER: DVec3 = DVec3::new(0.04, 0.02, -0.06);

/// A hand that carries a camera, in metres, z up; `eagerness` 0 is a steady walk straight on.
fn pose(secs: f64, eagerness: f64) -> Rigid {
    let wave = |hertz: f64, phase: f64| (std::f64::consts::TAU * hertz * secs + phase).sin();
    let place = DVec3::new(0.6 * secs, 0.1, 1.4)
        + eagerness
            * DVec3::new(
                0.1 * wave(0.5, 0.2),
                0.2 * wave(0.3, 1.0),
                0.04 * wave(1.6, 0.0),
            );
    let turn = eagerness
        * DVec3::new(
            0.1 * wave(0.4, 0.3),
            0.3 * wave(0.2, 1.0),
            0.1 * wave(0.7, 2.0),
        );
    let looking = DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X));
    Rigid::new(looking * DQuat::from_scaled_axis(turn), place)
}

struct Random(Pcg32);

impl Random {
    fn vector(&mut self, std: f64) -> DVec3 {
        let mut one = || {
            let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
            radius * (std::f64::consts::TAU * self.0.random::<f64>()).cos()
        };
        DVec3::new(one(), one(), one()) * std
    }
}

struct Way {
    eagerness: f64,
    noise: f64,
    /// Of places in metres, and of turns.
    seen_std: [f64; 2],
    /// The mount that is stated is off by that, and stamps by so many seconds.
    mount: DVec3,
    delay_secs: f64,
    secs: f64,
    seed: u64,
}

impl Default for Way {
    fn default() -> Self {
        Self {
            eagerness: 1.0,
            noise: 1.0,
            seen_std: [0.003, 0.001],
            mount: DVec3::ZERO,
            delay_secs: 0.0,
            secs: 15.0,
            seed: 1,
        }
    }
}

const BIAS: Bias = Bias {
    gyro: DVec3::new(0.012, -0.008, 0.005),
    accelerometer: DVec3::new(0.06, -0.04, 0.08),
};

/// The frame of the images' poses lies somehow in the true one, and has another unit.
fn world_from_true(pose: &Rigid) -> Rigid {
    let tilted = Rigid::new(
        DQuat::from_scaled_axis(DVec3::new(0.4, -0.9, 0.3)),
        DVec3::X,
    );
    let moved = tilted * *pose;
    Rigid::new(moved.rotation, moved.translation / METRES_PER_UNIT)
}

impl Way {
    fn log(&self, until: f64) -> ImuLog {
        let mut random = Random(Pcg32::seed_from_u64(self.seed));
        let noise = ImuNoise::default();
        let mounted = DQuat::from_scaled_axis(self.mount).inverse();
        let sample = |ix: i64| {
            let secs = ix as f64 / RATE_HZ + 0.0013;
            let imu =
                |off: f64| pose(secs + off, self.eagerness) * Rigid::new(DQuat::IDENTITY, LEVER);
            const H: f64 = 5e-4;
            let (a, b, c) = (imu(-H), imu(0.0), imu(H));
            let rate = (a.rotation.inverse() * c.rotation).to_scaled_axis() / (2.0 * H);
            let pull = (a.translation + c.translation - 2.0 * b.translation) / (H * H);
            let force = b.rotation.inverse() * (pull + GRAVITY * DVec3::Z);
            let root = RATE_HZ.sqrt() * self.noise;
            ImuSample {
                stamp: Stamp::from_secs(secs + self.delay_secs),
                angular_velocity: mounted * rate
                    + self.noise * BIAS.gyro
                    + random.vector(noise.gyro * root),
                acceleration: mounted * force
                    + self.noise * BIAS.accelerometer
                    + random.vector(noise.accelerometer * root),
            }
        };
        let n = (until * RATE_HZ) as i64;
        let mut log = ImuLog::new(1e3);
        log.push(&ImuSpan {
            samples: (-40..n + 40).map(sample).collect(),
            model: ImuModel {
                imu_in_cam: LEVER,
                ..ImuModel::default()
            },
        });
        log
    }

    fn frames(&self) -> Vec<PosedFrame> {
        let mut random = Random(Pcg32::seed_from_u64(self.seed + 100));
        let n = (self.secs * 8.0) as usize;
        let frame = |ix: usize| {
            let secs = ix as f64 / 8.0;
            let mut seen = world_from_true(&pose(secs, self.eagerness));
            seen.translation += random.vector(self.seen_std[0] / METRES_PER_UNIT);
            seen.rotation *= DQuat::from_scaled_axis(random.vector(self.seen_std[1]));
            PosedFrame {
                stamp: Stamp::from_secs(secs),
                world_from_cam: seen,
                std: [
                    self.seen_std[0].max(1e-6) / METRES_PER_UNIT,
                    self.seen_std[1].max(1e-7),
                ],
            }
        };
        (0..=n).map(frame).collect()
    }

    fn noise(&self) -> ImuNoise {
        let all = ImuNoise::default();
        ImuNoise {
            tilt: self.seen_std[1].max(1e-7),
            gyro: all.gyro * self.noise.max(1e-3),
            accelerometer: all.accelerometer * self.noise.max(1e-3),
            ..all
        }
    }

    fn aligned(&self) -> Result<InertialAlignment, Unaligned> {
        let log = self.log(self.secs + 2.0);
        align(&self.frames(), &log, &Calibration::default(), &self.noise())
    }
}

fn metric(found: &InertialAlignment) -> &MetricAlignment {
    found.metric.as_ref().unwrap()
}

fn tilt(found: &InertialAlignment) -> f64 {
    let up = world_from_true(&Rigid::IDENTITY).rotation * DVec3::Z;
    found.up.angle_between(up)
}

#[test]
fn exact_poses_and_samples_give_unit_gravity_and_biases() {
    let way = Way {
        noise: 0.0,
        seen_std: [0.0, 0.0],
        ..Way::default()
    };
    let found = way.aligned().unwrap();
    let unit = (metric(&found).metres_per_unit / METRES_PER_UNIT).ln();
    assert!(unit.abs() < 3e-4, "unit off by {unit}");
    assert!(tilt(&found) < 1e-4, "tilt {}", tilt(&found));
    assert!(found.calibration.bias.gyro.length() < 1e-5);
    assert!(found.calibration.bias.accelerometer.length() < 1e-3);
    assert!(found.calibration.delay_secs.abs() < 1e-5);
}

#[test]
fn noise_of_a_mems_sensor_leaves_a_percent_and_is_stated() {
    let (mut worst, mut squares) = (0.0_f64, [0.0; 2]);
    const N: u64 = 12;
    for seed in 0..N {
        let found = Way {
            seed: 10 * seed,
            ..Way::default()
        }
        .aligned()
        .unwrap();
        let unit = (metric(&found).metres_per_unit / METRES_PER_UNIT).ln();
        worst = worst.max(unit.abs());
        squares[0] += (unit / metric(&found).relative_std).powi(2) / N as f64;
        squares[1] += (tilt(&found) / found.tilt_std).powi(2) / N as f64;
        let gyro = found.calibration.bias.gyro.distance(BIAS.gyro);
        assert!(gyro < 1.5e-3, "seed {seed}: gyroscope's bias off by {gyro}");
        assert!(
            tilt(&found) < 0.3_f64.to_radians(),
            "{}",
            tilt(&found).to_degrees()
        );
        assert!(
            (0.5..1.5).contains(&metric(&found).misfit),
            "misfit {}",
            metric(&found).misfit
        );
    }
    assert!(worst < 0.01, "worst unit is off by {worst}");
    assert!((0.1..2.5).contains(&squares[0]), "unit: {squares:?}");
    assert!((0.3..4.0).contains(&squares[1]), "tilt: {squares:?}");
}

#[test]
fn a_mount_and_a_delay_that_are_off_are_found() {
    let way = Way {
        mount: DVec3::new(0.03, -0.02, 0.025),
        delay_secs: 0.012,
        ..Way::default()
    };
    let found = way.aligned().unwrap();
    let delay = found.calibration.delay_secs - way.delay_secs;
    assert!(delay.abs() < 2e-3, "delay off by {delay}");
    let mount = found.calibration.mount.distance(way.mount);
    assert!(
        mount < 0.015,
        "mount off by {mount}: {}",
        found.calibration.mount
    );
    assert!(
        (metric(&found).metres_per_unit / METRES_PER_UNIT)
            .ln()
            .abs()
            < 0.015
    );
}

#[test]
fn wrong_stamps_and_a_wrong_mount_are_refused() {
    let late = Way {
        delay_secs: 0.1,
        ..Way::default()
    };
    assert!(
        matches!(late.aligned(), Err(Unaligned::Delay(_))),
        "{:?}",
        late.aligned()
    );
    let turned = Way {
        mount: DVec3::X * 0.6,
        ..Way::default()
    };
    assert!(turned.aligned().is_err());
}

#[test]
fn a_steady_walk_shows_no_unit_and_says_so() {
    let found = Way {
        eagerness: 0.0,
        ..Way::default()
    }
    .aligned();
    {
        let found = found.unwrap();
        let has_unit = found.metric.as_ref().is_some_and(MetricAlignment::has_unit);
        assert!(!has_unit, "{found:?}");
        // Gravity shows all the same, to what the accelerometer may be off by.
        assert!(
            tilt(&found) < 3.0 * found.tilt_std && found.tilt_std < 0.03,
            "{found:?}"
        );
    }
}

#[test]
fn a_second_and_a_half_without_images_is_bridged() {
    let (mut worst, mut squares) = (0.0_f64, 0.0);
    const N: u64 = 12;
    for seed in 0..N {
        let way = Way {
            seed: 10 * seed + 3,
            ..Way::default()
        };
        let log = way.log(way.secs + 2.0);
        let found = way.aligned().unwrap();
        let at = found.stamp.secs() + 1.5;
        let seen = found
            .predict(&log, Stamp::from_secs(at), &way.noise())
            .unwrap();
        let truth = world_from_true(&pose(at, 1.0));
        let off = (seen.world_from_cam.translation - truth.translation) * METRES_PER_UNIT;
        worst = worst.max(off.length());
        let units = off / METRES_PER_UNIT;
        squares += units.dot(seen.place_covariance.inverse() * units) / (3 * N) as f64;
        let turn = seen.world_from_cam.angle_to(&truth);
        assert!(turn < 0.01, "turn off by {turn}");
    }
    assert!(worst < 0.05, "off by {worst} m after 1.5 s");
    assert!((0.2..2.0).contains(&squares), "squares per axis {squares}");
}

#[test]
fn gaps_leave_what_is_known_before_and_after() {
    let way = Way::default();
    let whole = way.log(way.secs + 2.0).span();
    let is_there = |s: &ImuSample| !(5.0..5.6).contains(&s.stamp.secs());
    let mut log = ImuLog::new(1e3);
    log.push(&ImuSpan {
        samples: whole.samples.iter().copied().filter(is_there).collect(),
        ..whole
    });
    let found = align_for_unit(&way.frames(), &log, &Calibration::default(), &way.noise()).unwrap();
    assert!(
        (metric(&found).metres_per_unit / METRES_PER_UNIT)
            .ln()
            .abs()
            < 0.015
    );
    // Several in a row, and one at the end.
    let is_there = |s: &ImuSample| !(5.0..8.0).contains(&s.stamp.secs()) && s.stamp.secs() < 13.0;
    let whole = way.log(way.secs + 2.0).span();
    let mut log = ImuLog::new(1e3);
    log.push(&ImuSpan {
        samples: whole.samples.iter().copied().filter(is_there).collect(),
        ..whole
    });
    let found = align_for_unit(&way.frames(), &log, &Calibration::default(), &way.noise()).unwrap();
    let unit = (metric(&found).metres_per_unit / METRES_PER_UNIT).ln();
    assert!(
        unit.abs() < 3.0 * metric(&found).relative_std && unit.abs() < 0.03,
        "{found:?}"
    );
    let none = ImuLog::new(10.0);
    let empty = align_for_unit(&way.frames(), &none, &Calibration::default(), &way.noise());
    assert_eq!(empty.err(), Some(Unaligned::Gaps));
}

/// Noise of forces, without any of places, makes plain regression find the unit too large.
#[test]
fn a_noisy_accelerometer_does_not_bias_the_unit() {
    const N: u64 = 16;
    let (mut mean, mut squares) = (0.0, 0.0);
    for seed in 0..N {
        let way = Way {
            noise: 6.0,
            seen_std: [0.001, 0.0003],
            seed: 10 * seed + 7,
            secs: 12.0,
            ..Way::default()
        };
        let found = way.aligned().unwrap();
        let unit = (metric(&found).metres_per_unit / METRES_PER_UNIT).ln();
        mean += unit / N as f64;
        squares += (unit / metric(&found).relative_std).powi(2) / N as f64;
    }
    assert!(mean.abs() < 0.01, "off by {mean} in the mean");
    assert!((0.3..2.5).contains(&squares), "{squares}");
}
