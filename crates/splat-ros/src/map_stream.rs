//! Snapshot after snapshot -> what clients need to receive: the whole map now and then, what changed visibly in between.
//!
//! The published map is the one that clients hold. A splat that moved too little to be seen stays as it was, there and
//! here, until it has moved far enough or a whole snapshot goes out; so client and server agree bit for bit.

use std::sync::Arc;

use crate::error::PublishError;
use crate::latched::{KEYFRAMES, MANIFEST, SPLATS};
use crate::navigation;
use crate::odometry::FrameCells;
use crate::params::PublishParams;
use crate::publisher::Publisher;
use crate::reports::Reports;
use crate::status::PublishedStatus;
use crate::submap_stream::SubmapStream;
use crate::transport::{Delivery, Event, Sample, Topic};
use splat_msgs::correction_message::{self, MapCorrectionMsg};
use splat_msgs::map_messages::{MAX_MESSAGE_BYTES, Messages, SplatDelta, splats_per_message};
use splat_types::snapshot::Snapshot;
use splat_types::splats::layout;
use splat_types::splats::splats::{SH_C0, Splats};
use splat_types::time::Stopwatch;

/// Change below it is not seen: in standard deviations of the splat, or steps of a 0 to 1 colour times two, each
/// weighed by the splat's opacity.
const MIN_CHANGE: f32 = 0.02;

pub static CORRECTION: Topic =
    Topic::of::<MapCorrectionMsg>("correction", Delivery::Latched { depth: 10 });
pub static DELTA: Topic = Topic::of::<SplatDelta>("splats/delta", Delivery::Reliable { depth: 64 });
pub static TOPICS: [&Topic; 2] = [&DELTA, &CORRECTION];

/// What changes with every snapshot; owned by the thread that publishes them.
#[derive(Debug)]
pub struct MapStream {
    params: PublishParams,
    published: PublishedMap,
    submaps: SubmapStream,
    since_whole: Option<Stopwatch>,
    /// The newest snapshot that was to go out.
    last: Option<Arc<Snapshot>>,
    reports: Arc<Reports>,
    frames: Arc<FrameCells>,
}

/// What clients are to receive of a snapshot.
#[derive(Debug)]
pub enum Update {
    /// The whole of it.
    Whole,
    Delta(Delta),
}

#[derive(Debug)]
pub struct Delta {
    base_revision: u32,
    /// Ids, ascending.
    removed: Vec<u32>,
    /// Indices in the published map after it, ascending.
    changed: Vec<usize>,
}

/// Keeps the map that clients hold.
#[derive(Debug, Default)]
pub struct PublishedMap {
    held: Option<Arc<Snapshot>>,
}

/// A splat of the newest snapshot on its way to clients.
struct Candidate {
    change: f32,
    new_ix: usize,
}

impl MapStream {
    pub(crate) fn new(
        params: &PublishParams,
        reports: Arc<Reports>,
        frames: Arc<FrameCells>,
    ) -> Self {
        Self {
            params: params.clone(),
            published: PublishedMap::default(),
            submaps: SubmapStream::default(),
            since_whole: None,
            last: None,
            reports,
            frames,
        }
    }

    /// Sends submaps without a known relation to the map, as far as they are new or have changed; they are all there are.
    pub fn publish_submaps(
        &mut self,
        publisher: &Publisher,
        submaps: &[Arc<Snapshot>],
    ) -> Result<(), PublishError> {
        self.submaps.publish(publisher, submaps)
    }

    /// Sends a snapshot: what changed since the one before, or the whole of it, as the last one always goes out; `n_queued`
    /// snapshots wait behind it. Returns when the transports have taken it.
    pub fn publish(
        &mut self,
        publisher: &Publisher,
        snapshot: &Arc<Snapshot>,
        is_last: bool,
        n_queued: usize,
    ) -> Result<(), PublishError> {
        self.frames
            .set_metres_per_unit(snapshot.scale.metres_per_unit);
        let map_from_world = self.frames.tree().map_from_world();
        self.reports.published.set(PublishedStatus {
            map_id: snapshot.map_id,
            epoch: snapshot.epoch,
            revision: snapshot.revision,
            scale: snapshot.scale,
            n_queued,
        });
        let last = self.last.replace(Arc::clone(snapshot));
        let correction = last.and_then(|last| self.reports.correction.take(&last, snapshot));
        let is_due = self
            .since_whole
            .is_none_or(|watch| watch.secs() >= self.params.full_map_period);
        let is_whole = is_last || is_due;
        let update = self
            .published
            .update(snapshot, is_whole, self.params.delta_share);
        let held = self.published.held().map_or(snapshot, |held| held);
        // Before the first message goes out: who subscribed too late for it finds it there.
        let latched = publisher.latched();
        let kept = latched.keep_map(held);
        if let Some(correction) = correction {
            let frame = latched.splat_frame();
            let message = correction_message::message(&correction, snapshot, frame);
            publisher.send(&Sample::of(&CORRECTION, snapshot.stamp, &message)?)?;
            publisher.observe(&Event::Correction(&correction));
        }
        publisher.observe(&Event::Map {
            snapshot: held,
            map_from_world,
        });
        update.send(publisher, &latched.messages(&kept))?;
        let send = |sample: &Sample| publisher.send(sample);
        navigation::of_snapshot(snapshot, &map_from_world, &self.params, &send)?;
        if matches!(update, Update::Whole) {
            self.since_whole = Some(Stopwatch::start());
        }
        Ok(())
    }
}

impl Update {
    /// `messages` are those of the published map that the update has led to.
    fn send(&self, publisher: &Publisher, messages: &Messages<'_>) -> Result<(), PublishError> {
        let stamp = messages.snapshot.stamp;
        if let Self::Whole = self {
            publisher.send(&Sample::of(&MANIFEST, stamp, &messages.manifest())?)?;
        }
        for array in messages.keyframes() {
            publisher.send(&Sample::of(&KEYFRAMES, stamp, &array)?)?;
        }
        match self {
            Self::Whole => {
                for chunk in messages.chunks() {
                    publisher.send(&Sample::of(&SPLATS, stamp, &chunk)?)?;
                }
            }
            Self::Delta(delta) => {
                for piece in delta.messages(messages) {
                    publisher.send(&Sample::of(&DELTA, stamp, &piece)?)?;
                }
            }
        }
        Ok(())
    }
}

impl PublishedMap {
    /// The map as clients hold it.
    pub fn held(&self) -> Option<&Arc<Snapshot>> {
        self.held.as_ref()
    }

    /// Takes a snapshot in. `max_share` bounds a delta by the bytes of the whole map.
    pub fn update(&mut self, newest: &Arc<Snapshot>, is_whole: bool, max_share: f64) -> Update {
        let delta = self
            .held
            .as_ref()
            .filter(|held| !is_whole && is_next(held, newest))
            .map(|held| delta(held, newest, max_share));
        match delta {
            Some((after, delta)) => {
                self.held = Some(Arc::new(after));
                Update::Delta(delta)
            }
            None => {
                self.held = Some(Arc::clone(newest));
                Update::Whole
            }
        }
    }
}

fn is_next(held: &Snapshot, newest: &Snapshot) -> bool {
    held.map_id == newest.map_id
        && held.epoch == newest.epoch
        && held.revision < newest.revision
        && held.splats.sh_degree == newest.splats.sh_degree
        && held.scale.source == newest.scale.source
}

/// The published map after a delta, and the delta.
fn delta(held: &Snapshot, newest: &Snapshot, max_share: f64) -> (Snapshot, Delta) {
    let (old_ids, new_ids) = (&held.splat_ids, &newest.splat_ids);
    let mut removed = Vec::new();
    let mut candidates = Vec::new();
    // Both lists ascend.
    let mut old_of_new: Vec<Option<usize>> = Vec::with_capacity(new_ids.len());
    let mut old_ix = 0;
    for (new_ix, id) in new_ids.iter().enumerate() {
        while old_ids.get(old_ix).is_some_and(|old| old < id) {
            removed.push(old_ids[old_ix]);
            old_ix += 1;
        }
        let same = (old_ids.get(old_ix) == Some(id)).then_some(old_ix);
        old_ix += usize::from(same.is_some());
        old_of_new.push(same);
        let change = same.map_or(f32::INFINITY, |old_ix| {
            change((&held.splats, old_ix), (&newest.splats, new_ix))
        });
        if change > MIN_CHANGE {
            candidates.push(Candidate { change, new_ix });
        }
    }
    removed.extend(&old_ids[old_ix..]);
    let room = (new_ids.len() as f64 * max_share) as usize;
    if candidates.len() > room {
        // Ties go by index, so that equal runs send equal bytes.
        candidates.sort_by(|a, b| b.change.total_cmp(&a.change).then(a.new_ix.cmp(&b.new_ix)));
        candidates.truncate(room);
    }
    let mut is_sent = vec![false; new_ids.len()];
    for candidate in &candidates {
        is_sent[candidate.new_ix] = true;
    }
    let mut splats = Splats {
        sh_degree: newest.splats.sh_degree,
        ..Splats::default()
    };
    let (mut ids, mut changed) = (Vec::new(), Vec::new());
    for (new_ix, id) in new_ids.iter().enumerate() {
        match (is_sent[new_ix], old_of_new[new_ix]) {
            (true, _) => {
                changed.push(splats.len());
                splats.push(&newest.splats, new_ix);
            }
            (false, Some(old_ix)) => splats.push(&held.splats, old_ix),
            (false, None) => continue,
        }
        ids.push(*id);
    }
    let after = Snapshot {
        splats: Arc::new(splats),
        splat_ids: Arc::new(ids),
        ..newest.clone()
    };
    let delta = Delta {
        base_revision: held.revision,
        removed,
        changed,
    };
    (after, delta)
}

/// How much of a splat's change a viewer sees.
fn change((old, i): (&Splats, usize), (new, j): (&Splats, usize)) -> f32 {
    let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    let (was, is) = (
        opacity(old.opacity_logits[i]),
        opacity(new.opacity_logits[j]),
    );
    let largest = |v: &[f32; 3]| v.iter().copied().fold(f32::MIN, f32::max);
    let size = largest(&old.log_scales[i])
        .max(largest(&new.log_scales[j]))
        .exp();
    let gap = |a: &[f32], b: &[f32]| {
        let gaps = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        gaps.fold(0.0, f32::max)
    };
    let dot: f32 = std::iter::zip(&old.quats[i], &new.quats[j])
        .map(|(a, b)| a * b)
        .sum();
    let norm = |q: &[f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
    let lengths = (norm(&old.quats[i]) * norm(&new.quats[j])).max(f32::MIN_POSITIVE);
    let turn = 2.0 * (1.0 - (dot / lengths).abs().min(1.0)).sqrt();
    let stride = old.sh_stride();
    let color = SH_C0
        * gap(
            &old.sh[i * stride..][..stride],
            &new.sh[j * stride..][..stride],
        );
    let shape = (gap(&old.means[i], &new.means[j]) / size.max(f32::MIN_POSITIVE))
        .max(gap(&old.log_scales[i], &new.log_scales[j]))
        .max(turn)
        .max(2.0 * color);
    shape * was.max(is) + 2.0 * (was - is).abs()
}

impl Delta {
    /// The messages; `after` are those of the published map that the update has led to.
    pub fn messages<'a>(&'a self, after: &Messages<'a>) -> impl Iterator<Item = SplatDelta> + 'a {
        let chunk_bytes = after.chunk_bytes.min(MAX_MESSAGE_BYTES / 4);
        let (header, map_sha256) = (after.header(), after.map_sha256);
        let after = after.snapshot;
        let per_piece = splats_per_message(&after.splats, chunk_bytes);
        let removed_per_piece = (chunk_bytes / 4).max(1);
        let n_pieces = self
            .changed
            .len()
            .div_ceil(per_piece)
            .max(self.removed.len().div_ceil(removed_per_piece))
            .max(1);
        (0..n_pieces).map(move |piece_ix| {
            let changed = piece(&self.changed, piece_ix, per_piece);
            let some = after.splats.picked(changed);
            let mut data = Vec::new();
            layout::encode(&some, 0..some.len(), &mut data);
            SplatDelta {
                header: header.clone(),
                map_id: after.map_id,
                epoch: after.epoch,
                revision: after.revision,
                base_revision: self.base_revision,
                map_sha256,
                n_splats: after.splats.len() as u32,
                sh_degree: after.splats.sh_degree,
                n_pieces: n_pieces as u32,
                piece_ix: piece_ix as u32,
                removed: piece(&self.removed, piece_ix, removed_per_piece).to_vec(),
                ids: changed.iter().map(|ix| after.splat_ids[*ix]).collect(),
                crc32c: crc32c::crc32c(&data),
                data,
            }
        })
    }
}

fn piece<T>(all: &[T], piece_ix: usize, n: usize) -> &[T] {
    let start = (piece_ix * n).min(all.len());
    &all[start..(start + n).min(all.len())]
}
