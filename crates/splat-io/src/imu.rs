//! Messages of an IMU -> what goes with each frame: samples in the camera's axes.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};

use crate::params::SourceParams;
use splat_msgs::ros::imu::Imu;
use splat_msgs::ros::{self, Vector3};
use splat_types::inertial::{ImuModel, ImuSample, ImuSpan};
use splat_types::time::Stamp;
use splat_types::transform::{Rigid, parse_transform};

/// Samples that wait for a frame: half a minute at 1,000 Hz.
const MAX_WAITING: usize = 30_000;
/// An IMU that is further behind the images is silent.
const WAITED_SECS: f64 = 0.3;
/// Beyond what MEMS sensors measure, rad/s and m/s^2.
const MAX_RATE: f64 = 100.0;
const MAX_ACCELERATION: f64 = 500.0;

/// How an IMU is mounted, and its noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MountedImu {
    /// Turns the axes of the IMU into those of the camera.
    turn: DQuat,
    model: ImuModel,
}

impl MountedImu {
    pub fn new(cam_from_imu: &Rigid, params: &SourceParams) -> Self {
        Self {
            turn: cam_from_imu.rotation,
            model: ImuModel {
                imu_in_cam: cam_from_imu.translation,
                gyro_noise: params.imu_gyro_noise,
                accelerometer_noise: params.imu_accelerometer_noise,
            },
        }
    }
}

/// Samples that came and belong to no frame yet, in the axes of the IMU.
#[derive(Debug, Default)]
pub struct ImuBuffer {
    samples: VecDeque<ImuSample>,
    frame_id: String,
    n_left_out: u64,
}

impl ImuBuffer {
    /// Takes a `sensor_msgs/Imu`. Samples that are no numbers, beyond what such a sensor measures, or not newer than the last are left
    /// out.
    pub fn push(&mut self, payload: &[u8]) -> Result<(), String> {
        let message: Imu = ros::decode(payload).map_err(|e| e.to_string())?;
        let sample = sample_of(&message).inspect_err(|_| self.n_left_out += 1)?;
        if self.newest().is_some_and(|newest| sample.stamp <= newest) {
            self.n_left_out += 1;
            return Err(format!("its stamp {} is not after the last", sample.stamp));
        }
        if self.samples.len() >= MAX_WAITING {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        if self.frame_id != message.header.frame_id {
            self.frame_id = message.header.frame_id;
        }
        Ok(())
    }

    pub fn newest(&self) -> Option<Stamp> {
        self.samples.back().map(|s| s.stamp)
    }

    /// Whether samples up to a frame are still on their way. One that has been silent for a while is not waited for.
    pub fn is_behind(&self, stamp: Stamp) -> bool {
        self.newest()
            .is_some_and(|newest| newest < stamp && stamp.secs_since(newest) < WAITED_SECS)
    }

    /// The frame that the messages name; empty before the first.
    pub fn frame_id(&self) -> &str {
        &self.frame_id
    }

    /// What goes with a frame: all since the frame before, and the last before that. `None` where nothing is newer than the frame
    /// before.
    pub fn take_until(&mut self, stamp: Stamp, mounted: &MountedImu) -> Option<ImuSpan> {
        // The first one that is not before the frame ends it.
        let before = self.samples.partition_point(|s| s.stamp < stamp);
        let end = (before + 1).min(self.samples.len());
        if end < 2 {
            return None;
        }
        let in_cam = |s: &ImuSample| ImuSample {
            stamp: s.stamp,
            angular_velocity: mounted.turn * s.angular_velocity,
            acceleration: mounted.turn * s.acceleration,
        };
        let samples = self.samples.range(..end).map(in_cam).collect();
        // The next frame begins with the last sample before this one.
        self.samples.drain(..before.saturating_sub(1).min(end - 1));
        Some(ImuSpan {
            samples,
            model: mounted.model,
        })
    }

    /// Time begins anew.
    pub fn clear(&mut self) {
        self.samples.clear();
    }
}

fn sample_of(message: &Imu) -> Result<ImuSample, String> {
    let is_absent = |covariance: &[f64; 9]| covariance[0] < 0.0;
    for (what, covariance) in [
        ("angular velocity", &message.angular_velocity_covariance),
        (
            "linear acceleration",
            &message.linear_acceleration_covariance,
        ),
    ] {
        if is_absent(covariance) {
            return Err(format!("it says that it has no {what} (covariance -1)"));
        }
    }
    let vector = |v: Vector3| DVec3::new(v.x, v.y, v.z);
    let angular_velocity = vector(message.angular_velocity);
    let acceleration = vector(message.linear_acceleration);
    let is_possible =
        angular_velocity.length() < MAX_RATE && acceleration.length() < MAX_ACCELERATION;
    // NaN is not less than anything.
    if !is_possible {
        return Err(format!(
            "{angular_velocity} rad/s and {acceleration} m/s^2 are beyond what an IMU measures"
        ));
    }
    Ok(ImuSample {
        stamp: message.header.stamp.into(),
        angular_velocity,
        acceleration,
    })
}

/// How the IMU is mounted by `source.imu_extrinsic`, `cam_from_imu`; `None` where it is empty.
pub fn extrinsic_of(params: &SourceParams) -> Result<Option<Rigid>, String> {
    let text = params.imu_extrinsic.trim();
    if text.is_empty() {
        return Ok(None);
    }
    let mounted = parse_transform(text).ok_or_else(|| {
        format!(
            "source.imu_extrinsic is {text:?}, expected seven numbers \"x y z qx qy qz qw\": metres and a quaternion"
        )
    })?;
    Ok(Some(mounted))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn payload(nanos: i64, change: impl Fn(&mut Imu)) -> Vec<u8> {
        let mut message = Imu::default();
        message.header.stamp = Stamp::from_nanos(nanos).into();
        message.header.frame_id = "imu_link".to_owned();
        message.angular_velocity.x = 0.5;
        message.linear_acceleration.z = 9.81;
        change(&mut message);
        ros::encode(&message).unwrap()
    }

    fn millis(ms: i64) -> i64 {
        ms * 1_000_000
    }

    #[test]
    fn each_frame_gets_the_samples_since_the_frame_before_and_one_beyond_either_end() {
        let mut buffer = ImuBuffer::default();
        for ms in (0..100).step_by(10) {
            buffer.push(&payload(millis(ms), |_| ())).unwrap();
        }
        let cam_from_imu = Rigid::new(
            DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2),
            DVec3::X,
        );
        let mounted = MountedImu::new(&cam_from_imu, &SourceParams::default());
        let mut take = |ms: i64| {
            let span = buffer.take_until(Stamp::from_nanos(millis(ms)), &mounted)?;
            let stamps = span.samples.iter().map(|s| s.stamp.nanos / 1_000_000);
            Some((stamps.collect::<Vec<_>>(), span))
        };
        let (stamps, span) = take(33).unwrap();
        assert_eq!(stamps, [0, 10, 20, 30, 40]);
        assert_eq!(span.model.imu_in_cam, DVec3::X);
        let up = span.samples[0].acceleration;
        assert!(up.distance(-9.81 * DVec3::Y) < 1e-12, "{up}");
        assert_eq!(take(66).unwrap().0, [30, 40, 50, 60, 70]);
        assert_eq!(take(90).unwrap().0, [60, 70, 80, 90]);
        assert_eq!(take(120).unwrap().0, [80, 90]);
    }

    #[test]
    fn what_is_no_measurement_is_left_out_and_said() {
        let mut buffer = ImuBuffer::default();
        buffer.push(&payload(millis(10), |_| ())).unwrap();
        let faults: [&dyn Fn(&mut Imu); 4] = [
            &|m| m.angular_velocity.y = f64::NAN,
            &|m| m.linear_acceleration.x = 1e9,
            &|m| m.linear_acceleration_covariance[0] = -1.0,
            &|m| m.header.stamp = Stamp::from_nanos(millis(10)).into(),
        ];
        for fault in faults {
            assert!(buffer.push(&payload(millis(20), fault)).is_err());
        }
        assert!(buffer.push(&[0, 1, 0, 0, 9]).is_err());
        assert_eq!(buffer.n_left_out, 4);
        assert_eq!(buffer.newest(), Some(Stamp::from_nanos(millis(10))));
    }

    #[test]
    fn the_mount_is_seven_numbers() {
        let of = |text: &str| {
            extrinsic_of(&SourceParams {
                imu_extrinsic: text.to_owned(),
                ..SourceParams::default()
            })
        };
        assert_eq!(of(" "), Ok(None));
        let mounted = of("0.1 0 -0.2 0 0 0.7071 0.7071").unwrap().unwrap();
        assert!(mounted.translation.distance(DVec3::new(0.1, 0.0, -0.2)) < 1e-12);
        for wrong in ["1 2 3", "a b c d e f g", "0 0 0 0 0 0 0", "nan 0 0 0 0 0 1"] {
            assert!(of(wrong).unwrap_err().contains("seven numbers"), "{wrong}");
        }
    }
}
