//! Frames -> keyframes -> batches, by image motion, sharpness and time; knows no poses.
//!
//! Corners of the last keyframe are tracked from frame to frame (pyramidal Lucas-Kanade); their median motion
//! decides. A frame on which the tracks die shows something else and is a keyframe too.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::select::grey::GreyImage;
use crate::select::motion::{
    corners, distance, parallax_flow, pyramid, sharpness, small_grey, track,
};
use crate::select::optical_flow::Pyramid;
use crate::select::params::SelectParams;
use splat_types::frame::{Batch, Frame, Keyframe};
use splat_types::inertial::ImuLog;
use splat_types::time::Stopwatch;

/// Fewer tracked corners than this say nothing (blank wall, black frame).
const MIN_CORNERS: usize = 12;
/// When fewer of the corners survive, the view has changed.
const MIN_SURVIVORS: f64 = 0.35;
/// Tracks are followed forth and back; where they don't return to within this they have slipped.
const MAX_RETURN_PX: f32 = 1.5;
/// Corners are followed at most so often: between images that are closer together they hardly move, and following them takes time
/// that poses need.
const MAX_FOLLOWED_HZ: f64 = 21.0;
/// Of the motion that makes a keyframe of a camera's frame: a photo with less is the last one again.
const REPEATED_SHARE: f64 = 0.125;
/// Of what an IMU measures between two keyframes, so much is kept.
const MAX_IMU_SECS: f64 = 60.0;
/// Frames whose median sharpness is the measure.
const SHARPNESS_WINDOW: usize = 15;

/// Decides which frames are keyframes. Frames come in order of time.
#[derive(Debug)]
pub struct Selector {
    params: SelectParams,
    next_id: u32,
    /// Somebody chose the images: all but repetitions are keyframes.
    takes_photos: bool,
    last: Option<LastKeyframe>,
    sharpness: VecDeque<f32>,
    /// What an IMU measured since the last keyframe.
    imu: ImuLog,
}

struct LastKeyframe {
    stamp_secs: f64,
    /// When its corners were followed last.
    followed_secs: f64,
    n_corners: usize,
    /// (corner in the keyframe, where it is in `newest`).
    tracks: Vec<([f32; 2], [f32; 2])>,
    newest: Pyramid,
}

impl std::fmt::Debug for LastKeyframe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "LastKeyframe({} of {} tracks)",
            self.tracks.len(),
            self.n_corners
        )
    }
}

/// What tracking says of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Motion {
    /// Shares of the longer side: the median motion, and the motion that depth causes (`parallax_flow`).
    Measured { flow: f64, parallax: f64 },
    /// Most tracks died: the view is another one.
    Lost,
    /// Nothing to track.
    Unknown,
}

impl Selector {
    pub fn new(params: SelectParams) -> Self {
        Self {
            params,
            next_id: 0,
            takes_photos: false,
            last: None,
            sharpness: VecDeque::new(),
            imu: ImuLog::new(MAX_IMU_SECS),
        }
    }

    /// Where a saved map goes on, its keyframes have the first ids.
    #[must_use]
    pub fn counting_from(mut self, first_id: u32) -> Self {
        self.next_id = first_id;
        self
    }

    /// Of a source of so many photos; `None` for the frames of a camera.
    #[must_use]
    pub fn of_photos(mut self, n_photos: Option<u64>) -> Self {
        self.takes_photos = n_photos.is_some_and(|n| n <= self.params.every_photo_up_to);
        self
    }

    /// Returns the frame as a keyframe when the map should keep it.
    pub fn push(&mut self, mut frame: Frame) -> Option<Keyframe> {
        if let Some(span) = &frame.imu {
            self.imu.push(span);
        }
        let every = self.params.holdout_frames;
        frame.is_held_out |= every > 0 && frame.seq % every == every / 2;
        // Held-out frames come besides: those that the map learns from stay nearly the same without them.
        let is_kept = self.params.every_frame
            || if self.takes_photos {
                self.is_new_photo(&frame)
            } else {
                self.shows_more(&frame)
            };
        (is_kept || frame.is_held_out).then(|| self.keep(frame))
    }

    /// Whether a photo is not the last one again, as of a camera at rest; it then takes that one's place.
    fn is_new_photo(&mut self, frame: &Frame) -> bool {
        let grey = small_grey(&frame.image);
        let is_new = match self.last.as_mut().map(|last| last.follow(grey.clone())) {
            Some(Motion::Measured { flow, parallax }) => {
                self.params.share_of_wanted(flow, parallax) >= REPEATED_SHARE
            }
            None | Some(Motion::Lost | Motion::Unknown) => true,
        };
        if is_new && !frame.is_held_out {
            self.last = Some(LastKeyframe::new(frame.stamp.secs(), grey));
        }
        is_new
    }

    /// Whether the frame shows enough that the last keyframe does not; it then takes that one's place.
    fn shows_more(&mut self, frame: &Frame) -> bool {
        let grey = small_grey(&frame.image);
        let sharpness = sharpness(&grey);
        let is_sharp = self.is_sharp(sharpness);
        let stamp_secs = frame.stamp.secs();
        if let Some(last) = &mut self.last {
            // Stamps that go back are followed at once.
            let secs = stamp_secs - last.followed_secs;
            if (0.0..1.0 / MAX_FOLLOWED_HZ).contains(&secs) {
                return false;
            }
            last.followed_secs = stamp_secs;
            let motion = last.follow(grey.clone());
            let too_soon = stamp_secs - last.stamp_secs < 1.0 / self.params.max_rate_hz - 1e-6;
            let moved = match motion {
                Motion::Unknown => false,
                // A blurry frame loses its tracks too; the next sharp one finds them still lost.
                Motion::Lost => is_sharp,
                Motion::Measured { flow, parallax } => {
                    let params = &self.params;
                    params.share_of_wanted(flow, parallax) >= 1.0
                        && (is_sharp || flow >= params.min_flow + params.max_blur_wait)
                }
            };
            if too_soon || !moved || frame.is_held_out {
                return false;
            }
        }
        self.last = Some(LastKeyframe::new(stamp_secs, grey));
        true
    }

    fn keep(&mut self, mut frame: Frame) -> Keyframe {
        if frame.imu.is_some() {
            // Samples of the frames between are nobody's otherwise.
            frame.imu = Some(self.imu.span());
            self.imu.forget_before(frame.stamp);
        }
        let id = self.next_id;
        self.next_id += 1;
        Keyframe {
            id,
            frame,
            age: Stopwatch::start(),
        }
    }

    fn is_sharp(&mut self, sharpness: f32) -> bool {
        let mut sorted: Vec<f32> = self.sharpness.iter().copied().collect();
        sorted.sort_by(f32::total_cmp);
        let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        if self.sharpness.len() == SHARPNESS_WINDOW {
            self.sharpness.pop_front();
        }
        self.sharpness.push_back(sharpness);
        f64::from(sharpness) >= self.params.min_sharpness * f64::from(median)
    }
}

impl LastKeyframe {
    fn new(stamp_secs: f64, grey: GreyImage) -> Self {
        let corners = corners(&grey);
        Self {
            stamp_secs,
            followed_secs: stamp_secs,
            n_corners: corners.len(),
            tracks: corners.into_iter().map(|c| (c, c)).collect(),
            newest: pyramid(grey),
        }
    }

    /// Follows the corners into the next frame and says how far they are from where the keyframe had them.
    fn follow(&mut self, grey: GreyImage) -> Motion {
        if self.n_corners < MIN_CORNERS || self.newest.image().size() != grey.size() {
            // A blank keyframe measures no motion; the first frame with something to see takes its place.
            let sees_more = corners(&grey).len() >= 2 * MIN_CORNERS.max(self.n_corners);
            self.newest = pyramid(grey);
            return if sees_more {
                Motion::Lost
            } else {
                Motion::Unknown
            };
        }
        let (width, height) = (grey.width as f32, grey.height as f32);
        let newest = pyramid(grey);
        let from: Vec<[f32; 2]> = self.tracks.iter().map(|(_, at)| *at).collect();
        let to = track(&self.newest, &newest, &from);
        let positions: Vec<[f32; 2]> = to.iter().map(|t| t.unwrap_or([-1.0, -1.0])).collect();
        let back = track(&newest, &self.newest, &positions);
        let returned = |i: usize| back[i].is_some_and(|b| distance(b, from[i]) <= MAX_RETURN_PX);
        let inside = |p: [f32; 2]| p[0] >= 0.0 && p[1] >= 0.0 && p[0] < width && p[1] < height;
        self.tracks = (0..from.len())
            .filter_map(|i| {
                to[i]
                    .filter(|p| inside(*p) && returned(i))
                    .map(|p| (self.tracks[i].0, p))
            })
            .collect();
        self.newest = newest;
        if (self.tracks.len() as f64) < MIN_SURVIVORS * self.n_corners as f64 {
            return Motion::Lost;
        }
        let mut motion: Vec<f32> = self
            .tracks
            .iter()
            .map(|(start, at)| distance(*start, *at))
            .collect();
        motion.sort_by(f32::total_cmp);
        let longest = f64::from(width.max(height));
        Motion::Measured {
            flow: f64::from(motion[motion.len() / 2]) / longest,
            parallax: parallax_flow(&self.tracks) / longest,
        }
    }
}

/// Groups keyframes into batches that share some with the batch before.
#[derive(Debug)]
pub struct Batcher {
    size: usize,
    overlap: usize,
    next_id: u32,
    n_shared: usize,
    keyframes: Vec<Arc<Keyframe>>,
}

impl Batcher {
    pub fn new(params: &SelectParams) -> Self {
        Self {
            size: params.batch_size,
            overlap: params.batch_overlap,
            next_id: 0,
            n_shared: 0,
            keyframes: Vec::with_capacity(params.batch_size),
        }
    }

    /// Returns a batch when this keyframe fills it.
    pub fn push(&mut self, keyframe: Keyframe) -> Option<Batch> {
        self.keyframes.push(Arc::new(keyframe));
        (self.keyframes.len() >= self.size).then(|| self.take())
    }

    /// Keyframes that were in no batch so far.
    pub fn n_new(&self) -> usize {
        self.keyframes.len() - self.n_shared
    }

    /// A shorter batch: the last one, or live. `None` when every keyframe has been in one.
    pub fn finish(&mut self) -> Option<Batch> {
        (self.n_new() > 0).then(|| self.take())
    }

    fn take(&mut self) -> Batch {
        // No more than are new, else small batches would be made of what was there before.
        let overlap = self.overlap.min(self.n_new());
        let shared = self.keyframes.len().saturating_sub(overlap);
        let rest = self.keyframes[shared..].to_vec();
        let keyframes = std::mem::replace(&mut self.keyframes, rest);
        let batch = Batch {
            id: self.next_id,
            n_shared: self.n_shared,
            keyframes,
        };
        self.next_id += 1;
        self.n_shared = self.keyframes.len();
        batch
    }
}

#[cfg(test)]
mod tests;
