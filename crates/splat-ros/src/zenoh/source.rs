//! A topic with images over zenoh, as rmw_zenoh has it -> frames, with calibration, transforms, odometry and depth from the topics
//! beside it. Programs that publish CDR by themselves need no ROS 2: keys are `domain/topic/type/hash`, with any hash.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use zenoh::pubsub::Subscriber;
use zenoh::query::ConsolidationMode;
use zenoh::{Session, Wait};

use crate::live_images::assembler::{Assembler, Patience, ReceivedImage};
use crate::live_images::companions::{Beside, Kind};
use crate::params::PublishParams;
use crate::zenoh::names::Names;
use crate::zenoh::session::open_session;
use splat_io::error::SourceError;
use splat_io::frame_source::{MetricInput, Polled, Source, SourceCounts, next_polled};
use splat_io::imu::extrinsic_of;
use splat_io::params::SourceParams;
use splat_io::queue::{Received, Receiver, Sender, WhenFull, queue};
use splat_io::topics::info_topic_of;
use splat_msgs::ros::{CompressedImage, Image, Message as _};
use splat_types::frame::Frame;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

/// Images between zenoh's threads and the source's: a burst passes, and none is old when it is decoded.
const MAX_IMAGES: usize = 4;
/// How long images wait for a calibration, and for what goes with each: for that as long as `ros2.odometry_timeout` by default.
const PATIENCE: Patience = Patience {
    camera_info_secs: 3.0,
    companions_secs: 0.1,
};
/// Latched transforms are asked for so long.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Without an image for so long something is wrong.
const SILENT_SECS: f64 = 5.0;
/// Stamps that lie so far back belong to another time.
const JUMP_SECS: f64 = 1.0;
/// How often what an image waits for is looked at, and whether the end was asked for.
const TICK: Duration = Duration::from_millis(2);
const LOOK: Duration = Duration::from_millis(100);

/// An image, and whether it is a CompressedImage.
type Typed = (ReceivedImage, bool);

/// Images of a topic and what comes beside them.
#[derive(Debug)]
pub struct ZenohSource {
    images: Receiver<Typed>,
    assembler: Assembler,
    topic: String,
    base_frame: String,
    waiting: Option<Typed>,
    last_stamp: Option<Stamp>,
    since_image: Stopwatch,
    asked_to_end: Arc<AtomicBool>,
    is_ended: bool,
    /// Messages come as long as they are there.
    _live: Vec<Subscriber<()>>,
    _session: Session,
}

impl ZenohSource {
    /// `topic` as in `zenoh:/camera/image_raw`; the session connects, or looks for peers, by `publish.zenoh_*`. Images may begin to
    /// come at any time later, raw or compressed, on the topic or on `TOPIC/compressed`.
    pub fn open(
        topic: &str,
        params: &SourceParams,
        publish: &PublishParams,
    ) -> Result<Self, SourceError> {
        let fail = |reason: String| SourceError::Subscribe {
            topic: topic.to_owned(),
            reason,
        };
        if topic.trim_matches('/').is_empty() {
            let reason = "a topic is wanted, such as zenoh:/camera/image_raw";
            return Err(fail(reason.to_owned()));
        }
        extrinsic_of(params).map_err(fail)?;
        let info_topic = info_topic_of(&params.camera_info_topic, topic);
        // The publisher has a session of its own, which listens.
        let publish = PublishParams {
            zenoh_listen: String::new(),
            ..publish.clone()
        };
        let names = Names::new(&publish).map_err(|e| fail(e.to_string()))?;
        let (session, _) = open_session(&publish).map_err(|e| fail(e.to_string()))?;
        let beside = Beside::new(params, &info_topic, &publish.odom_frame);
        let (sender, images) = queue("zenoh images", MAX_IMAGES, WhenFull::DropOldest);
        let live = subscribe(&session, &names, (topic, &beside), &Arc::new(sender));
        Ok(Self {
            images,
            _live: live.map_err(fail)?,
            assembler: Assembler::new(topic, params, beside),
            topic: topic.to_owned(),
            base_frame: publish.base_frame,
            waiting: None,
            last_stamp: None,
            since_image: Stopwatch::start(),
            asked_to_end: Arc::default(),
            is_ended: false,
            _session: session,
        })
    }

    fn next_image(&mut self, patience: Duration) -> Option<Typed> {
        match self.images.recv_timeout(patience.min(LOOK)) {
            Received::Item(image) => {
                self.since_image = Stopwatch::start();
                Some(image)
            }
            Received::Nothing => None,
            Received::Ended => {
                self.is_ended = true;
                None
            }
        }
    }

    /// Whether the input ends here, since the image comes from another time.
    fn jumps(&self, image: &ReceivedImage) -> bool {
        let stamps = self.last_stamp.zip(image.stamp);
        let back = stamps.filter(|(last, new)| last.secs_since(*new) > JUMP_SECS);
        if let Some((last, new)) = back {
            tracing::warn!("time jumped back from {last} to {new}: the input ends");
        }
        back.is_some()
    }
}

/// Subscribes the images, raw and compressed, and what comes beside them.
fn subscribe(
    session: &Session,
    names: &Names,
    (topic, beside): (&str, &Beside),
    images: &Arc<Sender<Typed>>,
) -> Result<Vec<Subscriber<()>>, String> {
    let mut live = Vec::new();
    let compressed = format!("{}/compressed", topic.trim_end_matches('/'));
    for (topic, is_compressed) in [(topic, false), (topic, true), (&compressed, true)] {
        let type_name = if is_compressed {
            CompressedImage::TYPE_NAME
        } else {
            Image::TYPE_NAME
        };
        let key = names.incoming_key_of(topic, type_name);
        let images = Arc::clone(images);
        let subscriber = session.declare_subscriber(&key).callback(move |sample| {
            let payload = sample.payload().to_bytes().into_owned();
            // Whoever took them has ended.
            images
                .send((ReceivedImage::new(payload), is_compressed))
                .ok();
        });
        live.push(subscriber.wait().map_err(|e| e.to_string())?);
    }
    for topic in beside.topics() {
        let key = names.incoming_key_of(&topic.name, topic.type_name);
        let sink = Arc::new(beside.sink(topic.kind));
        let on_sample = Arc::clone(&sink);
        let subscriber = session.declare_subscriber(&key).callback(move |sample| {
            on_sample(sample.payload().to_bytes().into_owned());
        });
        live.push(subscriber.wait().map_err(|e| e.to_string())?);
        if topic.kind == Kind::StaticTransforms {
            // Latched: those who published before answer.
            let query = session.get(&key).consolidation(ConsolidationMode::None);
            let query = query.timeout(QUERY_TIMEOUT).callback(move |reply| {
                if let Ok(sample) = reply.into_result() {
                    sink(sample.payload().to_bytes().into_owned());
                }
            });
            query.wait().map_err(|e| e.to_string())?;
        }
    }
    Ok(live)
}

impl Source for ZenohSource {
    fn next(&mut self) -> Option<Frame> {
        next_polled(self)
    }

    fn poll(&mut self, patience: Duration) -> Polled {
        let watch = Stopwatch::start();
        loop {
            let is_asked = self.asked_to_end.load(Ordering::Relaxed);
            if self.is_ended || is_asked || self.assembler.is_full() {
                return Polled::Ended;
            }
            let Some(rest) = patience.checked_sub(watch.elapsed()) else {
                return Polled::Waiting;
            };
            let Some((image, is_compressed)) =
                self.waiting.take().or_else(|| self.next_image(rest))
            else {
                continue;
            };
            if self.jumps(&image) {
                self.is_ended = true;
                return Polled::Ended;
            }
            let Some(companions) = self.assembler.is_ready(&image, &PATIENCE) else {
                self.waiting = Some((image, is_compressed));
                std::thread::sleep(TICK);
                continue;
            };
            let frame = self.assembler.frame_of(&image, is_compressed, companions);
            if let Some(frame) = frame {
                self.last_stamp = Some(frame.stamp);
                return Polled::Frame(Box::new(frame));
            }
        }
    }

    fn mount(&self) -> Option<Rigid> {
        let camera_frame = &self.assembler.camera_frame;
        self.assembler.beside.fixed(&self.base_frame, camera_frame)
    }

    fn camera_frame(&self) -> &str {
        &self.assembler.camera_frame
    }

    fn metric_input(&self) -> MetricInput {
        self.assembler.metric_input()
    }

    fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        let silent = self.since_image.secs();
        if silent > SILENT_SECS {
            warnings.push(format!(
                "no image on {:?} for {silent:.0} s: nobody publishes it, or publish.zenoh_connect and publish.domain_id lead elsewhere",
                self.topic
            ));
        }
        warnings.extend(self.assembler.warnings());
        warnings
    }

    fn counts(&self) -> SourceCounts {
        self.assembler.counts(self.images.dropped())
    }

    fn is_live(&self) -> bool {
        true
    }

    fn end_when(&mut self, asked: &Arc<AtomicBool>) {
        self.asked_to_end = Arc::clone(asked);
    }
}
