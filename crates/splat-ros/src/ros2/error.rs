//! Why the ROS 2 node does not do what it was asked for.

use std::time::Duration;

/// An order that took longer found the thread stuck in the middleware.
pub(crate) const MAX_ORDER: Duration = Duration::from_secs(5);

#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    #[error(
        "ROS 2 does not start: {reason}; check the arguments behind --ros-args and that ROS 2 is sourced"
    )]
    Start { reason: String },
    #[error("ROS 2 refuses {what}: {reason}")]
    Refused { what: String, reason: String },
    #[error("ROS 2 did not answer within {} s while asked for {what}", MAX_ORDER.as_secs())]
    Stuck { what: String },
    #[error("{0}")]
    Parameter(String),
}

pub(crate) fn start_error(reason: &dyn std::fmt::Display) -> LinkError {
    LinkError::Start {
        reason: reason.to_string(),
    }
}
