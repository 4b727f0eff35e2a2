//! Small recordings made in memory for tests: any message, any compression, either byte order.

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};
use serde::Serialize;

use splat_msgs::ros::{self, CameraInfo, CompressedImage, Header, Image, Message, PoseStamped};
use splat_types::time::Stamp;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Endian {
    Little,
    Big,
}

#[derive(Debug, Clone, Copy)]
pub struct BagForm {
    pub compression: Option<Compression>,
    pub is_chunked: bool,
    pub is_indexed: bool,
    pub endian: Endian,
    pub chunk_bytes: u64,
    pub schema_encoding: &'static str,
}

impl Default for BagForm {
    fn default() -> Self {
        Self {
            compression: None,
            is_chunked: true,
            is_indexed: true,
            endian: Endian::Little,
            chunk_bytes: 1 << 20,
            schema_encoding: "ros2msg",
        }
    }
}

pub struct BagWriter {
    form: BagForm,
    writer: Writer<Cursor<Vec<u8>>>,
    channels: BTreeMap<String, u16>,
}

impl BagWriter {
    pub fn new(form: BagForm) -> Self {
        let options = WriteOptions::new()
            .compression(form.compression)
            .use_chunks(form.is_chunked)
            .chunk_size(Some(form.chunk_bytes))
            .emit_summary_records(form.is_indexed)
            .emit_summary_offsets(form.is_indexed)
            .emit_message_indexes(form.is_indexed)
            .profile("ros2");
        Self {
            form,
            writer: options.create(Cursor::new(Vec::new())).unwrap(),
            channels: BTreeMap::new(),
        }
    }

    /// Encodes a message in the byte order of the bag.
    pub fn add<T: Message + Serialize>(&mut self, topic: &str, stamp: Stamp, message: &T) {
        let payload = payload_of(message, self.form.endian);
        self.add_payload(topic, T::TYPE_NAME, stamp, &payload);
    }

    /// Any bytes under any type name; the stamp is the log time.
    pub fn add_payload(&mut self, topic: &str, type_name: &str, stamp: Stamp, payload: &[u8]) {
        let channel_id = if let Some(&id) = self.channels.get(topic) {
            id
        } else {
            let schema = self
                .writer
                .add_schema(type_name, self.form.schema_encoding, b"# test")
                .unwrap();
            let id = self
                .writer
                .add_channel(schema, topic, "cdr", &BTreeMap::new())
                .unwrap();
            self.channels.insert(topic.to_owned(), id);
            id
        };
        let time = stamp.nanos.max(0) as u64;
        let header = MessageHeader {
            channel_id,
            sequence: 0,
            log_time: time,
            publish_time: time,
        };
        self.writer
            .write_to_known_channel(&header, payload)
            .unwrap();
    }

    pub fn finish(mut self) -> Vec<u8> {
        self.writer.finish().unwrap();
        self.writer.into_inner().into_inner()
    }
}

/// CDR bytes with their header.
pub fn payload_of<T: Message + Serialize>(message: &T, endian: Endian) -> Vec<u8> {
    match endian {
        Endian::Little => ros::encode(message).unwrap(),
        Endian::Big => {
            let mut payload = vec![0, 0, 0, 0];
            payload.extend(cdr_encoding::to_vec::<T, byteorder::BigEndian>(message).unwrap());
            payload
        }
    }
}

pub fn header(stamp: Stamp) -> Header {
    Header {
        stamp: stamp.into(),
        frame_id: "camera_optical".to_owned(),
    }
}

/// Rows without padding.
pub fn image(stamp: Stamp, encoding: &str, (width, height): (u32, u32), data: Vec<u8>) -> Image {
    let step = data.len() as u32 / height.max(1);
    Image {
        header: header(stamp),
        height,
        width,
        encoding: encoding.to_owned(),
        is_bigendian: 0,
        step,
        data,
    }
}

pub fn png(stamp: Stamp, size: (u32, u32), rgb: &[u8]) -> CompressedImage {
    let image = image::RgbImage::from_raw(size.0, size.1, rgb.to_vec()).unwrap();
    let mut data = Cursor::new(Vec::new());
    image.write_to(&mut data, image::ImageFormat::Png).unwrap();
    CompressedImage {
        header: header(stamp),
        format: "rgb8; png compressed bgr8".to_owned(),
        data: data.into_inner(),
    }
}

pub fn jpeg(stamp: Stamp, size: (u32, u32), rgb: &[u8]) -> CompressedImage {
    let mut data = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut data, 95);
    encoder
        .encode(rgb, size.0, size.1, image::ExtendedColorType::Rgb8)
        .unwrap();
    CompressedImage {
        header: header(stamp),
        format: "rgb8; jpeg compressed bgr8".to_owned(),
        data,
    }
}

/// Focal length 100 px, the middle of the image as principal point.
pub fn camera_info((width, height): (u32, u32), model: &str, d: &[f64]) -> CameraInfo {
    let (cx, cy) = (f64::from(width) / 2.0 - 0.5, f64::from(height) / 2.0 - 0.5);
    CameraInfo {
        height,
        width,
        distortion_model: model.to_owned(),
        d: d.to_vec(),
        k: [100.0, 0.0, cx, 0.0, 100.0, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [100.0, 0.0, cx, 0.0, 0.0, 100.0, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ..CameraInfo::default()
    }
}

pub fn pose(stamp: Stamp, x: f64) -> PoseStamped {
    let mut message = PoseStamped {
        header: header(stamp),
        ..PoseStamped::default()
    };
    message.header.frame_id = "map".to_owned();
    message.pose.position.x = x;
    message
}

/// The n-th tenth of a second after an arbitrary start.
pub fn tenth(n: i64) -> Stamp {
    Stamp::from_nanos(1_700_000_000_000_000_000 + n * 100_000_000)
}
