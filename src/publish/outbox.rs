//! Everything that goes out, over all faces alike: each message is made once, whoever carries it.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::clock::{Stamp, Stopwatch};
use crate::config::PublishParams;
use crate::map::correction::Reason;
use crate::map::slew::Slew;
use crate::map::snapshot::Snapshot;
use crate::memory::rss_mib;
use crate::pose::Rigid;
use crate::publish::PublishError;
use crate::publish::archive::{Archive, KEYFRAMES, MANIFEST, SPLATS};
use crate::publish::correction::{CORRECTION, correction};
use crate::publish::delta::{DELTA, Published, Update};
use crate::publish::face::{Delivery, Face, Post, Topic};
use crate::publish::live::{self, LiveMessages};
use crate::publish::overview::{self, CLOUD, FRUSTA, KEYFRAME_CLOUD, PATH, SeenKeyframe};
use crate::publish::recording::RecordingFace;
use crate::publish::service::{Call, Desk, Switches};
use crate::publish::status::{DIAGNOSTICS, STATUS, Standing, diagnostics};
use crate::publish::world::{LiveFrame, Walker, Whereabouts, World, mount_of};
use crate::source::SourceCounts;

/// All topics of the node.
pub static TOPICS: [&Topic; 14] = [
    &live::POSE,
    &live::ODOMETRY,
    &live::TF,
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

/// What the newest tracked frame said, for repeats of its transforms.
#[derive(Debug)]
struct Newest {
    at: Whereabouts,
    since: Stopwatch,
}

/// What changes with every snapshot.
#[derive(Debug, Default)]
struct MapSide {
    published: Published,
    since_whole: Option<Stopwatch>,
    last: Option<Arc<Snapshot>>,
}

/// What changes with every frame.
#[derive(Debug)]
struct LiveSide {
    walker: Walker,
    slew: Slew,
    newest: Option<Newest>,
}

impl LiveSide {
    /// `map_from_odom` as navigation is to see it.
    fn slewed(&mut self, at: &Whereabouts, stamp: Stamp) -> Rigid {
        let robot = at.odom_from_base.translation;
        let slewed = self.slew.follow(&at.map_from_odom(), robot, stamp);
        slewed.map_from_odom
    }
}

/// No limit where corrections are to show at once.
fn slew_of(params: &PublishParams) -> Slew {
    if params.slew_speed > 0.0 {
        Slew::new(params.slew_speed, params.slew_turn_deg.to_radians())
    } else {
        Slew::new(0.0, 0.0)
    }
}

/// The node's way out. Its parts are locked one by one: a slow peer of the map holds up no pose.
pub struct Outbox {
    params: PublishParams,
    messages: LiveMessages,
    faces: Vec<Box<dyn Face>>,
    archive: Arc<Archive>,
    desk: Arc<Desk>,
    switches: Arc<Switches>,
    calls: Mutex<Option<std::sync::mpsc::Receiver<Call>>>,
    world: Mutex<World>,
    map_side: Mutex<MapSide>,
    live_side: Mutex<LiveSide>,
    standing: Mutex<Standing>,
    since_picture: Mutex<Stopwatch>,
    /// Why the map has moved since the last correction that went out.
    moved: Mutex<Option<Reason>>,
    camera_frame: Mutex<String>,
}

impl std::fmt::Debug for Outbox {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Outbox({} faces)", self.faces.len())
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Outbox {
    /// Opens the faces that the parameters ask for.
    pub fn open(params: &PublishParams) -> Result<Self, PublishError> {
        let mount = match params.mount.as_str() {
            "" => None,
            text => Some(mount_of(text).ok_or_else(|| PublishError::Param {
                name: "mount",
                found: text.to_owned(),
                expected: "seven numbers, x y z qx qy qz qw".to_owned(),
            })?),
        };
        let archive = Arc::new(Archive::new(&params.splat_frame, params.chunk_bytes));
        let switches = Arc::new(Switches::default());
        let (desk, calls) = Desk::new(Arc::clone(&archive), Arc::clone(&switches), &params.folder);
        let desk = Arc::new(desk);
        let mut faces: Vec<Box<dyn Face>> = Vec::new();
        #[cfg(feature = "zenoh")]
        if params.zenoh {
            let (archive, desk) = (Arc::clone(&archive), Arc::clone(&desk));
            let face = crate::publish::zenoh::ZenohFace::open(params, &TOPICS, archive, desk)?;
            faces.push(Box::new(face));
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
            let face = RecordingFace::create(&PathBuf::from(&params.record))?;
            faces.push(Box::new(face));
        }
        Ok(Self {
            params: params.clone(),
            messages: LiveMessages::new(params),
            faces,
            archive,
            desk,
            switches,
            calls: Mutex::new(Some(calls)),
            world: Mutex::default(),
            map_side: Mutex::default(),
            live_side: Mutex::new(LiveSide {
                walker: Walker::new(mount),
                slew: slew_of(params),
                newest: None,
            }),
            standing: Mutex::default(),
            since_picture: Mutex::new(Stopwatch::start()),
            moved: Mutex::default(),
            camera_frame: Mutex::new(params.camera_frame.clone()),
        })
    }

    /// One more way out, beside those of the parameters; before anything was sent.
    pub fn with_face(mut self, face: Box<dyn Face>) -> Self {
        self.faces.push(face);
        self
    }

    /// Answers services; faces keep it.
    pub fn desk(&self) -> Arc<Desk> {
        Arc::clone(&self.desk)
    }

    /// What late joiners get; faces keep it.
    pub fn archive(&self) -> Arc<Archive> {
        Arc::clone(&self.archive)
    }

    pub fn switches(&self) -> Arc<Switches> {
        Arc::clone(&self.switches)
    }

    /// The end at which the map's thread takes calls; once.
    pub fn take_calls(&self) -> Option<std::sync::mpsc::Receiver<Call>> {
        lock(&self.calls).take()
    }

    /// Where peers may connect, for example `tcp/127.0.0.1:40123`.
    pub fn endpoints(&self) -> Vec<String> {
        self.faces
            .iter()
            .flat_map(|face| face.endpoints())
            .collect()
    }

    /// Why the map of the next snapshots has moved.
    pub fn note_move(&self, reason: Reason) {
        *lock(&self.moved) = Some(reason);
    }

    /// Each stage writes its own part.
    pub fn note(&self, note: impl FnOnce(&mut Standing)) {
        note(&mut lock(&self.standing));
    }

    /// A picture has come.
    pub fn note_picture(&self, counts: SourceCounts, is_calibrated: bool) {
        *lock(&self.since_picture) = Stopwatch::start();
        self.note(|standing| {
            standing.counts = counts;
            standing.is_calibrated = is_calibrated;
        });
    }

    /// What the input says of its camera: how it is mounted, where a parameter does not say, and its frame's name.
    pub fn meet_camera(&self, base_from_cam: Option<Rigid>, frame: &str) {
        if let Some(mount) = base_from_cam {
            lock(&self.live_side).walker.mount_by_input(mount);
        }
        if !frame.is_empty() {
            frame.clone_into(&mut lock(&self.camera_frame));
        }
    }

    /// Sends to all faces; the first fault is returned once all have had it.
    pub fn send(&self, post: &Post) -> Result<(), PublishError> {
        if !matches!(post.topic.delivery, Delivery::Reliable { .. }) {
            self.archive.keep(post);
        }
        let sent = self.faces.iter().map(|face| face.send(post));
        sent.fold(Ok(()), Result::and)
    }

    /// Sends a snapshot: whole, or what changed since the last one. Returns when the faces have taken it.
    pub fn publish(&self, snapshot: &Arc<Snapshot>) -> Result<(), PublishError> {
        self.publish_as(snapshot, false)
    }

    /// The last one goes out whole.
    pub fn publish_last(&self, snapshot: &Arc<Snapshot>) -> Result<(), PublishError> {
        self.publish_as(snapshot, true)
    }

    fn publish_as(&self, snapshot: &Arc<Snapshot>, is_last: bool) -> Result<(), PublishError> {
        let map_from_splats = {
            let mut world = lock(&self.world);
            world.metres_per_unit = snapshot.scale.metres_per_unit;
            world.map_from_splats()
        };
        self.note(|standing| {
            standing.map_id = snapshot.map_id;
            standing.epoch = snapshot.epoch;
            standing.revision = snapshot.revision;
            standing.scale = snapshot.scale;
            standing.n_splats = snapshot.splats.len() as u64;
        });
        let mut side = lock(&self.map_side);
        let moved = side.last.as_ref().and_then(|last| {
            let why = lock(&self.moved).take();
            correction(last, snapshot, why, self.archive.splat_frame())
        });
        side.last = Some(Arc::clone(snapshot));
        let is_due = side
            .since_whole
            .is_none_or(|watch| watch.secs() >= self.params.full_secs);
        let is_whole = is_last || is_due;
        let update = side
            .published
            .update(snapshot, is_whole, self.params.delta_share);
        let held = side.published.held().map_or(snapshot, |held| held);
        // Before the first message goes out: who subscribed too late for it finds it there.
        let kept = self.archive.keep_map(held);
        if let Some(moved) = moved {
            self.send(&Post::of(&CORRECTION, snapshot.stamp, &moved)?)?;
        }
        let messages = self.archive.messages(&kept);
        let stamp = held.stamp;
        if let Update::Whole = &update {
            self.send(&Post::of(&MANIFEST, stamp, &messages.manifest())?)?;
        }
        for array in messages.keyframes() {
            self.send(&Post::of(&KEYFRAMES, stamp, &array)?)?;
        }
        match &update {
            Update::Whole => {
                for chunk in messages.chunks() {
                    self.send(&Post::of(&SPLATS, stamp, &chunk)?)?;
                }
            }
            Update::Delta(delta) => {
                for piece in delta.messages(&messages) {
                    self.send(&Post::of(&DELTA, stamp, &piece)?)?;
                }
            }
        }
        let path = overview::path(snapshot, &map_from_splats, &self.params);
        self.send(&Post::of(&PATH, stamp, &path)?)?;
        let cloud = overview::cloud(snapshot, &map_from_splats, &self.params);
        self.send(&Post::of(&CLOUD, stamp, &cloud)?)?;
        let frusta = overview::frusta(snapshot, &map_from_splats, &self.params);
        self.send(&Post::of(&FRUSTA, stamp, &frusta)?)?;
        if matches!(update, Update::Whole) {
            side.since_whole = Some(Stopwatch::start());
        }
        Ok(())
    }

    /// Sends what a tracked frame says.
    pub fn live(&self, frame: &LiveFrame) -> Result<(), PublishError> {
        let mut side = lock(&self.live_side);
        self.note(|standing| {
            let tracked = &frame.tracked;
            standing.stamp = tracked.stamp;
            standing.tracked = Some(tracked.state);
            standing.reason = tracked.reason.map(|r| r.to_string()).unwrap_or_default();
            standing.n_tracked += u64::from(tracked.is_measured());
            standing.n_missed += u64::from(!tracked.is_measured());
            standing.frame_to_pose.note(frame.latency_secs);
        });
        let (at, world) = {
            let mut world = lock(&self.world);
            let at = side.walker.walk(frame, &mut world);
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
    pub fn keyframe(&self, seen: &SeenKeyframe) -> Result<(), PublishError> {
        let metres = lock(&self.world).metres_per_unit.unwrap_or(1.0);
        let frame = lock(&self.camera_frame).clone();
        let cloud = overview::keyframe_cloud(seen, metres, &frame);
        self.send(&Post::of(&KEYFRAME_CLOUD, seen.stamp, &cloud)?)
    }

    /// Sends how the mapper stands.
    pub fn status(&self) -> Result<(), PublishError> {
        let silent_secs = lock(&self.since_picture).secs();
        let standing = lock(&self.standing).clone();
        let status = standing.message(&self.params.map_frame, rss_mib(), silent_secs);
        self.send(&Post::of(&STATUS, standing.stamp, &status)?)?;
        let node = self.params.namespace.rsplit('/').next().unwrap_or_default();
        let array = diagnostics(&status, node, silent_secs);
        self.send(&Post::of(&DIAGNOSTICS, standing.stamp, &array)?)
    }

    /// Ends all faces.
    pub fn close(&self) -> Result<(), PublishError> {
        let closed = self.faces.iter().map(|face| face.close());
        closed.fold(Ok(()), Result::and)
    }
}
