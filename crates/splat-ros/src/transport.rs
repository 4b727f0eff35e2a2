//! What all transports to the world have in common: topics with their delivery, and bytes on their way.
//!
//! A transport (ROS 2, zenoh, a recording) carries CDR bytes and knows nothing of what they mean.

use std::sync::Arc;

use glam::DQuat;
use serde::Serialize;

use crate::error::PublishError;
use crate::plan::{Plan, PlanSink};
use splat_msgs::map_messages;
use splat_msgs::ros::Message;
use splat_types::correction::MapCorrection;
use splat_types::image::RgbImage;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stamp;
use splat_types::tracking::TrackedFrame;
use splat_types::transform::Similarity;
use splat_volume::grid::Grid;

/// How messages of a topic travel, as REP-2003 asks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Reliable; who joins late gets the newest so many.
    Latched { depth: usize },
    /// Reliable; late joiners ask a service for what they missed.
    Reliable { depth: usize },
    /// The newest counts, others may be lost: poses.
    Newest,
}

#[derive(Debug, PartialEq, Eq)]
pub struct Topic {
    /// `pose` stands below the node's own name, `/tf` stands alone.
    pub name: &'static str,
    /// Such as `nav_msgs/msg/Odometry`.
    pub type_name: &'static str,
    /// In `ros2msg` form.
    pub definition: &'static str,
    pub delivery: Delivery,
}

impl Topic {
    pub const fn of<T: Message>(name: &'static str, delivery: Delivery) -> Self {
        Self {
            name,
            type_name: T::TYPE_NAME,
            definition: T::DEFINITION,
            delivery,
        }
    }

    /// As ROS 2 and Foxglove show it: below the node's own name, unless it stands alone.
    pub(crate) fn full_name(&self, namespace: &str) -> String {
        if self.name.starts_with('/') {
            self.name.to_owned()
        } else {
            format!("/{namespace}/{}", self.name)
        }
    }
}

/// A message ready to go, as often as it is asked for.
#[derive(Debug, Clone)]
pub struct Sample {
    pub topic: &'static Topic,
    /// Of what the message is about.
    pub stamp: Stamp,
    /// CDR with its four byte header.
    pub payload: Arc<[u8]>,
}

impl Sample {
    /// A message on a topic, whose type must be the topic's.
    pub fn of<T: Message + Serialize>(
        topic: &'static Topic,
        stamp: Stamp,
        message: &T,
    ) -> Result<Self, PublishError> {
        assert_eq!(
            topic.type_name,
            T::TYPE_NAME,
            "{} carries its own type",
            topic.name
        );
        Ok(Self {
            topic,
            stamp,
            payload: map_messages::payload(message)?.into(),
        })
    }
}

/// What happens, for transports that make messages of their own.
#[derive(Debug, Clone, Copy)]
pub enum Event<'a> {
    /// The published map as clients hold it from now on.
    Map {
        snapshot: &'a Arc<Snapshot>,
        /// Takes the splat frame to the robot's map frame.
        map_from_world: Similarity,
    },
    /// What tracking says of a frame.
    Frame(&'a TrackedFrame),
    /// A keyframe's image, undistorted.
    Keyframe {
        stamp: Stamp,
        image: &'a Arc<RgbImage>,
    },
    /// The map has moved as a whole; the next map shows it.
    Correction(&'a MapCorrection),
    /// What is free and what is not.
    Grid {
        grid: &'a Grid,
        map_from_grid: DQuat,
        /// Of the ground in the frame of the grid, metres.
        ground: f64,
        /// Name of that frame.
        frame: &'a str,
    },
    /// A planner somewhere says where it means to go.
    Plan(&'a Plan),
}

/// A way out of the node. Called from several threads.
pub trait Transport: Send + Sync {
    /// Returns when the message is handed over; a slow peer may hold up messages of a reliable topic for a while.
    fn send(&self, post: &Sample) -> Result<(), PublishError>;

    /// Most make nothing of events: what they send is made for all of them.
    fn observe(&self, _event: &Event<'_>) {}

    /// Gives paths that planners publish on a topic to `sink`; most receive nothing.
    fn receive_plans(&self, _topic: &str, _sink: PlanSink) -> Result<(), PublishError> {
        Ok(())
    }

    /// Where peers may connect; none for most.
    fn endpoints(&self) -> Vec<String> {
        Vec::new()
    }

    /// Ends all that the transport has begun, within two seconds; later messages are left out.
    fn close(&self) -> Result<(), PublishError>;
}
