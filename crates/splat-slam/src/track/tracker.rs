//! Every frame -> the camera's pose in the map, how sure it is, and whether the tracker is lost, and why.
//!
//! Corners of the frame are paired with landmarks of keyframes, near where the motion so far predicts them, or by their
//! bits alone where there is no motion to go by. Reads copies of what the map knows; reports the map nothing.

mod finding;
mod reported;
mod sensors;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use nalgebra::Matrix6;

use crate::track::anchor::Anchor;
use crate::track::history::{FrameTrack, History, Tracks};
use crate::track::keyframe_poses::KeyframePoses;
use crate::track::landmark_file::{landmark_bytes, parse_landmarks};
use crate::track::landmarks::{KeyframeView, Landmarks};
use crate::track::localize::{Localized, Localizer};
use crate::track::map_odometry::MapOdometry;
use crate::track::map_points::MapPoints;
use crate::track::motion::Motion;
use crate::track::observation::Observation;
use crate::track::odometry_link::LinkedPose;
use crate::track::params::TrackParams;
use crate::track::refinement::FrameRef;
use splat_types::covariance::Covariance;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;
use splat_types::time::Stamp;
use splat_types::tracking::{TrackState, TrackedFrame};
use splat_types::transform::Rigid;

/// Design effect before one was seen, and the share that each frame has in the mean: some 50 frames.
const FIRST_DESIGN: f64 = 2.0;
const DESIGN_SHARE: f64 = 0.02;
/// Part of the time to the next frame by which a loss is declared early, so that a camera of 4 Hz says it in time as well.
const LOOK_AHEAD: f64 = 0.7;
/// Design effects of single frames beyond it are outliers.
const MAX_DESIGN: f64 = 25.0;

/// Where odometry goes on from a keyframe, seconds between frames that are looked for among the landmarks all the same: so far a
/// wrong pose may go unnoticed. Finding corners takes most of the time that a frame takes.
const MATCH_SECS: f64 = 0.19;

/// What was kept of a frame, and its number in the history.
#[derive(Debug)]
struct Waiting {
    seq: u64,
    stamp: Stamp,
    /// `None`: odometry said where it was.
    seen: Option<Arc<Observation>>,
    history_ix: usize,
}

/// A frame whose pose is by landmarks.
#[derive(Debug, Clone, Copy)]
struct FoundFrame {
    seq: u64,
    anchor: Anchor,
    covariance: Matrix6<f64>,
}

/// Which frames were looked for among the landmarks.
#[derive(Debug)]
struct Search {
    last: Option<Stamp>,
    /// The last frame whose pose is by landmarks.
    found: Option<FoundFrame>,
    /// Frames without a measured pose since the last one with.
    n_failed: usize,
    /// Keyframe from which the search for a frame that the motion does not lead to goes on.
    next: usize,
    /// Mean design effect of the frames that were found.
    design: f64,
}

impl Default for Search {
    fn default() -> Self {
        Self {
            last: None,
            found: None,
            n_failed: 0,
            next: 0,
            design: FIRST_DESIGN,
        }
    }
}

/// Frames in, poses out. Many methods: each way to find a frame, and what is said of it, looks at the same records.
#[derive(Debug)]
pub struct Tracker {
    params: TrackParams,
    landmarks: Landmarks,
    points: MapPoints,
    /// Pose of every keyframe of the map, and the unit of its depths.
    keyframes: KeyframePoses,
    state: TrackState,
    motion: Option<Motion>,
    /// Of the last measured pose.
    anchor: Option<Anchor>,
    odometry: MapOdometry,
    search: Search,
    /// The frame before.
    last: Option<(Stamp, Arc<RgbImage>)>,
    /// Frames that get a second look when the map has reached them.
    waiting: VecDeque<Waiting>,
    history: History,
}

impl Tracker {
    pub fn new(params: &TrackParams) -> Self {
        Self {
            params: params.clone(),
            landmarks: Landmarks::default(),
            points: MapPoints::default(),
            keyframes: KeyframePoses::default(),
            state: TrackState::Initialising,
            motion: None,
            anchor: None,
            odometry: MapOdometry::new(params.odometry),
            search: Search::default(),
            last: None,
            waiting: VecDeque::new(),
            history: History::default(),
        }
    }

    /// A tracker in a map that was saved; it begins without any idea of where it is.
    pub fn in_saved(bytes: &[u8], params: &TrackParams) -> Result<Self, String> {
        let mut tracker = Self::new(params);
        for held in parse_landmarks(bytes)? {
            let pose = (held.world_from_cam, held.unit);
            tracker.keyframes.insert(held.id, pose);
            tracker.landmarks.held.insert(held.id, held);
        }
        tracker.odometry = MapOdometry::new(params.odometry).in_map();
        Ok(tracker)
    }

    /// What a later run needs to find its place.
    pub fn saved(&self) -> Result<Vec<u8>, String> {
        landmark_bytes(&self.landmarks)
    }

    /// Keyframes that can be recognised.
    pub fn n_keyframes(&self) -> usize {
        self.landmarks.held.len()
    }

    pub fn state(&self) -> TrackState {
        self.state
    }

    /// Where the camera was on the last frame with a pose, by the map of this moment.
    pub fn last_pose(&self) -> Option<Rigid> {
        self.motion
            .as_ref()
            .map(|motion| motion.cam_from_world.inverse())
    }

    /// The pose of a frame by what is known. Frames come in order of time.
    pub fn track(&mut self, frame: &Frame) -> TrackedFrame {
        let tracked = if repeats(self.last.as_ref(), frame) {
            self.odometry.follow_sensors(frame);
            self.repeated((frame.seq, frame.stamp))
        } else {
            self.look_at(frame)
        };
        self.last = Some((frame.stamp, Arc::clone(&frame.image)));
        tracked
    }

    fn look_at(&mut self, frame: &Frame) -> TrackedFrame {
        let odometry = self.odometry.follow(frame);
        let linked = self.linked(frame.seq);
        let wheels = match linked {
            Some(_) => None,
            None => self.linked_by_sensors((frame.seq, frame.stamp)),
        };
        let near = linked.as_ref().or(wheels.as_ref());
        if let Some(found) = self.found_by_points(frame, near, linked.is_none()) {
            let tracked = self.found((frame.seq, frame.stamp), &found);
            self.keep(None, &tracked, None);
            return tracked;
        }
        if let Some((linked, pose)) = &linked
            && !self.is_match_due(frame.stamp)
        {
            let tracked = self.carried((frame.seq, frame.stamp), linked, pose);
            self.keep(None, &tracked, None);
            return tracked;
        }
        self.search.last = Some(frame.stamp);
        let seen = Arc::new(Observation::of(frame, &self.params));
        let at = (seen.seq, seen.stamp);
        let guess = linked.as_ref().or(wheels.as_ref());
        let guess = guess.map(|(_, pose)| pose.inverse());
        let tracked = match (self.found_by_corners(&seen, guess), linked) {
            (Ok(found), Some((linked, pose)))
                if found.points.is_none() && self.is_surer(&linked, &found.located) =>
            {
                self.carried(at, &linked, &pose)
            }
            (Ok(found), _) => self.found(at, &found),
            (Err(_), Some((linked, pose))) => self.carried(at, &linked, &pose),
            (Err(reason), None) => {
                let before_map = odometry.filter(|pose| self.odometry.reports_before_map(pose));
                match (before_map, wheels) {
                    (Some(pose), _) => return self.ahead_of_map(seen, &pose),
                    (None, Some(linked)) => {
                        return self.bridged(at, Some(seen), reason, &linked);
                    }
                    (None, None) => self.missed(at, reason),
                }
            }
        };
        self.keep(Some(seen), &tracked, None);
        tracked
    }

    /// Whether a frame whose place odometry knows is looked for among the landmarks, too.
    fn is_match_due(&self, stamp: Stamp) -> bool {
        // A stamp that goes back says nothing of the time that has passed.
        let since = self.search.last.map(|last| stamp.secs_since(last));
        self.state != TrackState::Tracking
            || since.is_none_or(|secs| !(0.0..MATCH_SECS).contains(&secs))
    }

    /// Keeps a frame for a second look. `segment`: of odometry, where the pose is in its frame.
    fn keep(
        &mut self,
        seen: Option<Arc<Observation>>,
        tracked: &TrackedFrame,
        segment: Option<u32>,
    ) {
        let anchor = self.anchor.filter(|_| tracked.is_measured());
        let history_ix = self.history.push(tracked, anchor);
        if let Some(segment) = segment {
            self.history.reported_in(segment);
        }
        self.waiting.push_back(Waiting {
            seq: tracked.seq,
            stamp: tracked.stamp,
            seen,
            history_ix,
        });
        if self.waiting.len() > self.params.max_deferred_frames
            && let Some(oldest) = self.waiting.pop_front()
        {
            // Depth beside it may never come; what lies ahead of the map is no better known than before.
            let mut held = self.landmarks.held.values();
            if held.any(|held| held.seen.stamp >= oldest.stamp) {
                self.retry_frame(&oldest);
            }
        }
    }

    /// Whether the pose of the last frame is in odometry's frame and unit, as there is no map yet.
    pub fn is_before_map(&self) -> bool {
        let last = self.history.frames.last();
        last.is_some_and(|entry| entry.segment.is_some())
    }

    /// Takes over what the map says: all of its keyframes, with their poses of this moment.
    pub fn update(&mut self, views: &[KeyframeView]) {
        let before = self.anchor.and_then(|anchor| self.pose_by(&anchor));
        let old_unit = unit_at(self.anchor, &self.keyframes);
        let kept = self.waiting.iter();
        let kept: BTreeMap<u64, &Arc<Observation>> = kept
            .filter_map(|w| Some((w.seq, w.seen.as_ref()?)))
            .collect();
        let seen_before = |seq: u64| kept.get(&seq).map(|seen| Arc::clone(seen));
        self.landmarks.update(views, &seen_before, &self.params);
        self.points.update(views);
        let poses = views.iter().map(|view| {
            let id = view.keyframe.id;
            let held = self.landmarks.held.get(&id).map(|held| held.unit);
            let unit = held.or(self.keyframes.get(&id).map(|(_, unit)| *unit));
            (id, (view.world_from_cam, unit.unwrap_or(1.0)))
        });
        self.keyframes.update(poses.collect());
        if let Some(initialisation) = self.odometry.update(views) {
            self.history.express_in_map(&initialisation);
        }
        let after = self.anchor.and_then(|anchor| self.pose_by(&anchor));
        let unit = unit_at(self.anchor, &self.keyframes);
        self.move_last_points();
        match (before.zip(after), self.motion.as_mut()) {
            (Some((before, after)), Some(motion)) => {
                let unit = unit.zip(old_unit).map_or(1.0, |(new, old)| new / old);
                motion.moved(&(after * before.inverse()), unit);
            }
            // The keyframe is gone, and where the camera is with it.
            _ => (self.motion, self.anchor) = (None, None),
        }
    }

    /// Gives frames that the map has reached since a pose by the keyframes on both sides of them, at most `n` frames.
    /// Returns how many were looked at.
    pub fn retry(&mut self, n: usize) -> usize {
        let reach = self.landmarks.reach();
        let (mut ix, mut done) = (0, 0);
        while done < n
            && let Some(waiting) = self.waiting.get(ix)
        {
            if !reach.has(waiting.stamp) {
                ix += 1;
                continue;
            }
            if let Some(waiting) = self.waiting.remove(ix) {
                self.retry_frame(&waiting);
            }
            done += 1;
        }
        done
    }

    /// The last word: looks at what still waits, as long as that `goes_on`, and says where every frame was by the last
    /// poses of the keyframes.
    pub fn finish(mut self, mut goes_on: impl FnMut() -> bool) -> Tracks {
        while goes_on()
            && let Some(waiting) = self.waiting.pop_front()
        {
            self.retry_frame(&waiting);
        }
        let tracks: Vec<FrameTrack> = self
            .history
            .frames
            .iter()
            .map(|f| {
                let refined = f.anchor.and_then(|anchor| self.pose_by(&anchor));
                let summary = f.summary(refined);
                // What was measured by keyframes of a submap that is not the map is in another frame.
                let is_of_map = f.anchor.is_none() || refined.is_some();
                FrameTrack {
                    live: summary.live.filter(|_| is_of_map),
                    ..summary
                }
            })
            .collect();
        self.history.into_tracks(tracks)
    }

    /// Of the last frame; `None` where its pose was not measured.
    pub fn placement(&self) -> Option<FrameRef> {
        let history_ix = self.history.frames.len().checked_sub(1)?;
        let anchor = self.history.frames[history_ix].anchor?;
        Some(FrameRef {
            keyframe_id: anchor.keyframe_id,
            key_from_cam: anchor.key_from_cam,
            history_ix,
        })
    }

    /// Takes over a better pose of a frame, relative to the same keyframe.
    pub fn fitted(&mut self, placement: &FrameRef, key_from_cam: Rigid) {
        let Some(frame) = self.history.frames.get_mut(placement.history_ix) else {
            return;
        };
        let Some(anchor) = frame
            .anchor
            .filter(|anchor| anchor.keyframe_id == placement.keyframe_id)
        else {
            return;
        };
        let better = Anchor {
            key_from_cam,
            ..anchor
        };
        (frame.anchor, frame.is_fitted) = (Some(better), true);
        // The frame after it is looked for from there.
        if self.anchor == Some(anchor) {
            let poses = self.pose_by(&anchor).zip(self.pose_by(&better));
            if let Some(((before, after), motion)) = poses.zip(self.motion.as_mut()) {
                motion.moved(&(after * before.inverse()), 1.0);
            }
            self.anchor = Some(better);
        }
    }

    /// Whether odometry knows better than the landmarks where the camera is.
    fn is_surer(&self, linked: &LinkedPose, located: &Localized) -> bool {
        let of_located = self.localizer().covariance(located);
        place_variance(&linked.covariance) < place_variance(&of_located)
    }

    fn retry_frame(&mut self, waiting: &Waiting) {
        let frame = &self.history.frames[waiting.history_ix];
        let mut held = self.landmarks.held.values();
        let id = held.find(|held| held.seen.seq == waiting.seq);
        let id = id.map(|held| held.id);
        if id.is_none() && frame.is_fitted {
            return;
        }
        let anchor = if let Some(id) = id {
            // The frame is a keyframe, whose pose the map knows best.
            Some(Anchor {
                keyframe_id: id,
                key_from_cam: Rigid::IDENTITY,
                unit: self.keyframes.unit(id),
            })
        } else if let Some(seen) = &waiting.seen {
            let guess = frame.anchor.and_then(|anchor| self.pose_by(&anchor));
            let found = self.localizer().find_again(seen, guess);
            let by_landmarks = found.map(|located| self.anchor_of(&located));
            by_landmarks.or_else(|| self.anchor_between(waiting.seq))
        } else {
            self.anchor_between(waiting.seq)
        };
        if let Some(anchor) = anchor {
            self.history.frames[waiting.history_ix].anchor = Some(anchor);
        }
    }

    /// By the keyframes on both sides of a frame and odometry.
    fn anchor_between(&self, seq: u64) -> Option<Anchor> {
        let (keyframe_id, key_from_cam) = self.odometry.between_keyframes(seq)?;
        Some(Anchor {
            keyframe_id,
            key_from_cam,
            unit: self.keyframes.unit(keyframe_id),
        })
    }

    fn localizer(&self) -> Localizer<'_> {
        Localizer {
            landmarks: &self.landmarks,
            points: &self.points,
            revisions: &self.keyframes.revisions,
            params: &self.params,
            design: self.search.design,
            share_needed: 1.0,
        }
    }

    /// The map has moved, and the frame that was found last with it.
    fn move_last_points(&mut self) {
        let found = self.search.found.as_ref();
        let pose = found.and_then(|found| {
            // In another unit its points lie elsewhere.
            let unit = self.keyframes.get(&found.anchor.keyframe_id)?.1;
            (unit == found.anchor.unit).then(|| self.pose_by(&found.anchor))?
        });
        match (pose, self.points.last.as_mut()) {
            (Some(pose), Some(last)) => last.world_from_cam = pose,
            _ => self.points.last = None,
        }
    }

    fn anchor_of(&self, located: &Localized) -> Anchor {
        let id = located.reference;
        let (world_from_key, unit) = self
            .keyframes
            .get(&id)
            .copied()
            .unwrap_or((Rigid::IDENTITY, 1.0));
        Anchor {
            keyframe_id: id,
            key_from_cam: world_from_key.inverse() * located.cam_from_world.inverse(),
            unit,
        }
    }

    /// `world_from_cam` by the keyframe's pose of this moment; `None` where the map has it no more.
    fn pose_by(&self, anchor: &Anchor) -> Option<Rigid> {
        self.keyframes.pose_by(anchor)
    }

    fn scene_depth(&self) -> f64 {
        let reference = self
            .anchor
            .and_then(|a| self.landmarks.held.get(&a.keyframe_id));
        reference.map_or(1.0, crate::track::landmarks::StoredKeyframe::median_depth)
    }
}

/// No sensor gives the same image twice: one that comes again, bit for bit, is a camera or a driver that hangs. It shows
/// where the camera was, not where it is.
fn repeats(last: Option<&(Stamp, Arc<RgbImage>)>, frame: &Frame) -> bool {
    last.is_some_and(|(_, image)| *image == frame.image)
}

/// Length of the map's unit at the keyframe that a pose hangs on.
fn unit_at(anchor: Option<Anchor>, keyframes: &KeyframePoses) -> Option<f64> {
    keyframes.get(&anchor?.keyframe_id).map(|(_, unit)| *unit)
}

fn place_variance(covariance: &Matrix6<f64>) -> f64 {
    (0..3).map(|i| covariance[(i, i)]).sum()
}

fn rows(matrix: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]))
}
