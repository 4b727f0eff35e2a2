//! A channel of a recording.

/// What a channel carries.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Channel {
    pub topic: String,
    /// The name of the schema, such as `sensor_msgs/msg/Image`; empty for none.
    pub type_name: String,
    /// `cdr` for ROS 2.
    pub message_encoding: String,
}
