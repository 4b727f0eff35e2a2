//! The newest frame for whoever can find its pose better, and that pose back.

use super::{Anchor, Tracker};
use crate::pose::Rigid;

/// Where tracking has put a frame, by a keyframe of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePlace {
    pub keyframe_id: u32,
    pub key_from_cam: Rigid,
    history_ix: usize,
}

impl Tracker {
    /// Of the last frame; `None` where its pose was not measured.
    pub fn placement(&self) -> Option<FramePlace> {
        let history_ix = self.history.frames.len().checked_sub(1)?;
        let anchor = self.history.frames[history_ix].anchor?;
        Some(FramePlace {
            keyframe_id: anchor.keyframe_id,
            key_from_cam: anchor.key_from_cam,
            history_ix,
        })
    }

    /// Takes over a better pose of a frame, relative to the same keyframe.
    pub fn fitted(&mut self, placement: &FramePlace, key_from_cam: Rigid) {
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
}
