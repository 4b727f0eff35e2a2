//! A copy of the map that never changes: what publishers, files and reports see.

use std::sync::Arc;

use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::pose::Rigid;
use crate::splat::Splats;

/// Where metres come from, if anywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ScaleSource {
    /// Lengths are relative: the map is right up to one unknown factor.
    #[default]
    UpToScale,
    /// Poses given in metres by the recording (`--geometry known`).
    Given,
}

impl ScaleSource {
    /// Number in files and messages.
    pub fn code(self) -> u8 {
        match self {
            Self::UpToScale => 0,
            Self::Given => 1,
        }
    }

    pub fn from_code(code: u8) -> Option<Self> {
        [Self::UpToScale, Self::Given]
            .into_iter()
            .find(|source| source.code() == code)
    }
}

/// A keyframe's refined pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    pub keyframe_id: u32,
    pub stamp: Stamp,
    pub map_from_cam: Rigid,
    pub intrinsics: Intrinsics,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Random-looking but derived from seed and first stamp, so that replays agree.
    pub map_id: [u8; 16],
    /// Increases when old splats moved as a whole (a pose correction); clients drop what they have.
    pub epoch: u32,
    /// Increases with every snapshot.
    pub revision: u32,
    /// Stamp of the newest keyframe in the map.
    pub stamp: Stamp,
    pub scale: ScaleSource,
    /// In order of keyframe id.
    pub poses: Vec<KeyframePose>,
    pub splats: Arc<Splats>,
}
