//! What the readers of scenes have in common.

use std::path::Path;

use glam::DVec3;

use crate::error::SourceError;
use splat_types::camera::CameraModel;
use splat_types::transform::Rigid;

/// Views of one scene; files that say more are damaged.
pub(crate) const MAX_VIEWS: usize = 1_000_000;

/// Points of one scene: 500 MB of them in memory.
pub(crate) const MAX_POINTS: usize = 10_000_000;

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

/// Refuses a count of points that no scene has.
pub(crate) fn check_count(n: usize) -> Result<(), String> {
    if n > MAX_POINTS {
        return Err(format!("{n} points, at most {MAX_POINTS} are read"));
    }
    Ok(())
}

pub(crate) fn check_position(id: u64, position: DVec3) -> Result<(), String> {
    if !position.is_finite() {
        return Err(format!("point {id} lies at {position}"));
    }
    Ok(())
}

/// The beginning of a line, for errors.
pub(crate) fn excerpt(line: &str) -> String {
    line.chars().take(60).collect()
}
