//! Parameters of keyframe selection, `select.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `select.*`: which frames become keyframes, and how they are batched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SelectParams {
    /// Every frame becomes a keyframe.
    pub every_frame: bool,
    /// So does every image of a folder, or of a scene of another program, that has at most so many, unless it repeats the
    /// one before: somebody chose them, and what is left out of few is missing in the map; 0 = off.
    #[schemars(range(min = 0, max = 1000000))]
    pub every_photo_up_to: u64,
    /// Every n-th frame that the source brings becomes a keyframe that is kept out of optimisation to measure
    /// quality, besides map.holdout: runs that choose other keyframes are measured by the same images; 0 = off.
    #[schemars(range(min = 0, max = 1000000))]
    pub holdout_frames: u64,
    /// Median image motion that makes a keyframe, share of the longer side.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub min_flow: f64,
    /// Motion that no translation, rotation or scaling of the image explains, share of the longer side; it makes
    /// a keyframe too.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub min_parallax: f64,
    /// Cap on keyframes per second of recording time.
    #[schemars(range(min = 0.01, max = 1000.0), extend("unit" = "Hz"))]
    pub max_rate_hz: f64,
    /// Share of the median sharpness of recent frames; blurrier frames wait for a sharper one.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_sharpness: f64,
    /// A blurry frame is taken all the same after this much further motion, share of the longer side.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_blur_wait: f64,
    /// Keyframes passed to geometry at once.
    #[schemars(range(min = 2, max = 64))]
    pub batch_size: usize,
    /// Keyframes shared by neighbouring batches; below batch_size.
    #[schemars(range(min = 1, max = 63))]
    pub batch_overlap: usize,
}

impl Default for SelectParams {
    fn default() -> Self {
        Self {
            every_frame: false,
            every_photo_up_to: 100,
            holdout_frames: 0,
            min_flow: 0.08,
            min_parallax: 0.014,
            max_rate_hz: 10.0,
            min_sharpness: 0.6,
            max_blur_wait: 0.04,
            batch_size: 8,
            batch_overlap: 3,
        }
    }
}

impl SelectParams {
    /// Motion as a share of that which makes a keyframe.
    pub(crate) fn share_of_wanted(&self, flow: f64, parallax: f64) -> f64 {
        (flow / self.min_flow).max(parallax / self.min_parallax)
    }
}
