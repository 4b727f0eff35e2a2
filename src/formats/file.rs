//! Which format a file has, by its name when it is written and by its first bytes when it is read.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use crate::formats::spz::{self, SpzVersion};
use crate::formats::{compressed_ply, dot_splat, glb};
use splat_types::splats::ply::{self, ExportError};
use splat_types::splats::splats::Splats;

/// Larger files than this are no map that fits into memory.
const MAX_BYTES: u64 = 8 << 30;

/// What can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SplatFormat {
    Ply,
    CompressedPly,
    Spz(SpzVersion),
    Glb,
    Splat,
}

/// Endings of names that are known, for messages.
pub const ENDINGS: &str =
    ".ply, .compressed.ply, .spz, .glb, .splat, .yaml, .mesh.ply, .mesh.glb or .npy";

impl SplatFormat {
    /// By the ending of its name. `spz`: the version that an .spz gets.
    pub fn of(path: &Path, spz: SpzVersion) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_ascii_lowercase();
        let is_named = |ending: &str| name.len() > ending.len() && name.ends_with(ending);
        let known = [
            (".compressed.ply", Self::CompressedPly),
            (".ply", Self::Ply),
            (".spz", Self::Spz(spz)),
            (".glb", Self::Glb),
            (".splat", Self::Splat),
        ];
        let found = known.into_iter().find(|(ending, _)| is_named(ending));
        found.map(|(_, format)| format)
    }

    /// Writes the whole file to `out`.
    pub fn write(self, splats: &Splats, out: &mut dyn Write) -> io::Result<()> {
        match self {
            Self::Ply => ply::write(splats, out),
            Self::CompressedPly => compressed_ply::write(splats, out),
            Self::Spz(version) => spz::write(splats, version, out),
            Self::Glb => glb::write(splats, "splat map", out),
            Self::Splat => dot_splat::write(splats, out),
        }
    }
}

/// Reads a PLY or an SPZ of any program.
pub fn read(path: &Path) -> Result<Splats, ExportError> {
    let fault = |reason: String| ExportError::Read {
        reason,
        path: path.to_owned(),
    };
    let io_fault = |e: io::Error| fault(e.to_string());
    let mut file = File::open(path).map_err(io_fault)?;
    let mut first = Vec::new();
    Read::by_ref(&mut file)
        .take(4)
        .read_to_end(&mut first)
        .map_err(io_fault)?;
    if !spz::is_spz(&first) {
        return ply::read(path);
    }
    let n_bytes = file.metadata().map_err(io_fault)?.len();
    if n_bytes > MAX_BYTES {
        return Err(fault(format!("{n_bytes} bytes, at most {MAX_BYTES}")));
    }
    let mut bytes = first;
    file.take(MAX_BYTES)
        .read_to_end(&mut bytes)
        .map_err(io_fault)?;
    spz::read(&bytes).map_err(|reason| fault(format!("this is no SPZ that can be read: {reason}")))
}

/// Where a file of the format that is asked for lies: messages name it.
pub fn unknown_ending(path: &Path) -> String {
    let path: PathBuf = path.to_owned();
    format!("the name must end with {ENDINGS}: {}", path.display())
}
