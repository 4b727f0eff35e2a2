//! A point of the sparse cloud that another program's structure from motion leaves beside its poses.

use glam::DVec3;

/// One point of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SparsePoint {
    /// In the frame and unit of the scene's poses.
    pub position_in_gt: DVec3,
    /// 8-bit sRGB.
    pub rgb: [u8; 3],
    /// Mean reprojection error; -1 where the file has none.
    pub error_px: f32,
    /// Images that the point was found in; 0 where the file does not say.
    pub n_images: u32,
}
