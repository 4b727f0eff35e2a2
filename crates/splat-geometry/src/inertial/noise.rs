//! What inertial sensors are off by.

use splat_types::inertial::ImuModel;

/// m/s^2, near enough anywhere on Earth (within 0.3 %).
pub const GRAVITY: f64 = 9.81;

/// Noise of an IMU, as data sheets state it, and of what is measured by the images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuNoise {
    /// rad/s per root of a hertz.
    pub gyro: f64,
    /// m/s^2 per root of a hertz.
    pub accelerometer: f64,
    /// Standard deviations of what either is off by all the time, rad/s and m/s^2.
    pub gyro_bias: f64,
    pub accelerometer_bias: f64,
    /// Of the tilt of a camera by its images, rad: gravity seen under it counts as acceleration.
    pub tilt: f64,
}

impl ImuNoise {
    /// Of an IMU whose densities are known.
    pub fn of(model: &ImuModel) -> Self {
        Self {
            gyro: model.gyro_noise,
            accelerometer: model.accelerometer_noise,
            gyro_bias: 0.05,
            accelerometer_bias: 0.15,
            tilt: 0.001,
        }
    }
}

/// Of MEMS sensors on robots and telephones.
impl Default for ImuNoise {
    fn default() -> Self {
        Self::of(&ImuModel::default())
    }
}
