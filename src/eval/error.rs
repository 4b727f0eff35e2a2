//! Judging a run: trajectories against a reference, images against photos, and the files that say so.
//!
//! Reads what the run left behind and writes reports. Knows nothing of threads or of how the map came to be.

use std::io::Write;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    #[error("cannot render the map: {0}")]
    Engine(#[from] splat_engine::error::EngineError),
    #[error("cannot {action} {what}: {reason}: {}", path.display())]
    File {
        action: &'static str,
        what: &'static str,
        reason: String,
        path: PathBuf,
    },
    #[error("line {line} is no pose: {problem}, found {found:?}; expected `t tx ty tz qx qy qz qw` (seconds, camera to world): {}", path.display())]
    Line {
        line: usize,
        problem: &'static str,
        found: String,
        path: PathBuf,
    },
    #[error("line {line} repeats the stamp {stamp} of an earlier line with another pose; keep one of them: {}", path.display())]
    Repeated {
        line: usize,
        stamp: String,
        path: PathBuf,
    },
    #[error("the trajectory has no poses; did the run register a keyframe?: {}", path.display())]
    NoPoses { path: PathBuf },
    #[error("no pose of the run (stamps {run}) is within {tolerance_secs} s of a reference pose (stamps {reference}); both must use the camera's header stamps: {}", path.display())]
    NothingInCommon {
        run: String,
        reference: String,
        tolerance_secs: f64,
        path: PathBuf,
    },
    #[error(transparent)]
    Scene(#[from] splat_io::error::SourceError),
    #[error("intrinsics: {problem}, found {found}; expected a pinhole with width, height, fx, fy, cx, cy in pixels: {}", path.display())]
    Intrinsics {
        problem: &'static str,
        found: String,
        path: PathBuf,
    },
}

impl EvalError {
    pub(crate) fn reading(what: &'static str, reason: &impl ToString, path: &Path) -> Self {
        Self::File {
            action: "read",
            what,
            reason: reason.to_string(),
            path: path.to_owned(),
        }
    }

    pub(crate) fn writing(what: &'static str, reason: &impl ToString, path: &Path) -> Self {
        Self::File {
            action: "write",
            what,
            reason: reason.to_string(),
            path: path.to_owned(),
        }
    }
}

/// Reads a text file that should be small: `/dev/zero` or a video named by mistake ends in an error, not in swap.
pub(crate) fn read_text(
    what: &'static str,
    max_bytes: u64,
    path: &Path,
) -> Result<String, EvalError> {
    use std::io::Read;

    let file = std::fs::File::open(path).map_err(|e| EvalError::reading(what, &e, path))?;
    let mut bytes = Vec::new();
    file.take(max_bytes + 1)
        .read_to_end(&mut bytes)
        .map_err(|e| EvalError::reading(what, &e, path))?;
    if bytes.len() as u64 > max_bytes {
        return Err(EvalError::reading(
            what,
            &format!("it holds more than {max_bytes} bytes"),
            path,
        ));
    }
    String::from_utf8(bytes).map_err(|e| {
        EvalError::reading(
            what,
            &format!(
                "it is no text, byte {} is not UTF-8",
                e.utf8_error().valid_up_to()
            ),
            path,
        )
    })
}

/// Writes beside the target, then renames: a reader sees the old file or the whole new one, a full disk leaves the old.
pub fn write_atomically(what: &'static str, bytes: &[u8], path: &Path) -> Result<(), EvalError> {
    splat_io::whole_file::write_file(path, |file| file.write_all(bytes))
        .map_err(|e| EvalError::writing(what, &e, path))
}
