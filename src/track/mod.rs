//! Every frame -> the camera's pose in the map, how sure it is, and whether the tracker is lost, and why.
//!
//! Corners of the frame are paired with landmarks of keyframes, near where the motion so far predicts them, or by their
//! bits alone where there is no motion to go by. Reads copies of what the map knows; tells the map nothing.

mod fit;
mod fitted;
mod history;
mod landmarks;
mod locate;
mod motion;
mod saved;
mod search;
mod seen;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use nalgebra::Matrix6;

pub use self::fitted::FramePlace;
use self::history::History;
pub use self::history::{FrameTrack, Tracks};
pub use self::landmarks::KeyframeView;
use self::landmarks::Landmarks;
use self::locate::Located;
use self::motion::Motion;
use self::seen::Seen;
use crate::clock::Stamp;
use crate::config::track::TrackParams;
use crate::frame::Frame;
use crate::geometry::uncertainty::Covariance;
use crate::pose::Rigid;

/// Design effect before one was seen, and the share that each frame has in the mean: some 50 frames.
const FIRST_DESIGN: f64 = 2.0;
const DESIGN_SHARE: f64 = 0.02;
/// Part of the time to the next frame by which a loss is declared early, so that a camera of 4 Hz says it in time as well.
const LOOK_AHEAD: f64 = 0.7;
/// Design effects of single frames beyond it are outliers.
const MAX_DESIGN: f64 = 25.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// No frame has had a pose.
    Initialising,
    /// The pose is measured, or carried on for less than `track.lost_secs`.
    Tracking,
    /// No pose was found for `track.lost_secs`.
    Lost,
    /// Found again, with no regard to where the camera was before; the frames after it are `Tracking`.
    Relocalised,
}

/// Why a frame has no measured pose.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Reason {
    #[error("no keyframe has a pose and depth yet")]
    NoKeyframes,
    #[error("no calibration for pictures of {width_px}x{height_px} is known")]
    NoCamera { width_px: u32, height_px: u32 },
    #[error("the picture shows nothing to track: {n_corners} corners")]
    Blank { n_corners: usize },
    #[error("no keyframe has looked there")]
    Unseen,
    #[error("{found} landmarks agree, {needed} are needed")]
    TooFew { found: usize, needed: usize },
    #[error("the landmarks that agree lie in one place of the picture")]
    Crowded,
    #[error("landmarks miss their pixels by {times:.1} times what they should")]
    Inexact { times: f64 },
    #[error("the landmarks leave the pose open")]
    Open,
    #[error("the motion so far cannot have led to where the landmarks say")]
    Implausible,
    #[error("no keyframe is recognised")]
    NotRecognised,
}

/// Where the camera is, by the map as it is known at that moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedPose {
    pub map_from_cam: Rigid,
    /// Of the camera in its own axes: translation (the map's unit), then turn (rad).
    pub covariance: Covariance,
    /// Not measured on this frame: the motion before it carried on, with a covariance that grows.
    pub is_predicted: bool,
}

/// What tracking says of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedFrame {
    pub seq: u64,
    pub stamp: Stamp,
    pub state: State,
    pub reason: Option<Reason>,
    /// `None` before the first pose.
    pub pose: Option<TrackedPose>,
    /// Landmarks that agree with the pose.
    pub n_inliers: usize,
}

/// Where a frame is by one keyframe: it moves with that.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Anchor {
    keyframe_id: u32,
    key_from_cam: Rigid,
    /// Unit of the keyframe's depths at that time.
    unit: f64,
}

/// What was kept of a frame, and its number in the history.
#[derive(Debug)]
struct Waiting {
    seen: Arc<Seen>,
    history_ix: usize,
}

#[derive(Debug)]
pub struct Tracker {
    params: TrackParams,
    landmarks: Landmarks,
    /// Pose of every keyframe of the map, and the unit of its depths.
    keyframes: BTreeMap<u32, (Rigid, f64)>,
    state: State,
    motion: Option<Motion>,
    /// Of the last measured pose.
    anchor: Option<Anchor>,
    /// Frames without a measured pose since the last one with.
    n_failed: usize,
    /// Of the frame before.
    last_stamp: Option<Stamp>,
    design: f64,
    /// Where among the keyframes the search goes on.
    searched: usize,
    /// Frames that get a second look when the map has reached them.
    waiting: VecDeque<Waiting>,
    history: History,
}

impl Tracker {
    pub fn new(params: &TrackParams) -> Self {
        Self {
            params: params.clone(),
            landmarks: Landmarks::default(),
            keyframes: BTreeMap::new(),
            state: State::Initialising,
            motion: None,
            anchor: None,
            n_failed: 0,
            last_stamp: None,
            design: FIRST_DESIGN,
            searched: 0,
            waiting: VecDeque::new(),
            history: History::default(),
        }
    }

    pub fn state(&self) -> State {
        self.state
    }

    /// The pose of a frame by what is known. Frames come in order of time.
    pub fn track(&mut self, frame: &Frame) -> TrackedFrame {
        let seen = Arc::new(Seen::of(frame, &self.params));
        let located = self.find(&seen);
        let tracked = match located {
            Ok((located, by_search)) => self.found(&seen, &located, by_search),
            Err(reason) => self.missed(&seen, reason),
        };
        self.last_stamp = Some(seen.stamp);
        let anchor = self.anchor.filter(|_| tracked.is_measured());
        let history_ix = self.history.push(&tracked, anchor);
        self.waiting.push_back(Waiting { seen, history_ix });
        if self.waiting.len() > self.params.max_waiting {
            self.waiting.pop_front();
        }
        tracked
    }

    /// Takes over what the map says: all of its keyframes, with their poses of this moment.
    pub fn update(&mut self, views: &[KeyframeView]) {
        let before = self.anchor.and_then(|anchor| self.pose_by(&anchor));
        let old_unit = self.anchor.and_then(|anchor| self.unit_of(&anchor));
        let kept: BTreeMap<u64, &Arc<Seen>> =
            self.waiting.iter().map(|w| (w.seen.seq, &w.seen)).collect();
        let seen_before = |seq: u64| kept.get(&seq).map(|seen| Arc::clone(seen));
        self.landmarks.update(views, &seen_before, &self.params);
        self.keyframes = views
            .iter()
            .map(|view| {
                let id = view.keyframe.id;
                let held = self.landmarks.held.get(&id).map(|held| held.unit);
                let unit = held.or(self.keyframes.get(&id).map(|(_, unit)| *unit));
                (id, (view.map_from_cam, unit.unwrap_or(1.0)))
            })
            .collect();
        let after = self.anchor.and_then(|anchor| self.pose_by(&anchor));
        let unit = self.anchor.and_then(|anchor| self.unit_of(&anchor));
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
    pub fn look_again(&mut self, n: usize) -> usize {
        let held = self.landmarks.held.values();
        let newest = held.map(|held| held.seen.stamp).max();
        let mut done = 0;
        while done < n {
            let is_reached = |w: &Waiting| newest.is_some_and(|newest| w.seen.stamp <= newest);
            if !self.waiting.front().is_some_and(is_reached) {
                break;
            }
            let Some(waiting) = self.waiting.pop_front() else {
                break;
            };
            self.second_look(&waiting);
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
            self.second_look(&waiting);
        }
        let tracks: Vec<FrameTrack> = self.history.frames.iter().map(|f| self.told(f)).collect();
        self.history.into_tracks(tracks)
    }

    fn found(&mut self, seen: &Seen, located: &Located, by_search: bool) -> TrackedFrame {
        let design = located.design.clamp(0.0, MAX_DESIGN);
        self.design += DESIGN_SHARE * (design - self.design);
        let covariance = self.covariance(located);
        let cam_from_map = located.cam_from_map;
        let has_jumped = by_search
            && self.motion.as_ref().is_some_and(|motion| {
                self.state == State::Lost || self.is_elsewhere(motion, seen.stamp, &cam_from_map)
            });
        // A jump that was noticed at once was a loss all the same.
        if has_jumped && self.state != State::Lost {
            self.history.n_lost += 1;
        }
        let is_new = self.motion.is_none() && self.state == State::Lost;
        self.state = if has_jumped || is_new {
            self.history.n_relocalised += 1;
            State::Relocalised
        } else {
            State::Tracking
        };
        let before = self.motion.take().filter(|_| !has_jumped);
        let motion = Motion::on(before.as_ref(), seen.stamp, cam_from_map, covariance);
        self.motion = Some(motion);
        self.anchor = Some(self.anchor_of(located));
        self.n_failed = 0;
        TrackedFrame {
            seq: seen.seq,
            stamp: seen.stamp,
            state: self.state,
            reason: None,
            pose: Some(TrackedPose {
                map_from_cam: cam_from_map.inverse(),
                covariance: rows(&covariance),
                is_predicted: false,
            }),
            n_inliers: located.n_inliers,
        }
    }

    fn missed(&mut self, seen: &Seen, reason: Reason) -> TrackedFrame {
        self.n_failed += 1;
        let since = self
            .motion
            .as_ref()
            .map(|motion| seen.stamp.secs_since(motion.stamp));
        let last = self.last_stamp.unwrap_or(seen.stamp);
        let wait = seen.stamp.secs_since(last) * LOOK_AHEAD;
        // A keyframe that is gone leaves no motion, but a tracker that was somewhere.
        let is_late = since.is_none_or(|secs| secs + wait >= self.params.lost_secs);
        if self.state != State::Initialising && self.state != State::Lost {
            self.state = if is_late {
                State::Lost
            } else {
                State::Tracking
            };
            self.history.n_lost += u64::from(is_late);
        }
        let depth = self.scene_depth();
        let pose = self.motion.as_ref().map(|motion| TrackedPose {
            map_from_cam: motion.ahead(seen.stamp).inverse(),
            covariance: rows(&motion.covariance_ahead(seen.stamp, depth)),
            is_predicted: true,
        });
        TrackedFrame {
            seq: seen.seq,
            stamp: seen.stamp,
            state: self.state,
            reason: Some(reason),
            pose,
            n_inliers: 0,
        }
    }

    /// Whether a pose is beyond what the motion before could have led to, by far.
    fn is_elsewhere(&self, motion: &Motion, stamp: Stamp, cam_from_map: &Rigid) -> bool {
        const MAX_STD: f64 = 4.0;
        let off = *cam_from_map * motion.ahead(stamp).inverse();
        let covariance = motion.covariance_ahead(stamp, self.scene_depth());
        let std = |axis: usize| covariance[(axis, axis)].sqrt();
        off.translation.length() > MAX_STD * std(0)
            || off.angle_to(&Rigid::IDENTITY) > MAX_STD * std(3)
    }

    fn second_look(&mut self, waiting: &Waiting) {
        let frame = &self.history.frames[waiting.history_ix];
        let id = self.keyframe_of(waiting.seen.seq);
        if id.is_none() && frame.is_fitted {
            return;
        }
        let anchor = if let Some(id) = id {
            // The frame is a keyframe, whose pose the map knows best.
            Some(Anchor {
                keyframe_id: id,
                key_from_cam: Rigid::IDENTITY,
                unit: self.keyframes.get(&id).map_or(1.0, |(_, unit)| *unit),
            })
        } else {
            let guess = frame.anchor.and_then(|anchor| self.pose_by(&anchor));
            self.find_again(&waiting.seen, guess)
                .map(|located| self.anchor_of(&located))
        };
        if let Some(anchor) = anchor {
            self.history.frames[waiting.history_ix].anchor = Some(anchor);
        }
    }

    fn keyframe_of(&self, seq: u64) -> Option<u32> {
        let mut held = self.landmarks.held.values();
        held.find(|held| held.seen.seq == seq).map(|held| held.id)
    }

    fn anchor_of(&self, located: &Located) -> Anchor {
        let id = located.reference;
        let (map_from_key, unit) = self
            .keyframes
            .get(&id)
            .copied()
            .unwrap_or((Rigid::IDENTITY, 1.0));
        Anchor {
            keyframe_id: id,
            key_from_cam: map_from_key.inverse() * located.cam_from_map.inverse(),
            unit,
        }
    }

    /// `map_from_cam` by the keyframe's pose of this moment; `None` where the map has it no more.
    fn pose_by(&self, anchor: &Anchor) -> Option<Rigid> {
        let (map_from_key, unit) = self.keyframes.get(&anchor.keyframe_id)?;
        let mut key_from_cam = anchor.key_from_cam;
        key_from_cam.translation *= unit / anchor.unit;
        Some(*map_from_key * key_from_cam)
    }

    fn unit_of(&self, anchor: &Anchor) -> Option<f64> {
        self.keyframes
            .get(&anchor.keyframe_id)
            .map(|(_, unit)| *unit)
    }

    fn scene_depth(&self) -> f64 {
        let reference = self
            .anchor
            .and_then(|a| self.landmarks.held.get(&a.keyframe_id));
        reference.map_or(1.0, landmarks::Held::median_depth)
    }
}

impl TrackedFrame {
    /// Whether the pose was measured on this very frame.
    pub fn is_measured(&self) -> bool {
        self.pose.is_some_and(|pose| !pose.is_predicted)
    }
}

fn rows(matrix: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]))
}
