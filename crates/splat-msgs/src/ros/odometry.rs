//! `nav_msgs/msg/Odometry` and what it is made of.

use serde::{Deserialize, Serialize};

use crate::ros::{
    Header, Message, Pose, Vector3, header_def, quaternion_def, separator, time_def, vector_defs,
};

/// 6x6 in rows, order x y z and the turns about them. Two halves, as serde has arrays of up to 32; on the wire they are one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Covariance {
    pub upper: [f64; 18],
    pub lower: [f64; 18],
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseWithCovariance {
    pub pose: Pose,
    pub covariance: Covariance,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Twist {
    pub linear: Vector3,
    pub angular: Vector3,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct TwistWithCovariance {
    pub twist: Twist,
    pub covariance: Covariance,
}

/// Pose of `child_frame_id` in the frame of the header, and its speed in its own axes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Odometry {
    pub header: Header,
    pub child_frame_id: String,
    pub pose: PoseWithCovariance,
    pub twist: TwistWithCovariance,
}

impl Message for Odometry {
    const TYPE_NAME: &'static str = "nav_msgs/msg/Odometry";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n",
        "geometry_msgs/TwistWithCovariance twist\n",
        header_def!(),
        separator!(),
        "MSG: geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n",
        separator!(),
        "MSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n",
        vector_defs!("Point"),
        quaternion_def!(),
        separator!(),
        "MSG: geometry_msgs/TwistWithCovariance\nTwist twist\nfloat64[36] covariance\n",
        separator!(),
        "MSG: geometry_msgs/Twist\nVector3 linear\nVector3 angular\n",
        vector_defs!("Vector3")
    );
}
