//! A topic -> pictures as CDR in a bounded queue, subscribed as raw or compressed as there is somebody to send either.
//!
//! The node's thread fills the queue, of which the oldest go first; the source's thread takes from it.

use r2r::QosProfile;

use crate::clock::{Stamp, Stopwatch};
use crate::config::ros2::{ImageTransport, Reliability};
use crate::queue::{Receiver, WhenFull, queue};
use crate::ros::{CompressedImage, Image, Message as _};
use crate::source::ros2::link::{Link, LinkError};
use crate::source::survey::header_stamp;

/// Pictures between the node's thread and the source's: a burst passes, and none is old when it is decoded.
const MAX_PICTURES: usize = 4;
/// Pictures that the middleware keeps until the node's thread takes them.
const MAX_IN_MIDDLEWARE: usize = 10;

/// A picture as it came.
#[derive(Debug)]
pub(super) struct Picture {
    /// `None` where not even the header can be read.
    pub(super) stamp: Option<Stamp>,
    pub(super) payload: Vec<u8>,
    pub(super) age: Stopwatch,
}

/// The subscription, once it is known as what type.
#[derive(Debug)]
pub(super) struct Subscription {
    pub(super) topic: String,
    pub(super) is_compressed: bool,
    pub(super) pictures: Receiver<Picture>,
}

impl Subscription {
    /// `None` while nobody publishes the topic and no parameter says as what to subscribe it.
    pub(super) fn of(link: &Link, topic: &str) -> Result<Option<Self>, LinkError> {
        let transport = link.live.choice("ros2.image_transport");
        let Some((topic, is_compressed)) = choose(link, topic, transport)? else {
            return Ok(None);
        };
        let (sender, pictures) = queue("ros2 pictures", MAX_PICTURES, WhenFull::DropOldest);
        let qos = match link.live.choice("ros2.reliability") {
            Reliability::BestEffort => QosProfile::sensor_data(),
            Reliability::Reliable => QosProfile::default(),
        };
        let qos = qos.keep_last(MAX_IN_MIDDLEWARE);
        let type_name = type_name(is_compressed);
        link.subscribe(&topic, type_name, qos, move |payload| {
            let picture = Picture {
                stamp: header_stamp(&payload, 0),
                payload,
                age: Stopwatch::start(),
            };
            sender.send(picture).is_ok()
        })?;
        tracing::info!("{topic} is subscribed as {type_name}");
        Ok(Some(Self {
            topic,
            is_compressed,
            pictures,
        }))
    }
}

/// Topic, and whether it is a CompressedImage. Compressed pictures of TOPIC are on TOPIC/compressed, as image_transport
/// has it.
fn choose(
    link: &Link,
    topic: &str,
    transport: ImageTransport,
) -> Result<Option<(String, bool)>, LinkError> {
    let is_named = topic.ends_with("/compressed");
    let beside = format!("{}/compressed", topic.trim_end_matches('/'));
    let type_on = |topic: &str| -> Result<Option<String>, LinkError> {
        let peers = link.publishers(topic)?;
        Ok(peers.into_iter().next().map(|peer| peer.type_name))
    };
    Ok(match transport {
        ImageTransport::Raw => Some((topic.to_owned(), false)),
        ImageTransport::Compressed if is_named => Some((topic.to_owned(), true)),
        ImageTransport::Compressed => Some((beside, true)),
        ImageTransport::Auto => match type_on(topic)? {
            Some(name) => Some((topic.to_owned(), name == CompressedImage::TYPE_NAME)),
            None if is_named => Some((topic.to_owned(), true)),
            None if type_on(&beside)?.is_some() => Some((beside, true)),
            None => None,
        },
    })
}

pub(super) fn type_name(is_compressed: bool) -> &'static str {
    if is_compressed {
        CompressedImage::TYPE_NAME
    } else {
        Image::TYPE_NAME
    }
}
