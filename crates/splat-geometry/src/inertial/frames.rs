//! Poses by the images, and the samples between them as a calibration makes them.

use glam::{DQuat, DVec3};

use crate::inertial::noise::ImuNoise;
use crate::inertial::preintegration::{Bias, Preintegrated};
use splat_types::inertial::{ImuLog, ImuSample};
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// A pose by the images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosedFrame {
    pub stamp: Stamp,
    pub world_from_cam: Rigid,
    /// Standard deviations along each axis in units, and about each in radians.
    pub std: [f64; 2],
}

/// What the samples of a gyroscope and an accelerometer need before they are used.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Calibration {
    pub bias: Bias,
    /// A small turn that the samples need to be in the camera's axes.
    pub mount: DVec3,
    /// Seconds by which stamps of the IMU are late.
    pub delay_secs: f64,
}

impl Calibration {
    /// The same without the accelerometer's bias: an unknown of the filter, which takes forces as they were measured.
    pub(crate) fn with_measured_forces(&self) -> Self {
        Self {
            bias: Bias {
                accelerometer: DVec3::ZERO,
                ..self.bias
            },
            ..*self
        }
    }
}

/// Samples as they are before a calibration, from one time to another, calibrated.
fn samples(
    log: &ImuLog,
    calibration: &Calibration,
    (from, to): (Stamp, Stamp),
) -> Option<Vec<ImuSample>> {
    let late = (1e9 * calibration.delay_secs).round() as i64;
    let at = |stamp: Stamp| Stamp::from_nanos(stamp.nanos.saturating_add(late));
    let mut samples = log.between(at(from), at(to))?;
    let mount = DQuat::from_scaled_axis(calibration.mount);
    for sample in &mut samples {
        sample.stamp = Stamp::from_nanos(sample.stamp.nanos - late);
        sample.angular_velocity = mount * sample.angular_velocity;
        sample.acceleration = mount * sample.acceleration;
    }
    Some(samples)
}

/// The motion from one time to another with a calibration; `None` where the samples don't reach, or leave a gap.
pub fn integrated(
    log: &ImuLog,
    calibration: &Calibration,
    times: (Stamp, Stamp),
    noise: &ImuNoise,
) -> Option<Preintegrated> {
    let samples = samples(log, calibration, times)?;
    Some(Preintegrated::of(&samples, &calibration.bias, noise))
}
