//! ROS 2 messages -> an MCAP file.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};
use serde::Serialize;

use splat_msgs::ros::{self, CameraInfo, Header, Message};
use splat_types::camera::{CameraModel, Distortion};

/// One topic of the file under way.
#[derive(Debug, Clone, Copy)]
pub struct Topic {
    channel_id: u16,
    sequence: u32,
}

/// A file under way; errors say what the library says.
pub struct BagWriter<W: Write + Seek> {
    file: mcap::Writer<W>,
    pub n_messages: u64,
}

impl<W: Write + Seek> std::fmt::Debug for BagWriter<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "BagWriter({} messages)", self.n_messages)
    }
}

/// How our files are written: one thread packs, so that the bytes do not depend on the machine.
pub fn options(compression_level: u32) -> WriteOptions {
    WriteOptions::new()
        .profile("ros2")
        .library(concat!("splat-mapper ", env!("CARGO_PKG_VERSION")))
        .compression((compression_level > 0).then_some(Compression::Zstd))
        .compression_level(compression_level)
        .compression_threads(0)
}

impl<W: Write + Seek> BagWriter<W> {
    pub fn new(options: WriteOptions, to: W) -> Result<Self, String> {
        Ok(Self {
            file: options.create(to).map_err(|e| e.to_string())?,
            n_messages: 0,
        })
    }

    pub fn topic<T: Message>(&mut self, name: &str) -> Result<Topic, String> {
        self.topic_of(name, T::TYPE_NAME, T::DEFINITION)
    }

    /// `definition` in `ros2msg` form.
    pub fn topic_of(
        &mut self,
        name: &str,
        type_name: &str,
        definition: &str,
    ) -> Result<Topic, String> {
        let schema = self
            .file
            .add_schema(type_name, "ros2msg", definition.as_bytes());
        let schema = schema.map_err(|e| e.to_string())?;
        let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())]);
        let channel_id = self
            .file
            .add_channel(schema, name, "cdr", &metadata)
            .map_err(|e| e.to_string())?;
        Ok(Topic {
            channel_id,
            sequence: 0,
        })
    }

    pub fn write<T: Message + Serialize>(
        &mut self,
        topic: &mut Topic,
        nanos: u64,
        message: &T,
    ) -> Result<(), String> {
        let payload = ros::encode(message).map_err(|e| e.to_string())?;
        self.write_payload(topic, nanos, &payload)
    }

    /// A message that is CDR already.
    pub fn write_payload(
        &mut self,
        topic: &mut Topic,
        nanos: u64,
        payload: &[u8],
    ) -> Result<(), String> {
        let header = MessageHeader {
            channel_id: topic.channel_id,
            sequence: topic.sequence,
            log_time: nanos,
            publish_time: nanos,
        };
        topic.sequence = topic.sequence.wrapping_add(1);
        self.n_messages += 1;
        self.file
            .write_to_known_channel(&header, payload)
            .map_err(|e| e.to_string())
    }

    /// Ends the chunk and hands it on: a reader can read the file up to here.
    pub fn flush(&mut self) -> Result<(), String> {
        self.file.flush().map_err(|e| e.to_string())
    }

    /// Writes the index; nothing can be written behind it.
    pub fn finish(mut self) -> Result<W, String> {
        self.file.finish().map_err(|e| e.to_string())?;
        Ok(self.file.into_inner())
    }
}

/// ROS counts pixel centres at integers, half a pixel less than we do.
pub fn camera_info(lens: &CameraModel, header: Header) -> CameraInfo {
    let i = lens.intrinsics;
    let (cx, cy) = (i.cx - 0.5, i.cy - 0.5);
    let (distortion_model, d) = match lens.distortion {
        Distortion::None => ("plumb_bob", vec![0.0; 5]),
        Distortion::PlumbBob(d) => ("plumb_bob", d.to_vec()),
        Distortion::Rational(d) => ("rational_polynomial", d.to_vec()),
        Distortion::Equidistant(d) => ("equidistant", d.to_vec()),
    };
    CameraInfo {
        header,
        height: i.height_px,
        width: i.width_px,
        distortion_model: distortion_model.to_owned(),
        d,
        k: [i.fx, 0.0, cx, 0.0, i.fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [i.fx, 0.0, cx, 0.0, 0.0, i.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ..CameraInfo::default()
    }
}
