//! ROS 2 messages as CDR, the messages of `splat_mapper_msgs`, their definitions and type hashes, and a client that puts
//! a map together from its chunks. No transport: bytes in, bytes out.

pub mod ros;

pub mod correction_message;

pub mod ellipsoid_message;

pub mod services;

pub mod status_message;

pub mod type_hash;

pub mod map_messages;

pub mod client;
