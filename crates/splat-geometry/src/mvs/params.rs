//! Parameters of multi-view stereo, `mvs.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use splat_gpu::backend::Backend;

/// Parameters `mvs.*`: size of depth maps, planes and views of the sweep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MvsParams {
    /// Longer side of the depth map.
    #[schemars(range(min = 32, max = 2048), extend("unit" = "px"))]
    pub max_side: u32,
    /// Planes of the sweep, even in inverse depth.
    #[schemars(range(min = 16, max = 512))]
    pub depth_planes: usize,
    /// Neighbouring keyframes that each depth map is matched against.
    #[schemars(range(min = 1, max = 16))]
    pub source_views: usize,
    /// Neighbours that must agree on a depth; pixels with fewer get confidence 0.
    #[schemars(range(min = 1, max = 8))]
    pub min_views: usize,
    /// Where depth is matched; auto times the first sweep on the CPU and on a GPU that is no software, and takes
    /// the faster. Depths of both differ by rounding: where runs must repeat bit for bit and both are about as
    /// fast, name one.
    pub backend: Backend,
}

impl Default for MvsParams {
    fn default() -> Self {
        Self {
            max_side: 320,
            depth_planes: 96,
            source_views: 4,
            min_views: 2,
            backend: Backend::Auto,
        }
    }
}
