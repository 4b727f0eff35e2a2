//! One pass over a recording before it is replayed: which topics it has, calibration, poses, transforms.
//!
//! A second reading costs little next to mapping, and spares the replay every question of what comes late.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use crate::bag::{Bag, Message};
use crate::calibration::lens_of_camera_info;
use crate::ground_truth::{Track, Transforms};
use splat_msgs::ros::imu::Imu;
use splat_msgs::ros::odometry::Odometry;
use splat_msgs::ros::{
    self, CameraInfo, CompressedImage, Image, Message as _, PoseStamped, TfMessage,
};
use splat_types::time::Stamp;

/// Topics that are looked at; the rest of a larger recording is passed over.
const MAX_TOPICS: usize = 2048;
/// Stamps kept per image topic, enough for its usual gap.
const MAX_STAMPS: usize = 1000;
/// Encodings of depth images.
const DEPTH_ENCODINGS: [&str; 3] = ["16UC1", "32FC1", "mono16"];

/// What is known of one topic that has messages.
#[derive(Debug, Default)]
pub(crate) struct Topic {
    pub type_name: String,
    pub message_encoding: String,
    pub n_messages: u64,
    /// Of the first images.
    pub stamps: Vec<Stamp>,
    /// Of the first image that decodes.
    pub frame_id: String,
    pub encoding: String,
}

impl Topic {
    pub(crate) fn is_cdr(&self) -> bool {
        self.message_encoding == "cdr"
    }

    pub(crate) fn is_image(&self) -> bool {
        self.is_cdr() && (self.type_name == Image::TYPE_NAME || self.is_compressed())
    }

    pub(crate) fn is_compressed(&self) -> bool {
        self.type_name == CompressedImage::TYPE_NAME
    }

    pub(crate) fn is_depth(&self) -> bool {
        let encoding = self.encoding.split(';').next().unwrap_or_default();
        DEPTH_ENCODINGS.contains(&encoding.trim())
    }
}

#[derive(Debug, Default)]
pub(crate) struct Survey {
    pub topics: BTreeMap<String, Topic>,
    /// The first of each topic that can be a calibration, else the first.
    pub infos: BTreeMap<String, CameraInfo>,
    pub poses: BTreeMap<String, Track>,
    /// (frame that moves, its poses) by topic.
    pub odometry: BTreeMap<String, (String, Track)>,
    pub transforms: Arc<Transforms>,
    pub fault: Option<String>,
    /// Poses or transforms beyond what is kept.
    pub has_left_out: bool,
}

impl Survey {
    pub(crate) fn of(files: Vec<PathBuf>) -> Self {
        let mut survey = Self::default();
        let mut bag = Bag::new(files);
        loop {
            match bag.next_message() {
                Ok(Some(message)) => survey.note(&message),
                Ok(None) => return survey,
                Err(fault) => {
                    survey.fault = Some(fault);
                    return survey;
                }
            }
        }
    }

    /// The topics for an error message: `/a (x/msg/Y), /b (z/msg/W)`.
    pub(crate) fn listing(&self) -> String {
        const MAX_LISTED: usize = 20;
        let describe = |(name, topic): (&String, &Topic)| {
            let encoding = if topic.is_cdr() {
                String::new()
            } else {
                format!(", encoded as {:?}", topic.message_encoding)
            };
            format!("{name} ({}{encoding})", topic.type_name)
        };
        let mut parts: Vec<String> = self.topics.iter().take(MAX_LISTED).map(describe).collect();
        if self.topics.len() > MAX_LISTED {
            parts.push(format!("and {} more", self.topics.len() - MAX_LISTED));
        }
        if parts.is_empty() {
            parts.push("no messages".to_owned());
        }
        parts.extend(self.fault.clone());
        parts.join(", ")
    }

    fn note(&mut self, message: &Message<'_>) {
        let channel = message.channel;
        if !self.topics.contains_key(&channel.topic) {
            if self.topics.len() >= MAX_TOPICS {
                return;
            }
            let topic = Topic {
                type_name: channel.type_name.clone(),
                message_encoding: channel.message_encoding.clone(),
                ..Topic::default()
            };
            self.topics.insert(channel.topic.clone(), topic);
        }
        let Some(topic) = self.topics.get_mut(&channel.topic) else {
            return;
        };
        topic.n_messages += 1;
        if !topic.is_cdr() {
            return;
        }
        match channel.type_name.as_str() {
            Image::TYPE_NAME | CompressedImage::TYPE_NAME => note_image(topic, message),
            CameraInfo::TYPE_NAME => self.note_info(message),
            PoseStamped::TYPE_NAME => {
                let Ok(pose) = ros::decode::<PoseStamped>(message.payload) else {
                    return;
                };
                let Some(gt_from_cam) = pose.pose.to_rigid() else {
                    return;
                };
                let track = self.poses.entry(channel.topic.clone()).or_default();
                self.has_left_out |= !track.insert(pose.header.stamp.into(), gt_from_cam);
            }
            Odometry::TYPE_NAME => self.note_odometry(message),
            Imu::TYPE_NAME if topic.frame_id.is_empty() => {
                if let Ok(imu) = ros::decode::<Imu>(message.payload) {
                    topic.frame_id = imu.header.frame_id;
                }
            }
            TfMessage::TYPE_NAME => {
                if let Ok(transforms) = ros::decode::<TfMessage>(message.payload) {
                    let is_static = channel.topic.ends_with("tf_static");
                    self.has_left_out |=
                        !Arc::make_mut(&mut self.transforms).insert(&transforms, is_static);
                }
            }
            _ => {}
        }
    }

    fn note_odometry(&mut self, message: &Message<'_>) {
        let Ok(odometry) = ros::decode::<Odometry>(message.payload) else {
            return;
        };
        let Some(odom_from_base) = odometry.pose.pose.to_rigid() else {
            return;
        };
        let topic = message.channel.topic.clone();
        let base = odometry.child_frame_id;
        let (_, track) = self
            .odometry
            .entry(topic)
            .or_insert_with(|| (base, Track::default()));
        self.has_left_out |= !track.insert(odometry.header.stamp.into(), odom_from_base);
    }

    fn note_info(&mut self, message: &Message<'_>) {
        let is_usable = |info: &CameraInfo| lens_of_camera_info(info, false).is_ok();
        if self
            .infos
            .get(&message.channel.topic)
            .is_some_and(is_usable)
        {
            return;
        }
        let Ok(info) = ros::decode::<CameraInfo>(message.payload) else {
            return;
        };
        if is_usable(&info) || !self.infos.contains_key(&message.channel.topic) {
            self.infos.insert(message.channel.topic.clone(), info);
        }
    }
}

fn note_image(topic: &mut Topic, message: &Message<'_>) {
    if topic.stamps.len() < MAX_STAMPS {
        topic
            .stamps
            .extend(header_stamp(message.payload, message.log_nanos));
    }
    if !topic.encoding.is_empty() {
        return;
    }
    if topic.is_compressed() {
        if let Ok(image) = ros::decode::<CompressedImage>(message.payload) {
            (topic.frame_id, topic.encoding) = (image.header.frame_id, image.format);
        }
    } else if let Ok(image) = ros::decode::<Image>(message.payload) {
        (topic.frame_id, topic.encoding) = (image.header.frame_id, image.encoding);
    }
}

/// Stamp of a message that begins with a header, without decoding the rest. Drivers that leave it zero get the time
/// at which the recorder saw the message.
pub fn header_stamp(payload: &[u8], log_nanos: i64) -> Option<Stamp> {
    let (&[_, endian, _, _], rest) = payload.split_first_chunk::<4>()?;
    let (&sec, rest) = rest.split_first_chunk::<4>()?;
    let (&nanosec, _) = rest.split_first_chunk::<4>()?;
    let time = match endian {
        0 => ros::Time {
            sec: i32::from_be_bytes(sec),
            nanosec: u32::from_be_bytes(nanosec),
        },
        1 => ros::Time {
            sec: i32::from_le_bytes(sec),
            nanosec: u32::from_le_bytes(nanosec),
        },
        _ => return None,
    };
    let stamp = Stamp::from(time);
    Some(if stamp.nanos == 0 {
        Stamp::from_nanos(log_nanos)
    } else {
        stamp
    })
}

/// Frame of a message that begins with a header, without decoding the rest.
#[cfg(feature = "live-messages")]
pub fn header_frame(payload: &[u8]) -> Option<String> {
    let (&[_, endian, _, _], rest) = payload.split_first_chunk::<4>()?;
    let (&length, rest) = rest.get(8..)?.split_first_chunk::<4>()?;
    let length = match endian {
        0 => u32::from_be_bytes(length),
        1 => u32::from_le_bytes(length),
        _ => return None,
    };
    // The text ends with a zero, which counts.
    let text = rest.get(..(length as usize).checked_sub(1)?)?;
    String::from_utf8(text.to_vec()).ok()
}
