//! A topic -> images as CDR in a bounded queue, subscribed as raw or compressed as there is somebody to send either.
//!
//! The node's thread fills the queue, of which the oldest go first; the source's thread takes from it.

use r2r::QosProfile;

use crate::live_images::assembler::ReceivedImage;
use crate::ros2::error::LinkError;
use crate::ros2::node::Link;
use crate::ros2::params::{ImageTransport, Reliability};
use splat_io::queue::{Receiver, WhenFull, queue};
use splat_msgs::ros::{CompressedImage, Image, Message as _};

/// Images between the node's thread and the source's: a burst passes, and none is old when it is decoded.
const MAX_IMAGES: usize = 4;
/// Images that the middleware keeps until the node's thread takes them.
const MAX_IN_MIDDLEWARE: usize = 10;

/// The subscription, once it is known as what type.
#[derive(Debug)]
pub(crate) struct Subscription {
    pub(crate) topic: String,
    pub(crate) is_compressed: bool,
    pub(crate) images: Receiver<ReceivedImage>,
}

impl Subscription {
    /// `None` while nobody publishes the topic and no parameter says as what to subscribe it.
    pub(crate) fn of(link: &Link, topic: &str) -> Result<Option<Self>, LinkError> {
        let transport = link.setup.params.image_transport;
        let Some((topic, is_compressed)) = choose(link, topic, transport)? else {
            return Ok(None);
        };
        let (sender, images) = queue("ros2 images", MAX_IMAGES, WhenFull::DropOldest);
        let qos = match link.setup.params.reliability {
            Reliability::BestEffort => QosProfile::sensor_data(),
            Reliability::Reliable => QosProfile::default(),
        };
        let qos = qos.keep_last(MAX_IN_MIDDLEWARE);
        let type_name = type_name(is_compressed);
        link.subscribe(&topic, type_name, qos, move |payload| {
            sender.send(ReceivedImage::new(payload)).is_ok()
        })?;
        tracing::info!("{topic} is subscribed as {type_name}");
        Ok(Some(Self {
            topic,
            is_compressed,
            images,
        }))
    }
}

/// Topic, and whether it is a CompressedImage. Compressed images of TOPIC are on TOPIC/compressed, as image_transport
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

pub(crate) fn type_name(is_compressed: bool) -> &'static str {
    if is_compressed {
        CompressedImage::TYPE_NAME
    } else {
        Image::TYPE_NAME
    }
}
