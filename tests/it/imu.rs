//! IMUs in recordings, and what they show together with poses.

use std::path::Path;

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use splat_geometry::inertial::alignment::{InertialAlignment, align_for_unit};
use splat_geometry::inertial::frames::{Calibration, PosedFrame};
use splat_geometry::inertial::noise::ImuNoise;
use splat_io::frame_source::Source as _;
use splat_io::mcap::McapSource;
use splat_io::params::SourceParams;
use splat_synth::imu::spans;
use splat_synth::settings::{SceneKind, SynthSettings};
use splat_synth::take::Take;
use splat_types::frame::Frame;
use splat_types::inertial::ImuLog;
use splat_types::transform::Rigid;

use crate::scenes::scene;

fn frames_of(recording: &Path) -> Vec<Frame> {
    let params = SourceParams {
        pose_topic: "/ground_truth/pose".to_owned(),
        ..SourceParams::default()
    };
    let mut source = McapSource::open(recording, &params).unwrap();
    std::iter::from_fn(|| source.next()).collect()
}

/// Aligns the true poses of frames, in a frame that lies aslant and in another unit.
fn aligned(frames: &[Frame], metres_per_unit: f64) -> (InertialAlignment, DVec3) {
    let aslant = DQuat::from_scaled_axis(DVec3::new(0.7, -0.4, 1.1));
    let mut log = ImuLog::new(1e3);
    for span in frames.iter().filter_map(|f| f.imu.as_ref()) {
        log.push(span);
    }
    let posed: Vec<PosedFrame> = frames
        .iter()
        .step_by(3)
        .filter_map(|frame| {
            let truth = Rigid::new(aslant, DVec3::Y) * frame.truth?;
            Some(PosedFrame {
                stamp: frame.stamp,
                world_from_cam: Rigid::new(truth.rotation, truth.translation / metres_per_unit),
                std: [0.002 / metres_per_unit, 0.001],
            })
        })
        .collect();
    let found = align_for_unit(&posed, &log, &Calibration::default(), &ImuNoise::default());
    (found.unwrap(), aslant * DVec3::Z)
}

#[test]
fn a_real_imu_shows_metres_gravity_and_its_biases() {
    let Some(scene) = scene("euroc_mh01") else {
        return;
    };
    let frames = frames_of(&scene.join("rosbag2"));
    let (found, up) = aligned(&frames, 0.4);
    let metric = found.metric.as_ref().unwrap();
    let unit = (metric.metres_per_unit / 0.4).ln();
    assert!(
        unit.abs() < 0.015 && metric.has_unit(),
        "unit off by {unit}"
    );
    // The reference itself has a mean force that stands 0.8 degrees off its vertical.
    let tilt = found.up.angle_between(up).to_degrees();
    assert!(tilt < 1.0, "gravity is off by {tilt} degrees");
    // The rates of the reference are these apart from the gyroscope's, in whatever axes.
    let bias = found.calibration.bias.gyro.length();
    let known = DVec3::new(-0.003, 0.021, 0.079).length();
    assert!(
        (bias - known).abs() < 1e-3,
        "bias {bias} instead of {known}"
    );
    assert!(found.calibration.delay_secs.abs() < 2e-3, "{found:?}");
    assert!(found.calibration.mount.length() < 5e-3, "{found:?}");
    assert!(metric.misfit < 1.5, "{found:?}");
}

/// A MEMS sensor on a hand in a room for 12 s, and poses that are off by 2 mm and half a milliradian: the bars of the whole, on exact
/// truth.
#[test]
fn a_synthetic_imu_shows_metres_and_gravity_to_what_is_stated() {
    const N: u64 = 6;
    let mut squares = 0.0;
    for seed in 0..N {
        let settings = SynthSettings {
            n_frames: 360,
            rate: Some(30.0),
            imu: Some(1.0),
            seed,
            ..SynthSettings::of(SceneKind::Room)
        };
        let take = Take::new(settings).unwrap();
        let mut log = ImuLog::new(1e3);
        spans(&take).iter().for_each(|span| log.push(span));
        let mut random = Pcg32::seed_from_u64(seed);
        let mut off = |std: f64| {
            let mut one = || {
                let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
                radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
            };
            DVec3::new(one(), one(), one()) * std
        };
        let posed = (0..360).step_by(2).map(|ix| {
            let mut pose = take.pose(ix);
            pose.translation += off(0.002);
            pose.rotation *= DQuat::from_scaled_axis(off(0.0005));
            PosedFrame {
                stamp: take.stamp(ix),
                world_from_cam: pose,
                std: [0.002, 0.0005],
            }
        });
        let posed: Vec<PosedFrame> = posed.collect();
        let found =
            align_for_unit(&posed, &log, &Calibration::default(), &ImuNoise::default()).unwrap();
        let metric = found.metric.as_ref().unwrap();
        let unit = metric.metres_per_unit.ln();
        let tilt = found.up.angle_between(DVec3::Z).to_degrees();
        assert!(unit.abs() < 0.012, "seed {seed}: unit off by {unit}");
        assert!(tilt < 0.3, "seed {seed}: gravity off by {tilt} degrees");
        assert!(
            (0.6..1.4).contains(&metric.misfit),
            "seed {seed}: {}",
            metric.misfit
        );
        squares += (unit / metric.relative_std).powi(2) / N as f64;
    }
    assert!((0.1..2.5).contains(&squares), "{squares}");
}
