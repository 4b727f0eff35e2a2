//! A ROS 2 topic with images -> frames, with calibration, odometry and depth from the topics beside it.
//!
//! What `images` brings is decoded here, on the source's thread, by the same code as recordings.

use std::sync::Arc;
use std::time::Duration;

use r2r::QosProfile;

use crate::live_images::assembler::{Assembler, Patience, ReceivedImage};
use crate::live_images::companions::{Beside, Kind};
use crate::ros2::error::LinkError;
use crate::ros2::image_topic::Subscription;
use crate::ros2::node::Link;
use crate::ros2::params::OnTimeJump;
use crate::ros2::topic_watch::{Watch, why_silent};
use splat_io::error::SourceError;
use splat_io::frame_source::{MetricInput, Polled, Source, SourceCounts, next_polled};
use splat_io::imu::extrinsic_of;
use splat_io::params::SourceParams;
use splat_io::queue::Received;
use splat_io::topics::info_topic_of;
use splat_types::frame::Frame;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

/// Stamps that lie so far back are not a matter of order but of another time.
const JUMP_SECS: f64 = 1.0;
/// How often what an image waits for is looked at.
const TICK: Duration = Duration::from_millis(2);

/// Images of a topic and what comes beside them. Many fields: waiting for companions, jumps of time and silence each read
/// what the others write (the intake, the stamps, the frame of the camera), so that parts would borrow one another.
#[derive(Debug)]
pub struct Ros2Source {
    link: Arc<Link>,
    topic: String,
    subscription: Option<Subscription>,
    assembler: Assembler,
    waiting: Option<ReceivedImage>,
    last_stamp: Option<Stamp>,
    last_clock: Option<Stamp>,
    watch: Watch,
    is_ended: bool,
}

impl Ros2Source {
    /// `topic` as in `ros2:/camera/image_raw`. Images may begin to come at any time later.
    pub fn open(topic: &str, params: &SourceParams) -> Result<Self, SourceError> {
        let fail = |reason: String| SourceError::Subscribe {
            topic: topic.to_owned(),
            reason,
        };
        if topic.trim_matches('/').is_empty() {
            return Err(fail(
                "a topic is wanted, such as ros2:/camera/image_raw".to_owned(),
            ));
        }
        let link = Link::current().ok_or_else(|| {
            fail("the node is not up; ros2.enabled=off leaves no way to receive ROS 2".to_owned())
        })?;
        extrinsic_of(params).map_err(fail)?;
        let info_topic = info_topic_of(&params.camera_info_topic, topic);
        let beside = Beside::new(params, &info_topic, &link.setup.odom_frame);
        subscribe(&beside, &link).map_err(|e| fail(e.to_string()))?;
        let mut source = Self {
            assembler: Assembler::new(topic, params, beside),
            link,
            topic: topic.to_owned(),
            subscription: None,
            waiting: None,
            last_stamp: None,
            last_clock: None,
            watch: Watch::new(),
            is_ended: false,
        };
        source.subscription =
            Subscription::of(&source.link, topic).map_err(|e| fail(e.to_string()))?;
        Ok(source)
    }

    /// The oldest image that came, if one comes in time.
    fn next_image(&mut self, patience: Duration) -> Option<ReceivedImage> {
        if self.subscription.is_none() {
            match Subscription::of(&self.link, &self.topic) {
                Ok(subscription) => self.subscription = subscription,
                Err(e) => tracing::warn!("{e}"),
            }
        }
        let Some(subscription) = &self.subscription else {
            if self.watch.is_due() {
                self.look_for_silence();
            }
            std::thread::sleep(patience);
            return None;
        };
        match subscription.images.recv_timeout(patience) {
            Received::Item(image) => {
                self.watch.image_came();
                Some(image)
            }
            Received::Nothing => {
                if self.watch.is_due() {
                    self.look_for_silence();
                }
                None
            }
            Received::Ended => {
                self.is_ended = true;
                None
            }
        }
    }

    /// False when the input ends over it.
    fn survives_jump(&mut self, from: Stamp, to: Stamp) -> bool {
        let back = from.secs_since(to);
        let action = self.link.setup.live.get().on_time_jump;
        match action {
            OnTimeJump::Ignore => return true,
            OnTimeJump::Reset if self.link.time_jumped() => {
                tracing::warn!("time jumped back by {back:.3} s, to {to}: a new map begins");
                self.last_stamp = None;
                self.assembler.begin_anew();
                return true;
            }
            OnTimeJump::Reset => {
                tracing::warn!(
                    "ros2.on_time_jump=reset needs the services of the node, which are off"
                );
            }
            OnTimeJump::End => {}
        }
        tracing::warn!(
            "time jumped back by {back:.3} s, to {to}: the input ends (ros2.on_time_jump)"
        );
        self.is_ended = true;
        false
    }

    /// Whether `/clock` or the image's stamp jumped back, and the input ends over it.
    fn ends_by_jump(&mut self, image: Option<&ReceivedImage>) -> bool {
        let clock = self.link.sim_time();
        let last_clock = std::mem::replace(&mut self.last_clock, clock);
        let stamp = image.and_then(|p| p.stamp);
        for (last, new) in [(last_clock, clock), (self.last_stamp, stamp)] {
            if let (Some(last), Some(new)) = (last, new)
                && last.secs_since(new) > JUMP_SECS
                && !self.survives_jump(last, new)
            {
                return true;
            }
        }
        false
    }

    /// Says what is missing, and to the status every time.
    fn look_for_silence(&mut self) {
        let is_silent = self.watch.silent_secs() > self.link.setup.live.get().image_timeout;
        let silence = is_silent.then(|| {
            let (topic, is_compressed) = self
                .subscription
                .as_ref()
                .map_or((self.topic.as_str(), false), |s| {
                    (&s.topic, s.is_compressed)
                });
            why_silent(&self.link, topic, is_compressed)
        });
        let warnings = self.assembler.warnings();
        self.watch.report(&self.link, silence, warnings);
    }
}

/// Subscribes what comes beside the images.
fn subscribe(beside: &Beside, link: &Link) -> Result<(), LinkError> {
    for topic in beside.topics() {
        // Reliable publishers suit a best-effort listener, too; latched ones are asked for what they said before.
        let qos = match topic.kind {
            Kind::StaticTransforms => QosProfile::default().keep_last(100).transient_local(),
            Kind::Transforms | Kind::Odometry | Kind::TruePose => {
                QosProfile::default().keep_last(100).best_effort()
            }
            // A second of a fast one, should this process be held up.
            Kind::Imu => QosProfile::default().keep_last(1000).best_effort(),
            _ => QosProfile::sensor_data(),
        };
        let sink = beside.sink(topic.kind);
        link.subscribe(&topic.name, topic.type_name, qos, move |payload| {
            sink(payload);
            true
        })?;
    }
    Ok(())
}

impl Source for Ros2Source {
    fn next(&mut self) -> Option<Frame> {
        next_polled(self)
    }

    fn poll(&mut self, patience: Duration) -> Polled {
        let watch = Stopwatch::start();
        loop {
            if self.is_ended || self.assembler.is_full() {
                return Polled::Ended;
            }
            let Some(rest) = patience.checked_sub(watch.elapsed()) else {
                return Polled::Waiting;
            };
            let Some(image) = self.waiting.take().or_else(|| self.next_image(rest)) else {
                if self.ends_by_jump(None) {
                    return Polled::Ended;
                }
                continue;
            };
            if self.ends_by_jump(Some(&image)) {
                return Polled::Ended;
            }
            let live = self.link.setup.live.get();
            let patience = Patience {
                camera_info_secs: live.camera_info_timeout,
                companions_secs: live.odometry_timeout,
            };
            let Some(companions) = self.assembler.is_ready(&image, &patience) else {
                self.waiting = Some(image);
                std::thread::sleep(TICK);
                continue;
            };
            let is_compressed = self.subscription.as_ref().is_some_and(|s| s.is_compressed);
            let frame = self.assembler.frame_of(&image, is_compressed, companions);
            if let Some(frame) = frame {
                self.last_stamp = Some(frame.stamp);
                if self.watch.is_due() {
                    self.look_for_silence();
                }
                return Polled::Frame(Box::new(frame));
            }
        }
    }

    fn mount(&self) -> Option<Rigid> {
        let base_frame = &self.link.setup.base_frame;
        self.assembler
            .beside
            .fixed(base_frame, &self.assembler.camera_frame)
    }

    fn camera_frame(&self) -> &str {
        &self.assembler.camera_frame
    }

    fn metric_input(&self) -> MetricInput {
        self.assembler.metric_input()
    }

    fn warnings(&self) -> Vec<String> {
        self.link.warnings()
    }

    fn counts(&self) -> SourceCounts {
        let dropped = self.subscription.as_ref().map_or(0, |s| s.images.dropped());
        self.assembler.counts(dropped)
    }
}
