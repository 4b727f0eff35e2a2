//! Silence -> its reason, in the log and for the status: no publisher, another type, QoS that does not suit, no calibration.

use std::collections::BTreeSet;
use std::time::Duration;

use crate::ros2::error::LinkError;
use crate::ros2::image_topic::type_name;
use crate::ros2::node::{Link, Peer};
use crate::ros2::parameter_store::Ros2Setup;
use crate::ros2::params::Reliability;
use splat_io::topics::info_beside;
use splat_msgs::ros::{CompressedImage, Image, Message as _};
use splat_types::time::Stopwatch;

/// The graph is asked so often while something is missing.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// With the defaults of Fast DDS a first announcement that is missed costs 3 s.
const DISCOVERY: Duration = Duration::from_secs(4);
/// Topics that an error message lists.
const MAX_LISTED: usize = 8;
/// Topics of which the publishers are asked.
const MAX_LOOKED_AT: usize = 32;
/// Warnings that are remembered as said.
const MAX_SAID: usize = 64;
/// What mends lost images of publishers that do send.
const LARGE_IMAGES: &str = "large images get lost where FASTRTPS_DEFAULT_PROFILES_FILE does not name launch/fastdds.xml on both sides (docs/ROS2.md)";

/// Topics on which somebody publishes images, by name: what there is to subscribe to.
fn image_topics(link: &Link) -> Vec<String> {
    let topics = link.topics().unwrap_or_default();
    let is_image = |types: &[String]| {
        types
            .iter()
            .any(|name| name == Image::TYPE_NAME || name == CompressedImage::TYPE_NAME)
    };
    let own = link.names.full_name();
    // The graph lists topics that are only listened to, by this node, too.
    let has_publisher = |topic: &String| {
        let peers = link.publishers(topic).unwrap_or_default();
        peers.iter().any(|peer| peer.node != own)
    };
    let images = topics.into_iter().filter(|(_, types)| is_image(types));
    images
        .map(|(topic, _)| topic)
        .take(MAX_LOOKED_AT)
        .filter(has_publisher)
        .take(MAX_LISTED)
        .collect()
}

/// What a look around finds: each topic with images, who publishes it and how, and whether a CameraInfo is beside it.
/// For those who ask before anything runs; takes as long as discovery may.
pub fn look_around() -> Result<Vec<String>, LinkError> {
    let link = Link::open("splat_mapper_doctor", |_| Ok(Ros2Setup::for_survey()))?;
    let watch = Stopwatch::start();
    while image_topics(&link).is_empty() && watch.elapsed() < DISCOVERY {
        std::thread::sleep(DISCOVERY / 20);
    }
    // Who publishes is known a little later than what.
    std::thread::sleep(DISCOVERY / 8);
    let describe = |topic: String| {
        let peers = link.publishers(&topic).unwrap_or_default();
        let Some(peer) = peers.first() else {
            return topic;
        };
        let reliability = if peer.is_reliable {
            "reliable"
        } else {
            "best effort"
        };
        let info = info_beside(&topic);
        let has_info = link.publishers(&info).is_ok_and(|peers| !peers.is_empty());
        let calibration = if has_info {
            "with CameraInfo".to_owned()
        } else {
            format!("no CameraInfo on {info}")
        };
        format!(
            "{topic} ({}, {reliability}, by {}, {calibration})",
            peer.type_name, peer.node
        )
    };
    Ok(image_topics(&link).into_iter().map(describe).collect())
}

/// Why nothing comes from a topic, as the graph has it.
pub(crate) fn why_silent(link: &Link, topic: &str, is_compressed: bool) -> String {
    let peers = link.publishers(topic).unwrap_or_default();
    let others = if peers.is_empty() {
        image_topics(link)
    } else {
        Vec::new()
    };
    let wanted = link.setup.params.reliability;
    reason(topic, type_name(is_compressed), wanted, &peers, &others)
}

/// Why nothing comes from publishers of a topic that is subscribed as `type_name`.
fn reason(
    topic: &str,
    type_name: &str,
    wanted: Reliability,
    peers: &[Peer],
    others: &[String],
) -> String {
    let Some(first) = peers.first() else {
        let listed: Vec<_> = others.iter().take(MAX_LISTED).map(String::as_str).collect();
        let listed = match listed.as_slice() {
            [] => "no topic with images is there; check ROS_DOMAIN_ID and that the camera runs"
                .to_owned(),
            some => format!("images are on {}", some.join(", ")),
        };
        return format!("nobody publishes {topic:?}: {listed}");
    };
    let fitting: Vec<&Peer> = peers.iter().filter(|p| p.type_name == type_name).collect();
    if fitting.is_empty() {
        return format!(
            "{} publishes {topic:?} as {}, expected {type_name}; see ros2.image_transport",
            first.node, first.type_name
        );
    }
    if wanted == Reliability::Reliable && fitting.iter().all(|p| !p.is_reliable) {
        return format!(
            "{} offers {topic:?} as best effort, and ros2.reliability=reliable does not receive that; set it to best_effort",
            fitting[0].node
        );
    }
    format!(
        "{} publishes {topic:?} and sends nothing, or what it sends does not arrive: {LARGE_IMAGES}",
        fitting[0].node
    )
}

/// Looks at what is missing and says each thing once.
#[derive(Debug)]
pub(crate) struct Watch {
    since_image: Stopwatch,
    since_look: Stopwatch,
    is_silent: bool,
    said: BTreeSet<String>,
}

impl Watch {
    pub(crate) fn new() -> Self {
        Self {
            since_image: Stopwatch::start(),
            since_look: Stopwatch::start(),
            is_silent: false,
            said: BTreeSet::new(),
        }
    }

    pub(crate) fn image_came(&mut self) {
        if self.is_silent {
            tracing::info!("images come again, after {:.1} s", self.since_image.secs());
            self.is_silent = false;
            self.said.clear();
        }
        self.since_image = Stopwatch::start();
    }

    pub(crate) fn silent_secs(&self) -> f64 {
        self.since_image.secs()
    }

    /// Whether the warnings are due for another look.
    pub(crate) fn is_due(&mut self) -> bool {
        let is_due = self.since_look.elapsed() >= LOOK_EVERY;
        if is_due {
            self.since_look = Stopwatch::start();
        }
        is_due
    }

    /// Logs what was not said before of this silence, and hands all of it to the status.
    pub(crate) fn report(
        &mut self,
        link: &Link,
        silence: Option<String>,
        mut warnings: Vec<String>,
    ) {
        self.is_silent |= silence.is_some();
        for warning in silence.iter().chain(&warnings) {
            if self.said.len() < MAX_SAID && self.said.insert(warning.clone()) {
                tracing::warn!("{warning}");
            }
        }
        let secs = self.since_image.secs().floor();
        warnings.extend(silence.map(|why| format!("no image for {secs} s: {why}")));
        link.warn(warnings);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(type_name: &str, is_reliable: bool) -> Peer {
        Peer {
            node: "/cam".to_owned(),
            type_name: type_name.to_owned(),
            is_reliable,
            is_latched: false,
        }
    }

    #[test]
    fn each_kind_of_silence_has_its_reason() {
        let say = |wanted, peers: &[Peer], others: &[String]| {
            reason("/image", Image::TYPE_NAME, wanted, peers, others)
        };
        let (loose, strict) = (Reliability::BestEffort, Reliability::Reliable);
        assert!(say(loose, &[], &[]).contains("ROS_DOMAIN_ID"));
        assert!(say(loose, &[], &["/other".to_owned()]).contains("images are on /other"));
        let compressed = peer(CompressedImage::TYPE_NAME, true);
        assert!(say(loose, &[compressed], &[]).contains("image_transport"));
        let best_effort = peer(Image::TYPE_NAME, false);
        let one = [best_effort];
        assert!(say(strict, &one, &[]).contains("best_effort"));
        assert!(say(loose, &one, &[]).contains("fastdds.xml"));
    }
}
