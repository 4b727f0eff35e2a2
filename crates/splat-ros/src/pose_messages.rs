//! Pose of the robot -> pose, odometry and transforms.

use crate::error::PublishError;
use crate::odometry::{FrameTree, RobotPose};
use crate::params::{PublishParams, TfMode};
use crate::transport::{Delivery, Sample, Topic};
use splat_msgs::ros::odometry::{
    Covariance, Odometry, PoseWithCovariance, Twist, TwistWithCovariance,
};
use splat_msgs::ros::standard::PoseWithCovarianceStamped;
use splat_msgs::ros::{Header, TfMessage, TransformStamped, Vector3};
use splat_types::covariance::Covariance as Rows;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

pub static POSE: Topic = Topic::of::<PoseWithCovarianceStamped>("pose", Delivery::Newest);
pub static ODOMETRY: Topic = Topic::of::<Odometry>("odometry", Delivery::Newest);
pub static TF: Topic = Topic::of::<TfMessage>("/tf", Delivery::Reliable { depth: 100 });
pub static TOPICS: [&Topic; 3] = [&POSE, &ODOMETRY, &TF];

/// Variance of what is not known: so large that no filter goes by it.
const UNKNOWN: f64 = 1e6;

/// How messages of the robot's place are named and timed.
#[derive(Debug, Clone)]
pub struct LiveMessages {
    params: PublishParams,
}

impl LiveMessages {
    pub fn new(params: &PublishParams) -> Self {
        Self {
            params: params.clone(),
        }
    }

    pub fn pose(&self, at: &RobotPose) -> Result<Sample, PublishError> {
        let message = PoseWithCovarianceStamped {
            header: Header::new(at.stamp, &self.params.map_frame),
            pose: PoseWithCovariance {
                pose: at.map_from_base.into(),
                covariance: halves(&at.covariance),
            },
        };
        Sample::of(&POSE, at.stamp, &message)
    }

    /// In the odometry's frame, which never jumps; its twist is in the base's own axes.
    pub fn odometry(&self, at: &RobotPose) -> Result<Sample, PublishError> {
        let (linear, angular) = at.twist.unwrap_or_default();
        let variance = |i: usize| at.covariance[i][i].max(1e-9);
        let of_twist = |i: usize| {
            if at.twist.is_some() {
                variance(i)
            } else {
                UNKNOWN
            }
        };
        let diagonal = |value: &dyn Fn(usize) -> f64| -> Rows {
            std::array::from_fn(|i| std::array::from_fn(|j| if i == j { value(i) } else { 0.0 }))
        };
        let message = Odometry {
            header: Header::new(at.stamp, &self.params.odom_frame),
            child_frame_id: self.params.base_frame.clone(),
            pose: PoseWithCovariance {
                pose: at.odom_from_base.into(),
                covariance: halves(&at.covariance),
            },
            twist: TwistWithCovariance {
                twist: Twist {
                    linear: Vector3::from(linear),
                    angular: Vector3::from(angular),
                },
                covariance: halves(&diagonal(&of_twist)),
            },
        };
        Sample::of(&ODOMETRY, at.stamp, &message)
    }

    /// `None` where no transforms are wanted. `stamp` is now, by the clock of the data.
    pub fn transforms(
        &self,
        map_from_odom: &Rigid,
        at: &RobotPose,
        stamp: Stamp,
        world: &FrameTree,
    ) -> Result<Option<Sample>, PublishError> {
        let params = &self.params;
        let is_full = match params.tf {
            TfMode::Off => return Ok(None),
            TfMode::Full => true,
            TfMode::Odom => false,
            TfMode::Auto => !at.is_odom_given,
        };
        let forward_camera = Stamp::from_nanos(
            stamp
                .nanos
                .saturating_add((params.tf_tolerance * 1e9) as i64),
        );
        let link = |stamp, parent: &str, child: &str, pose: Rigid| TransformStamped {
            header: Header::new(stamp, parent),
            child_frame_id: child.to_owned(),
            transform: pose.into(),
        };
        let splats = world.map_from_world();
        let splats = Rigid::new(splats.rotation, splats.translation);
        let mut transforms = vec![
            link(
                forward_camera,
                &params.map_frame,
                &params.odom_frame,
                *map_from_odom,
            ),
            link(
                forward_camera,
                &params.map_frame,
                &params.splat_frame,
                splats,
            ),
        ];
        if is_full {
            transforms.push(link(
                at.stamp,
                &params.odom_frame,
                &params.base_frame,
                at.odom_from_base,
            ));
        }
        Sample::of(&TF, stamp, &TfMessage { transforms }).map(Some)
    }
}

fn halves(rows: &Rows) -> Covariance {
    let flat = rows.as_flattened();
    Covariance {
        upper: std::array::from_fn(|i| flat[i]),
        lower: std::array::from_fn(|i| flat[18 + i]),
    }
}
