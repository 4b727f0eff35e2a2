//! Parameters of the volume and of the grid, `grid.*`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters `grid.*`: the volume that depth is fused in, and what is free or occupied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GridParams {
    /// Fuse verified depth and publish grid, grid_updates, distance_slice, ellipsoids and voxels, where anything is published.
    pub enabled: bool,
    /// Side of a voxel and of a cell.
    #[schemars(range(min = 0.01, max = 1.0), extend("unit" = "m"))]
    pub resolution: f64,
    /// Depth beyond it only clears what lies before it.
    #[schemars(range(min = 0.5, max = 50.0), extend("unit" = "m"))]
    pub max_range: f64,
    /// Distances are kept up to so many voxels from a surface.
    #[schemars(range(min = 2, max = 16))]
    pub truncation_voxels: u32,
    /// What rises less above the local ground is no obstacle.
    #[schemars(range(min = 0.0, max = 5.0), extend("unit" = "m"))]
    pub min_height: f64,
    /// What hangs higher above the local ground is none either: height of the robot.
    #[schemars(range(min = 0.05, max = 4.0), extend("unit" = "m"))]
    pub max_height: f64,
    /// Ground that is steeper is an obstacle.
    #[schemars(range(min = 0.0, max = 60.0), extend("unit" = "deg"))]
    pub max_slope_deg: f64,
    /// Ground that is seen so far below the local ground is an obstacle.
    #[schemars(range(min = 0.02, max = 5.0), extend("unit" = "m"))]
    pub drop_off: f64,
    /// Memory of voxels and of the depth that they are made of; beyond it voxels far from the camera go to disk, and the oldest keyframes can no longer
    /// move.
    #[schemars(range(min = 16, max = 16384), extend("unit" = "MiB"))]
    pub max_mib: u64,
    /// Largest file that voxels go to; beyond it, those that are farthest from the camera are forgotten. 0: none.
    #[schemars(range(min = 0, max = 1048576), extend("unit" = "MiB"))]
    pub max_page_file_mib: u64,
    /// Least time between two grids.
    #[schemars(range(min = 0.05, max = 60.0), extend("unit" = "s"))]
    pub period: f64,
    /// Ellipsoids of splats near the robot in one message.
    #[schemars(range(min = 0, max = 10000))]
    pub max_ellipsoids: u32,
    /// Publish also where the scale is unknown: one unit of the map counts as a metre.
    pub allow_unscaled: bool,
}

impl Default for GridParams {
    fn default() -> Self {
        Self {
            enabled: true,
            resolution: 0.05,
            max_range: 5.0,
            truncation_voxels: 4,
            min_height: 0.1,
            max_height: 1.5,
            max_slope_deg: 15.0,
            drop_off: 0.15,
            max_mib: 256,
            max_page_file_mib: 1024,
            period: 0.5,
            max_ellipsoids: 10_000,
            allow_unscaled: false,
        }
    }
}
