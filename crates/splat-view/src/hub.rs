//! Where what is published meets who looks: the newest map, events, thumbnails. Producers are never held up.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use glam::{DQuat, DVec3};
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{ExtendedColorType, ImageBuffer, Rgb};
use tokio::sync::{broadcast, watch};

use crate::grid_message;
use crate::messages;
use crate::view_map::{Builder, Published, ViewMap};
use splat_msgs::status_message::MapperStatus;
use splat_types::correction::MapCorrection;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;
use splat_types::tracking::TrackedFrame;
use splat_volume::grid::Grid;

/// Events that a client may lag behind; it goes on with newer ones then.
const MAX_EVENTS: usize = 256;
/// Longer side of a keyframe's thumbnail, pixels, and quality of its JPEG.
const THUMBNAIL_PX: u32 = 320;
const THUMBNAIL_QUALITY: u8 = 80;
/// Bytes of all thumbnails; beyond them every second one goes.
const MAX_THUMBNAIL_BYTES: usize = 32 << 20;

/// Shared by the node's threads and the server's.
#[derive(Debug)]
pub struct Hub {
    pending: Mutex<Pending>,
    /// Something is pending, somebody looks, or the end has come.
    woken: Condvar,
    map: watch::Sender<Arc<ViewMap>>,
    events: broadcast::Sender<Arc<str>>,
    latest: Mutex<Latest>,
    thumbnails: Mutex<Thumbnails>,
    n_clients: AtomicUsize,
}

#[derive(Debug, Default)]
struct Pending {
    published: Option<Published>,
    has_ended: bool,
}

/// The newest events, for late joiners.
#[derive(Debug, Clone, Default)]
pub(crate) struct Latest {
    pub(crate) status: Option<Arc<str>>,
    pub(crate) pose: Option<Arc<str>>,
    pub(crate) grid: Option<Arc<str>>,
    pub(crate) plan: Option<Arc<str>>,
    metres_per_unit: Option<f64>,
}

#[derive(Debug, Default)]
struct Thumbnails {
    /// JPEG files by the time of the keyframe, nanoseconds.
    by_stamp: BTreeMap<i64, Arc<[u8]>>,
    n_bytes: usize,
}

impl Default for Hub {
    fn default() -> Self {
        Self {
            pending: Mutex::default(),
            woken: Condvar::new(),
            map: watch::Sender::new(Arc::new(ViewMap::empty())),
            events: broadcast::Sender::new(MAX_EVENTS),
            latest: Mutex::default(),
            thumbnails: Mutex::default(),
            n_clients: AtomicUsize::new(0),
        }
    }
}

fn locked<T>(cell: &Mutex<T>) -> MutexGuard<'_, T> {
    cell.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    /// The published map is another one now. A copy of a pointer: the work is done by `run`, and only while somebody looks.
    pub fn publish(&self, published: Published) {
        locked(&self.latest).metres_per_unit = published.snapshot.scale.metres_per_unit;
        locked(&self.pending).published = Some(published);
        self.woken.notify_all();
    }

    pub fn frame(&self, frame: &TrackedFrame) {
        let metres_per_unit = locked(&self.latest).metres_per_unit.unwrap_or(1.0);
        let message: Arc<str> = messages::pose(frame, metres_per_unit).into();
        locked(&self.latest).pose = Some(Arc::clone(&message));
        // Nobody looks, else.
        self.events.send(message).ok();
    }

    pub fn status(&self, status: &MapperStatus) {
        let message: Arc<str> = messages::status(status).into();
        locked(&self.latest).status = Some(Arc::clone(&message));
        self.events.send(message).ok();
    }

    pub fn grid(&self, grid: &Grid, map_from_grid: DQuat, ground: f64) {
        if let Some(message) = grid_message::grid(grid, map_from_grid, ground) {
            let message: Arc<str> = message.into();
            locked(&self.latest).grid = Some(Arc::clone(&message));
            self.events.send(message).ok();
        }
    }

    /// Where a planner means to go, in the robot's map frame; metres.
    pub fn plan(&self, points: &[DVec3]) {
        let message: Arc<str> = messages::path("plan", points).into();
        locked(&self.latest).plan = Some(Arc::clone(&message));
        self.events.send(message).ok();
    }

    pub fn correction(&self, correction: &MapCorrection) {
        self.events
            .send(messages::correction(correction).into())
            .ok();
    }

    /// A keyframe's image, of which a small one is kept.
    pub fn keyframe(&self, stamp: Stamp, image: &RgbImage) {
        if let Some(jpeg) = thumbnail(image) {
            self.thumbnail(stamp, jpeg);
        }
    }

    /// A JPEG file.
    pub fn thumbnail(&self, stamp: Stamp, jpeg: Vec<u8>) {
        locked(&self.thumbnails).insert(stamp.nanos, jpeg);
    }

    pub(crate) fn thumbnail_of(&self, keyframe_id: u32) -> Option<Arc<[u8]>> {
        let stamp = self.map.borrow().keyframes.get(&keyframe_id)?.pose.stamp;
        locked(&self.thumbnails).by_stamp.get(&stamp.nanos).cloned()
    }

    pub(crate) fn watch_map(&self) -> watch::Receiver<Arc<ViewMap>> {
        self.map.subscribe()
    }

    pub(crate) fn watch_events(&self) -> (Latest, broadcast::Receiver<Arc<str>>) {
        let events = self.events.subscribe();
        (locked(&self.latest).clone(), events)
    }

    /// The newest map that has been made for clients.
    pub fn newest(&self) -> Arc<ViewMap> {
        Arc::clone(&self.map.borrow())
    }

    pub fn n_clients(&self) -> usize {
        self.n_clients.load(Ordering::Acquire)
    }

    /// `false` where there are `most` already.
    pub(crate) fn enter(&self, most: usize) -> bool {
        let more = |n: usize| (n < most).then_some(n + 1);
        let entered = self
            .n_clients
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, more);
        // Under the lock: else `run` might look at the count just before and sleep just after.
        let pending = locked(&self.pending);
        self.woken.notify_all();
        drop(pending);
        entered.is_ok()
    }

    pub(crate) fn leave(&self) {
        self.n_clients.fetch_sub(1, Ordering::AcqRel);
    }

    /// Turns snapshots into what clients see, until `end`. Of several that wait the newest counts.
    pub fn run(&self, sh_degree: u8) {
        let mut builder = Builder::new(sh_degree);
        while let Some(published) = self.next() {
            self.map.send_replace(builder.update(&published));
        }
    }

    fn next(&self) -> Option<Published> {
        let mut pending = locked(&self.pending);
        loop {
            if pending.has_ended {
                return None;
            }
            if self.n_clients() > 0
                && let Some(published) = pending.published.take()
            {
                return Some(published);
            }
            pending = self
                .woken
                .wait(pending)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Ends `run`.
    pub fn end(&self) {
        locked(&self.pending).has_ended = true;
        self.woken.notify_all();
    }
}

impl Thumbnails {
    fn insert(&mut self, stamp: i64, jpeg: Vec<u8>) {
        self.n_bytes += jpeg.len();
        if let Some(before) = self.by_stamp.insert(stamp, jpeg.into()) {
            self.n_bytes -= before.len();
        }
        while self.n_bytes > MAX_THUMBNAIL_BYTES && self.by_stamp.len() > 1 {
            let mut is_odd = false;
            self.by_stamp.retain(|_, _| {
                is_odd = !is_odd;
                is_odd
            });
            self.n_bytes = self.by_stamp.values().map(|jpeg| jpeg.len()).sum();
        }
    }
}

fn thumbnail(image: &RgbImage) -> Option<Vec<u8>> {
    let (width, height) = (image.width_px, image.height_px);
    let larger = width.max(height).max(1);
    let small = |side: u32| (side * THUMBNAIL_PX.min(larger) / larger).max(1);
    let view = ImageBuffer::<Rgb<u8>, &[u8]>::from_raw(width, height, &image.pixels)?;
    let view = imageops::resize(&view, small(width), small(height), FilterType::Triangle);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, THUMBNAIL_QUALITY)
        .encode(
            view.as_raw(),
            view.width(),
            view.height(),
            ExtendedColorType::Rgb8,
        )
        .ok()?;
    Some(jpeg)
}
