//! What can be wrong with what a volume is given.

/// Nothing was changed where one of these is returned, but for `Forgotten`.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum VolumeError {
    #[error(
        "keyframe {keyframe}: pose or camera is not finite, or its scale is {scale} metres a unit; it stays out of the volume"
    )]
    Pose { keyframe: u32, scale: f64 },
    #[error(
        "keyframe {keyframe}: {found} blocks of 8 x 8 x 8 voxels are within {range} m, more than {limit}; raise grid.resolution or lower grid.max_range"
    )]
    TooManyBlocks {
        keyframe: u32,
        found: u64,
        limit: u64,
        range: f64,
    },
    #[error(
        "{n} blocks of 8 x 8 x 8 voxels far from the camera are forgotten, and unknown from now on: grid.max_mib is used up, and {reason}"
    )]
    Forgotten { n: usize, reason: String },
}
