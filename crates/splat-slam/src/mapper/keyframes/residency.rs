//! Where the image of a keyframe is: in memory, packed, on disk or lost.

use std::sync::Arc;

use crate::mapper::keyframes::image_codec::Content;
use crate::mapper::keyframes::training_image::rescaled;
use splat_types::depth::DepthMap;

/// Where the image of a keyframe is.
#[derive(Debug, Clone, Default)]
pub struct Residency {
    /// In memory, with its depth.
    pub is_here: bool,
    /// Packed: on disk, or nowhere as long as it has never left.
    pub copy: Option<Content>,
    /// How many times as long lengths have become since the copy was made; `None`: they are the same.
    pub regrown: Option<f64>,
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

    /// The world has another unit. What is here is packed anew when it leaves.
    pub(crate) fn rescale(&mut self, factor: f64) {
        if self.is_here {
            (self.copy, self.regrown) = (None, None);
        } else {
            self.regrown = Some(self.regrown.unwrap_or(1.0) * factor);
        }
    }

    /// Depth as it was packed, in the unit that the world has by now.
    pub(crate) fn in_present_unit(&self, packed: DepthMap) -> Arc<DepthMap> {
        Arc::new(match self.regrown {
            Some(factor) => rescaled(&packed, factor),
            None => packed,
        })
    }
}
