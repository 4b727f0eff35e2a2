//! Where the image of a keyframe is: in memory, packed, on disk or lost.

use crate::mapper::keyframes::image_codec::Content;

/// Where the image of a keyframe is.
#[derive(Debug, Clone, Default)]
pub struct Residency {
    /// In memory, with its depth.
    pub is_here: bool,
    /// Packed: on disk, or nowhere as long as it has never left.
    pub copy: Option<Content>,
    /// Number of the turn in which it came; those that have been here longest leave first.
    pub since: u64,
    /// It shows a part of the map that is on disk.
    pub rests: bool,
    /// It came with a saved map: the geometry model does not know it, and images are none where the map has none.
    pub is_prior: bool,
}

impl Residency {
    pub fn here() -> Self {
        Self {
            is_here: true,
            ..Self::default()
        }
    }
}
