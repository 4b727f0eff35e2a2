//! ROS 2 messages as CDR: the few definitions that recordings, sources and publishers share.
//!
//! Field order is the wire order of the ROS 2 Jazzy interface packages. A payload starts with the four byte
//! encapsulation header, which says little (CDR_LE) or big endian (CDR_BE). Knows nothing of files or networks.

pub mod odometry;

pub mod imu;

mod rigid;

pub mod standard;

pub mod navigation;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use splat_types::time::Stamp;

#[derive(Debug, thiserror::Error)]
pub enum CdrError {
    #[error("message of {found_bytes} bytes is too short for the 4 byte CDR header")]
    TooShort { found_bytes: usize },
    #[error(
        "CDR representation {found:#06x}, expected plain CDR (0x0000 big or 0x0001 little endian)"
    )]
    Representation { found: u16 },
    #[error("{type_name} does not decode: {reason}")]
    Decode {
        type_name: &'static str,
        reason: String,
    },
    #[error("{type_name} does not encode: {reason}")]
    Encode {
        type_name: &'static str,
        reason: String,
    },
}

/// A message type: its full ROS name and its definition text in `ros2msg` form.
pub trait Message {
    /// For example `sensor_msgs/msg/Image`.
    const TYPE_NAME: &'static str;
    /// The `.msg` text, dependencies appended behind `====` lines as rosbag2 writes them.
    const DEFINITION: &'static str;
}

/// CDR payload -> message. Extra bytes behind the message are allowed (rosbag2 pads), missing ones are an error.
/// Lists grow as their content is read, never by a number that only claims it.
pub fn decode<T: Message + DeserializeOwned>(payload: &[u8]) -> Result<T, CdrError> {
    decode_as(payload, T::TYPE_NAME)
}

/// The same for parts of a service, which are no messages of their own.
pub fn decode_plain<T: DeserializeOwned>(payload: &[u8]) -> Result<T, CdrError> {
    decode_as(payload, std::any::type_name::<T>())
}

fn decode_as<T: DeserializeOwned>(payload: &[u8], type_name: &'static str) -> Result<T, CdrError> {
    let Some((header, body)) = payload.split_first_chunk::<4>() else {
        return Err(CdrError::TooShort {
            found_bytes: payload.len(),
        });
    };
    let message = match u16::from_be_bytes([header[0], header[1]]) {
        0 => cdr_encoding::from_bytes::<T, byteorder::BigEndian>(body),
        1 => cdr_encoding::from_bytes::<T, byteorder::LittleEndian>(body),
        found => return Err(CdrError::Representation { found }),
    };
    message
        .map(|(message, _)| message)
        .map_err(|e| CdrError::Decode {
            type_name,
            reason: e.to_string(),
        })
}

/// Message -> little-endian CDR payload with header.
pub fn encode<T: Message + Serialize>(message: &T) -> Result<Vec<u8>, CdrError> {
    encode_plain(message)
}

/// The same for parts of a service.
pub fn encode_plain<T: Serialize>(message: &T) -> Result<Vec<u8>, CdrError> {
    let body = cdr_encoding::to_vec::<T, byteorder::LittleEndian>(message).map_err(|e| {
        CdrError::Encode {
            type_name: std::any::type_name::<T>(),
            reason: e.to_string(),
        }
    })?;
    let mut payload = Vec::with_capacity(body.len() + 4);
    payload.extend_from_slice(&[0, 1, 0, 0]);
    payload.extend_from_slice(&body);
    Ok(payload)
}

/// `builtin_interfaces/msg/Time`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Time {
    pub sec: i32,
    pub nanosec: u32,
}

impl From<Stamp> for Time {
    fn from(stamp: Stamp) -> Self {
        let sec = stamp.nanos.div_euclid(1_000_000_000);
        let sec = i32::try_from(sec).unwrap_or(if sec < 0 { i32::MIN } else { i32::MAX });
        Self {
            sec,
            nanosec: stamp.nanos.rem_euclid(1_000_000_000) as u32,
        }
    }
}

impl From<Time> for Stamp {
    fn from(time: Time) -> Self {
        Stamp::from_nanos(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
    }
}

/// `std_msgs/msg/Header`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    pub stamp: Time,
    pub frame_id: String,
}

impl Header {
    pub fn new(stamp: Stamp, frame: &str) -> Self {
        Self {
            stamp: stamp.into(),
            frame_id: frame.to_owned(),
        }
    }
}

/// `sensor_msgs/msg/Image`; rows top to bottom, `step` bytes each.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Image {
    pub header: Header,
    pub height: u32,
    pub width: u32,
    pub encoding: String,
    pub is_bigendian: u8,
    pub step: u32,
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

/// `sensor_msgs/msg/CompressedImage`; `format` such as `jpeg` or `rgb8; png compressed`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CompressedImage {
    pub header: Header,
    pub format: String,
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

/// `sensor_msgs/msg/RegionOfInterest`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RegionOfInterest {
    pub x_offset: u32,
    pub y_offset: u32,
    pub height: u32,
    pub width: u32,
    pub do_rectify: bool,
}

/// `sensor_msgs/msg/CameraInfo`; integer pixel coordinates are pixel centres.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraInfo {
    pub header: Header,
    pub height: u32,
    pub width: u32,
    pub distortion_model: String,
    pub d: Vec<f64>,
    pub k: [f64; 9],
    pub r: [f64; 9],
    pub p: [f64; 12],
    pub binning_x: u32,
    pub binning_y: u32,
    pub roi: RegionOfInterest,
}

/// `geometry_msgs/msg/Point` and `Vector3` share one wire form.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Vector3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

/// `geometry_msgs/msg/Quaternion`, order x y z w.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

impl Default for Quaternion {
    fn default() -> Self {
        Self {
            x: 0.0,
            y: 0.0,
            z: 0.0,
            w: 1.0,
        }
    }
}

/// `geometry_msgs/msg/Pose` (position, orientation) and `Transform` (translation, rotation) share one wire form.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    pub position: Vector3,
    pub orientation: Quaternion,
}

/// `geometry_msgs/msg/PoseStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseStamped {
    pub header: Header,
    pub pose: Pose,
}

/// `geometry_msgs/msg/TransformStamped`; `transform` maps child coordinates into the header's frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TransformStamped {
    pub header: Header,
    pub child_frame_id: String,
    pub transform: Pose,
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TfMessage {
    pub transforms: Vec<TransformStamped>,
}

macro_rules! separator {
    () => {
        "================================================================================\n"
    };
}
macro_rules! time_def {
    () => {
        concat!(
            separator!(),
            "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        )
    };
}
macro_rules! header_def {
    () => {
        concat!(
            separator!(),
            "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
            time_def!()
        )
    };
}
macro_rules! vector_defs {
    ($name:literal) => {
        concat!(
            separator!(),
            "MSG: geometry_msgs/",
            $name,
            "\nfloat64 x\nfloat64 y\nfloat64 z\n"
        )
    };
}
macro_rules! quaternion_def {
    () => {
        concat!(
            separator!(),
            "MSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
        )
    };
}
macro_rules! pose_def {
    () => {
        concat!(
            separator!(),
            "MSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n",
            vector_defs!("Point"),
            quaternion_def!()
        )
    };
}
macro_rules! image_body {
    () => {
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
    };
}
macro_rules! camera_info_body {
    () => {
        concat!(
            "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n",
            "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n"
        )
    };
}
macro_rules! region_def {
    () => {
        concat!(
            separator!(),
            "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
        )
    };
}
macro_rules! transform_stamped_body {
    () => {
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"
    };
}
macro_rules! transform_defs {
    () => {
        concat!(
            separator!(),
            "MSG: geometry_msgs/Transform\nVector3 translation\nQuaternion rotation\n",
            vector_defs!("Vector3"),
            quaternion_def!()
        )
    };
}

// `publish/wire.rs` completes the definitions of msgs/ with these.
pub(crate) use {
    camera_info_body, header_def, image_body, pose_def, quaternion_def, region_def, separator,
    time_def, transform_defs, vector_defs,
};

impl Message for Image {
    const TYPE_NAME: &'static str = "sensor_msgs/msg/Image";
    const DEFINITION: &'static str = concat!(image_body!(), header_def!());
}

impl Message for CompressedImage {
    const TYPE_NAME: &'static str = "sensor_msgs/msg/CompressedImage";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nstring format\nuint8[] data\n",
        header_def!()
    );
}

impl Message for CameraInfo {
    const TYPE_NAME: &'static str = "sensor_msgs/msg/CameraInfo";
    const DEFINITION: &'static str = concat!(camera_info_body!(), header_def!(), region_def!());
}

impl Message for PoseStamped {
    const TYPE_NAME: &'static str = "geometry_msgs/msg/PoseStamped";
    const DEFINITION: &'static str = concat!(
        "std_msgs/Header header\nPose pose\n",
        header_def!(),
        pose_def!()
    );
}

impl Message for TransformStamped {
    const TYPE_NAME: &'static str = "geometry_msgs/msg/TransformStamped";
    const DEFINITION: &'static str =
        concat!(transform_stamped_body!(), header_def!(), transform_defs!());
}

impl Message for TfMessage {
    const TYPE_NAME: &'static str = "tf2_msgs/msg/TFMessage";
    const DEFINITION: &'static str = concat!(
        "geometry_msgs/TransformStamped[] transforms\n",
        separator!(),
        "MSG: geometry_msgs/TransformStamped\n",
        transform_stamped_body!(),
        header_def!(),
        transform_defs!()
    );
}
