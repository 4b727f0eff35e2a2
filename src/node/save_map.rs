//! The only writer of map files: autosaves, services and the run directory come here.
//!
//! What is written was read from an engine without a fault (`Mapper::checkpoint`), and a file that holds splats is
//! never replaced by one that holds none.

use std::path::{Path, PathBuf};

use crate::formats::file::{self, SplatFormat};
use splat_io::whole_file::write_file;
use splat_slam::mapper::map_file::checkpoint::{self, Checkpoint, CheckpointError};
use splat_types::splats::ply::ExportError;
use splat_types::splats::splats::Splats;

/// What is written, and in which form.
#[derive(Debug, Clone, Copy)]
pub enum MapFile<'a> {
    /// `.splatmap`
    Checkpoint(&'a Checkpoint),
    /// `.ply`
    Ply(&'a Splats),
    /// Any format of splats.
    As(SplatFormat, &'a Splats),
}

#[derive(Debug, thiserror::Error)]
pub enum SaveError {
    #[error(
        "the map has no splats and does not replace a file that may have some; remove it, or name another: {}",
        path.display()
    )]
    Empty { path: PathBuf },
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Ply(#[from] ExportError),
}

/// Writes a map file whole or not at all. A map without splats is written only where no other file is in its place, or
/// one that has none either.
pub fn save_map(file: MapFile<'_>, path: &Path) -> Result<(), SaveError> {
    if !file.has_splats() && path.exists() && !file.is_empty_at(path) {
        return Err(SaveError::Empty {
            path: path.to_owned(),
        });
    }
    match file {
        MapFile::Checkpoint(map) => {
            write_file(path, |file| checkpoint::write(map, file)).map_err(|e| {
                CheckpointError::Write {
                    reason: e.to_string(),
                    path: path.to_owned(),
                }
            })?;
        }
        MapFile::Ply(splats) => write_splats(SplatFormat::Ply, splats, path)?,
        MapFile::As(format, splats) => write_splats(format, splats, path)?,
    }
    Ok(())
}

fn write_splats(format: SplatFormat, splats: &Splats, path: &Path) -> Result<(), ExportError> {
    write_file(path, |file| format.write(splats, file)).map_err(|e| ExportError::Write {
        reason: e.to_string(),
        path: path.to_owned(),
    })
}

impl MapFile<'_> {
    fn has_splats(self) -> bool {
        match self {
            Self::Checkpoint(map) => {
                !map.snapshot.splats.is_empty() || map.evicted.iter().any(|e| e.n_splats > 0)
            }
            Self::Ply(splats) | Self::As(_, splats) => !splats.is_empty(),
        }
    }

    /// Whether the file there is a map of the same form without splats. What cannot be read is none.
    fn is_empty_at(self, path: &Path) -> bool {
        match self {
            Self::Checkpoint(_) => {
                checkpoint::read(path).is_ok_and(|map| map.snapshot.splats.is_empty())
            }
            Self::Ply(_) | Self::As(..) => file::read(path).is_ok_and(|splats| splats.is_empty()),
        }
    }
}
