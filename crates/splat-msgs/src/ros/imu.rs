//! `sensor_msgs/msg/Imu`.

use serde::{Deserialize, Serialize};

use crate::ros::{
    Header, Message, Quaternion, Vector3, header_def, quaternion_def, separator, time_def,
    vector_defs,
};

/// Orientation, angular velocity in rad/s and specific force in m/s^2. The first element of a covariance is -1 where the
/// measurement does not exist, and all are 0 where nothing is known of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Imu {
    pub header: Header,
    pub orientation: Quaternion,
    pub orientation_covariance: [f64; 9],
    pub angular_velocity: Vector3,
    pub angular_velocity_covariance: [f64; 9],
    pub linear_acceleration: Vector3,
    pub linear_acceleration_covariance: [f64; 9],
}

impl Message for Imu {
    const TYPE_NAME: &'static str = "sensor_msgs/msg/Imu";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n",
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n",
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
        header_def!(),
        quaternion_def!(),
        vector_defs!("Vector3")
    );
}
