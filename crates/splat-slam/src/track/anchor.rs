//! Where a frame is by one keyframe of the map.

use splat_types::transform::Rigid;

/// Where a frame is by one keyframe: it moves with that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Anchor {
    pub(crate) keyframe_id: u32,
    pub(crate) key_from_cam: Rigid,
    /// Unit of the keyframe's depths at that time.
    pub(crate) unit: f64,
}
