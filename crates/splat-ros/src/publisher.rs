//! Everything that goes out, over all transports alike: each message is made once, whoever carries it.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::error::PublishError;
use crate::latched::{KEYFRAMES, LatchedStore, MANIFEST, SPLATS};
use crate::map_stream::{CORRECTION, DELTA, PublishedMap, Update};
use crate::mcap_transport::McapTransport;
use crate::navigation::{self, CLOUD, FRUSTA, KEYFRAME_CLOUD, KeyframeDepth, PATH};
use crate::odometry::{FrameTree, PoseEvent, parse_transform};
use crate::params::PublishParams;
use crate::pose_messages::{self, LiveMessages};
use crate::pose_stream::{Newest, PoseStream};
use crate::render_view::Frames;
use crate::service_server::{Controls, ServiceCall, ServiceServer};
use crate::status::{DIAGNOSTICS, STATUS, Status, diagnostics};
use crate::transport::{Delivery, Sample, Topic, Transport};
use splat_io::frame_source::SourceCounts;
use splat_msgs::correction_message;
use splat_types::correction::MapCorrection;
use splat_types::snapshot::Snapshot;
use splat_types::time::{Stamp, Stopwatch};
use splat_types::transform::Rigid;

/// All topics of the node.
pub static TOPICS: [&Topic; 14] = [
    &pose_messages::POSE,
    &pose_messages::ODOMETRY,
    &pose_messages::TF,
    &PATH,
    &CLOUD,
    &KEYFRAME_CLOUD,
    &FRUSTA,
    &KEYFRAMES,
    &MANIFEST,
    &SPLATS,
    &DELTA,
    &CORRECTION,
    &STATUS,
    &DIAGNOSTICS,
];

/// Seconds that transforms go on after the last frame.
const MAX_REPEAT_SECS: f64 = 1.0;

/// What changes with every snapshot.
#[derive(Debug, Default)]
struct MapSide {
    published: PublishedMap,
    since_whole: Option<Stopwatch>,
    last: Option<Arc<Snapshot>>,
}

/// The node's way out. Its parts are locked one by one: a slow peer of the map holds up no pose.
pub struct Publisher {
    params: PublishParams,
    messages: LiveMessages,
    transports: Vec<Box<dyn Transport>>,
    latched: Arc<LatchedStore>,
    service_server: Arc<ServiceServer>,
    controls: Arc<Controls>,
    calls: Mutex<Option<std::sync::mpsc::Receiver<ServiceCall>>>,
    world: Arc<Mutex<FrameTree>>,
    map_side: Mutex<MapSide>,
    live_side: Mutex<PoseStream>,
    status: Mutex<Status>,
    since_image: Mutex<Stopwatch>,
    /// What the map has reported since the last correction that went out.
    correction: Mutex<Option<MapCorrection>>,
    camera_frame: Mutex<String>,
}

impl std::fmt::Debug for Publisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Publisher({} transports)", self.transports.len())
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Publisher {
    /// Opens the transports that the parameters ask for.
    pub fn open(params: &PublishParams) -> Result<Self, PublishError> {
        let mount = match params.base_from_camera.as_str() {
            "" => None,
            text => Some(parse_transform(text).ok_or_else(|| PublishError::Param {
                name: "mount",
                found: text.to_owned(),
                expected: "seven numbers, x y z qx qy qz qw".to_owned(),
            })?),
        };
        let latched = Arc::new(LatchedStore::new(&params.splat_frame, params.chunk_bytes));
        let controls = Arc::new(Controls::default());
        let world = Arc::new(Mutex::new(FrameTree::default()));
        let frames = Frames {
            map: params.map_frame.clone(),
            splats: params.splat_frame.clone(),
            world: Arc::clone(&world),
        };
        let (service_server, calls) = ServiceServer::new(
            Arc::clone(&latched),
            Arc::clone(&controls),
            frames,
            &params.map_directory,
        );
        let service_server = Arc::new(service_server);
        let mut transports: Vec<Box<dyn Transport>> = Vec::new();
        #[cfg(feature = "zenoh")]
        if params.zenoh {
            let (latched, service_server) = (Arc::clone(&latched), Arc::clone(&service_server));
            let transport = crate::zenoh::transport::ZenohTransport::open(
                params,
                &TOPICS,
                latched,
                service_server,
            )?;
            transports.push(Box::new(transport));
        }
        #[cfg(not(feature = "zenoh"))]
        if params.zenoh {
            return Err(PublishError::Param {
                name: "zenoh",
                found: "true".to_owned(),
                expected: "false, since this build has no zenoh; build with --features zenoh"
                    .to_owned(),
            });
        }
        if !params.record.is_empty() {
            let transport = McapTransport::create(&PathBuf::from(&params.record))?;
            transports.push(Box::new(transport));
        }
        Ok(Self {
            params: params.clone(),
            messages: LiveMessages::new(params),
            transports,
            latched,
            service_server,
            controls,
            calls: Mutex::new(Some(calls)),
            world,
            map_side: Mutex::default(),
            live_side: Mutex::new(PoseStream::new(mount, params)),
            status: Mutex::default(),
            since_image: Mutex::new(Stopwatch::start()),
            correction: Mutex::default(),
            camera_frame: Mutex::new(params.camera_frame.clone()),
        })
    }

    /// One more way out, beside those of the parameters; before anything was sent.
    pub fn with_transport(mut self, transport: Box<dyn Transport>) -> Self {
        self.transports.push(transport);
        self
    }

    /// Answers services; transports keep it.
    pub fn service_server(&self) -> Arc<ServiceServer> {
        Arc::clone(&self.service_server)
    }

    /// What late joiners get; transports keep it.
    pub fn latched(&self) -> Arc<LatchedStore> {
        Arc::clone(&self.latched)
    }

    pub fn controls(&self) -> Arc<Controls> {
        Arc::clone(&self.controls)
    }

    /// The end at which the map's thread takes calls; once.
    pub fn take_calls(&self) -> Option<std::sync::mpsc::Receiver<ServiceCall>> {
        lock(&self.calls).take()
    }

    /// Where peers may connect, for example `tcp/127.0.0.1:40123`.
    pub fn endpoints(&self) -> Vec<String> {
        self.transports
            .iter()
            .flat_map(|transport| transport.endpoints())
            .collect()
    }

    /// How the map moved; goes out with the first snapshot that shows it.
    pub fn queue_correction(&self, correction: MapCorrection) {
        let mut queued = lock(&self.correction);
        *queued = Some(match queued.as_ref() {
            Some(before) => correction.after(before),
            None => correction,
        });
    }

    /// The correction between the last published snapshot and this one, which begins another epoch or is of another map.
    fn take_correction(&self, last: &Snapshot, snapshot: &Snapshot) -> Option<MapCorrection> {
        let mut queued = lock(&self.correction);
        let is_other = last.map_id != snapshot.map_id;
        // The map's thread may be ahead by a snapshot.
        let shown = queued.take_if(|queued| is_other || queued.revision <= snapshot.revision);
        shown.filter(|_| is_other || last.epoch != snapshot.epoch)
    }

    /// Each stage writes its own part.
    pub fn note(&self, note: impl FnOnce(&mut Status)) {
        note(&mut lock(&self.status));
    }

    /// An image has come.
    pub fn note_image(&self, counts: SourceCounts, is_calibrated: bool) {
        *lock(&self.since_image) = Stopwatch::start();
        self.note(|status| {
            status.counts = counts;
            status.is_calibrated = is_calibrated;
        });
    }

    /// What the input says of its camera: how it is mounted, where a parameter does not say, and its frame's name.
    pub fn set_camera(&self, base_from_cam: Option<Rigid>, frame: &str) {
        if let Some(mount) = base_from_cam {
            lock(&self.live_side).odometer.mount_by_input(mount);
        }
        if !frame.is_empty() {
            frame.clone_into(&mut lock(&self.camera_frame));
        }
    }

    /// Sends to all transports; the first fault is returned once all have had it.
    pub fn send(&self, post: &Sample) -> Result<(), PublishError> {
        if !matches!(post.topic.delivery, Delivery::Reliable { .. }) {
            self.latched.keep(post);
        }
        let sent = self.transports.iter().map(|transport| transport.send(post));
        sent.fold(Ok(()), Result::and)
    }

    /// Sends a snapshot: whole, or what changed since the last one. Returns when the transports have taken it.
    pub fn publish(&self, snapshot: &Arc<Snapshot>) -> Result<(), PublishError> {
        self.publish_as(snapshot, false)
    }

    /// The last one goes out whole.
    pub fn publish_last(&self, snapshot: &Arc<Snapshot>) -> Result<(), PublishError> {
        self.publish_as(snapshot, true)
    }

    fn publish_as(&self, snapshot: &Arc<Snapshot>, is_last: bool) -> Result<(), PublishError> {
        let map_from_world = {
            let mut world = lock(&self.world);
            world.metres_per_unit = snapshot.scale.metres_per_unit;
            world.map_from_world()
        };
        self.note(|status| {
            status.map_id = snapshot.map_id;
            status.epoch = snapshot.epoch;
            status.revision = snapshot.revision;
            status.scale = snapshot.scale;
            status.n_splats = snapshot.splats.len() as u64;
        });
        let mut side = lock(&self.map_side);
        let correction = side
            .last
            .as_ref()
            .and_then(|last| self.take_correction(last, snapshot));
        side.last = Some(Arc::clone(snapshot));
        let is_due = side
            .since_whole
            .is_none_or(|watch| watch.secs() >= self.params.full_map_period);
        let is_whole = is_last || is_due;
        let update = side
            .published
            .update(snapshot, is_whole, self.params.delta_share);
        let held = side.published.held().map_or(snapshot, |held| held);
        // Before the first message goes out: who subscribed too late for it finds it there.
        let kept = self.latched.keep_map(held);
        if let Some(correction) = correction {
            let frame = self.latched.splat_frame();
            let message = correction_message::message(&correction, snapshot, frame);
            self.send(&Sample::of(&CORRECTION, snapshot.stamp, &message)?)?;
        }
        let messages = self.latched.messages(&kept);
        let stamp = held.stamp;
        if let Update::Whole = &update {
            self.send(&Sample::of(&MANIFEST, stamp, &messages.manifest())?)?;
        }
        for array in messages.keyframes() {
            self.send(&Sample::of(&KEYFRAMES, stamp, &array)?)?;
        }
        match &update {
            Update::Whole => {
                for chunk in messages.chunks() {
                    self.send(&Sample::of(&SPLATS, stamp, &chunk)?)?;
                }
            }
            Update::Delta(delta) => {
                for piece in delta.messages(&messages) {
                    self.send(&Sample::of(&DELTA, stamp, &piece)?)?;
                }
            }
        }
        let path = navigation::path(snapshot, &map_from_world, &self.params);
        self.send(&Sample::of(&PATH, stamp, &path)?)?;
        let cloud = navigation::cloud(snapshot, &map_from_world, &self.params);
        self.send(&Sample::of(&CLOUD, stamp, &cloud)?)?;
        let frusta = navigation::frusta(snapshot, &map_from_world, &self.params);
        self.send(&Sample::of(&FRUSTA, stamp, &frusta)?)?;
        if matches!(update, Update::Whole) {
            side.since_whole = Some(Stopwatch::start());
        }
        Ok(())
    }

    /// Sends what a tracked frame says.
    pub fn live(&self, frame: &PoseEvent) -> Result<(), PublishError> {
        let mut side = lock(&self.live_side);
        self.note(|status| {
            let tracked = &frame.tracked;
            status.stamp = tracked.stamp;
            status.tracked = Some(tracked.state);
            status.reason = tracked.reason.map(|r| r.to_string()).unwrap_or_default();
            status.n_tracked += u64::from(tracked.is_measured());
            status.n_missed += u64::from(!tracked.is_measured());
            status.frame_to_pose.note(frame.latency_secs);
        });
        let (at, world) = {
            let mut world = lock(&self.world);
            let at = side.odometer.advance(frame, &mut world);
            (at, world.clone())
        };
        let Some(at) = at else {
            return Ok(());
        };
        let map_from_odom = side.slewed(&at, at.stamp);
        self.send(&self.messages.pose(&at)?)?;
        self.send(&self.messages.odometry(&at)?)?;
        let transforms = self
            .messages
            .transforms(&map_from_odom, &at, at.stamp, &world)?;
        side.newest = Some(Newest {
            at,
            since: Stopwatch::start(),
        });
        transforms.map_or(Ok(()), |post| self.send(&post))
    }

    /// Between frames: the newest transforms once more, so that nobody has to look back further than they like.
    pub fn repeat_transforms(&self) -> Result<(), PublishError> {
        let mut side = lock(&self.live_side);
        let Some((at, since)) = side.newest.as_ref().map(|newest| (newest.at, newest.since)) else {
            return Ok(());
        };
        let secs = since.secs();
        if secs > MAX_REPEAT_SECS {
            return Ok(());
        }
        let nanos = at.stamp.nanos.saturating_add((secs * 1e9) as i64);
        let world = lock(&self.world).clone();
        let stamp = Stamp::from_nanos(nanos);
        let map_from_odom = side.slewed(&at, stamp);
        let post = self
            .messages
            .transforms(&map_from_odom, &at, stamp, &world)?;
        drop(side);
        post.map_or(Ok(()), |post| self.send(&post))
    }

    /// Sends a keyframe's depth as costmaps take it.
    pub fn keyframe(&self, seen: &KeyframeDepth) -> Result<(), PublishError> {
        let metres = lock(&self.world).metres_per_unit.unwrap_or(1.0);
        let frame = lock(&self.camera_frame).clone();
        let cloud = navigation::keyframe_cloud(seen, metres, &frame);
        self.send(&Sample::of(&KEYFRAME_CLOUD, seen.stamp, &cloud)?)
    }

    /// Sends how the mapper stands; `rss_mib` is the memory of the process, where known.
    pub fn status(&self, rss_mib: Option<f64>) -> Result<(), PublishError> {
        let silent_secs = lock(&self.since_image).secs();
        let status = lock(&self.status).clone();
        let message = status.message(&self.params.map_frame, rss_mib, silent_secs);
        self.send(&Sample::of(&STATUS, status.stamp, &message)?)?;
        let node = self.params.namespace.rsplit('/').next().unwrap_or_default();
        let array = diagnostics(&message, node, silent_secs);
        self.send(&Sample::of(&DIAGNOSTICS, status.stamp, &array)?)
    }

    /// Ends all transports.
    pub fn close(&self) -> Result<(), PublishError> {
        let closed = self.transports.iter().map(|transport| transport.close());
        closed.fold(Ok(()), Result::and)
    }
}
