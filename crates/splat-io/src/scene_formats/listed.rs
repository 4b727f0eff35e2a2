//! What the readers of scenes have in common.

use std::path::Path;

use crate::error::SourceError;
use splat_types::camera::CameraModel;
use splat_types::transform::Rigid;

/// Views of one scene; files that say more are damaged.
pub(crate) const MAX_VIEWS: usize = 1_000_000;

/// A view before its image is looked for.
#[derive(Debug)]
pub(crate) struct Listed {
    pub(crate) name: String,
    pub(crate) gt_from_cam: Rigid,
    pub(crate) lens: Option<CameraModel>,
    pub(crate) depth: Option<String>,
    pub(crate) is_held_out: bool,
}

pub(crate) fn fault(
    what: &'static str,
    reason: impl Into<String>,
    way_out: &'static str,
    path: &Path,
) -> SourceError {
    SourceError::Open {
        what,
        reason: reason.into(),
        way_out,
        path: path.to_owned(),
    }
}
