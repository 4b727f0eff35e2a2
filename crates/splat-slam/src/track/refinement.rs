//! A frame for whoever can find its pose better.

use splat_types::transform::Rigid;

/// Where tracking has put a frame, by a keyframe of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameRef {
    pub keyframe_id: u32,
    pub key_from_cam: Rigid,
    pub(crate) history_ix: usize,
}
