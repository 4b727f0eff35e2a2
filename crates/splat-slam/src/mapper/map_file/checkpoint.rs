//! A snapshot and where the run stood <-> a `.splatmap` file. docs/FORMATS.md has the format byte by byte.
//!
//! Every byte of the file lies under a CRC32C, and a length is believed only as far as the file reaches: a
//! truncated, flipped or synthetic file is an error, never a panic and never a half map.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use byteorder::{LittleEndian, ReadBytesExt, WriteBytesExt};

use crate::mapper::keyframes::image_codec::SavedView;
use crate::mapper::map_file::framing::{read_section, write_section};
use crate::mapper::map_file::sections::{
    keyframe_bytes, map_frame_bytes, parse_keyframes, parse_map_frame, parse_regions, parse_splats,
    parse_views, regions_len, splat_bytes, view_bytes, write_regions,
};
use crate::mapper::splats::region_codec::{age_bytes, parse_update_counts};
use crate::mapper::splats::regions::Evicted;
use splat_types::map_frame::MapFrame;
use splat_types::snapshot::{Scale, Snapshot};
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;

const MAGIC: [u8; 8] = *b"SPLATMAP";
const VERSION: u32 = 1;
/// Magic, version, number of sections, CRC32C of these.
const FILE_HEADER_BYTES: u64 = 20;
/// Far more than the format knows; keeps a synthetic count from looping.
const MAX_SECTIONS: u32 = 64;

const META: [u8; 4] = *b"META";
const KEYFRAMES: [u8; 4] = *b"KEYF";
const SPLATS: [u8; 4] = *b"SPLT";
const LANDMARKS: [u8; 4] = *b"LAND";
const UPDATE_COUNTS: [u8; 4] = *b"AGES";
const VIEWS: [u8; 4] = *b"VIEW";
const EVICTED: [u8; 4] = *b"EVIC";
const MAP_FRAME: [u8; 4] = *b"MFRM";

/// All that a later run needs to show, export or continue a map.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    pub snapshot: Snapshot,
    pub seed: u64,
    /// Optimiser updates made so far.
    pub steps: u64,
    /// Where the robot's map frame lies; `None` where nothing was published.
    pub map_frame: Option<MapFrame>,
    /// Landmarks by which a later run finds its place, as `track::Tracker` saves them; empty where there are none.
    pub landmarks: Vec<u8>,
    /// Updates that each splat has had, in their order; empty where unknown.
    pub update_counts: Vec<u16>,
    /// Images of keyframes, to train on again.
    pub views: Vec<SavedView>,
    /// So many bytes of them are written at most.
    pub max_view_bytes: u64,
    /// Parts of the map that are on disk, not among the snapshot's splats. What was read has none: they are among them.
    pub evicted: Vec<Evicted>,
}

impl Checkpoint {
    /// Without what makes it quicker to go on.
    pub fn of(snapshot: Snapshot, seed: u64, steps: u64) -> Self {
        Self {
            snapshot,
            seed,
            steps,
            map_frame: None,
            landmarks: Vec::new(),
            update_counts: Vec::new(),
            views: Vec::new(),
            max_view_bytes: 0,
            evicted: Vec::new(),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    #[error("cannot write the map: {reason}: {}", path.display())]
    Write { reason: String, path: PathBuf },
    #[error("cannot read the map: {reason}: {}", path.display())]
    Read { reason: String, path: PathBuf },
    #[error("this is no .splatmap file, it begins with {found:02x?}: {}", path.display())]
    Magic { found: [u8; 8], path: PathBuf },
    #[error("the map has format version {found}, this program reads version {VERSION}; use the program that wrote it: {}", path.display())]
    Version { found: u32, path: PathBuf },
    #[error("the map is damaged: {reason}; take an older copy: {}", path.display())]
    Damaged { reason: String, path: PathBuf },
}

/// Writes the whole file to `out`, front to back.
pub fn write(checkpoint: &Checkpoint, out: &mut dyn Write) -> io::Result<()> {
    let snapshot = &checkpoint.snapshot;
    let views = view_bytes(&checkpoint.views, checkpoint.max_view_bytes)?;
    let sections = [
        (META, meta_bytes(checkpoint)),
        (KEYFRAMES, keyframe_bytes(&snapshot.poses)),
        (SPLATS, splat_bytes(&snapshot.splats)),
        (LANDMARKS, checkpoint.landmarks.clone()),
        (UPDATE_COUNTS, age_bytes(&checkpoint.update_counts)),
        (VIEWS, views),
        (MAP_FRAME, map_frame_bytes(checkpoint.map_frame)),
    ];
    let mut header = Vec::with_capacity(FILE_HEADER_BYTES as usize);
    header.extend_from_slice(&MAGIC);
    header.extend_from_slice(&VERSION.to_le_bytes());
    header.extend_from_slice(&(sections.len() as u32 + 1).to_le_bytes());
    out.write_all(&header)?;
    out.write_u32::<LittleEndian>(crc32c::crc32c(&header))?;
    for (tag, content) in &sections {
        write_section(out, *tag, content.len() as u64, &|out| {
            out.write_all(content)
        })?;
    }
    let evicted = &checkpoint.evicted;
    write_section(out, EVICTED, regions_len(evicted), &|out| {
        write_regions(evicted, out)
    })
}

/// Reads and checks a whole file. Sections that this version does not know are checked and left out.
pub fn read(path: &Path) -> Result<Checkpoint, CheckpointError> {
    let io_fault = |e: io::Error| CheckpointError::Read {
        reason: e.to_string(),
        path: path.to_owned(),
    };
    let damaged = |reason: String| CheckpointError::Damaged {
        reason,
        path: path.to_owned(),
    };
    let mut file = File::open(path).map_err(io_fault)?;
    let file_info = file.metadata().map_err(io_fault)?;
    if !file_info.is_file() {
        return Err(io_fault(io::Error::other("not a regular file")));
    }
    if file_info.len() < FILE_HEADER_BYTES {
        return Err(damaged(format!(
            "{} bytes, shorter than its header",
            file_info.len()
        )));
    }
    let n_sections = read_header(&mut file, path)?;
    let mut remaining_bytes = file_info.len() - FILE_HEADER_BYTES;
    let (mut meta, mut keyframes, mut splats, mut landmarks) = (None, None, None, None);
    let (mut update_counts, mut views, mut evicted, mut map_frame) = (None, None, None, None);
    for section_ix in 0..n_sections {
        let (tag, content) = match read_section(&mut file, &mut remaining_bytes) {
            Ok(Ok(section)) => section,
            Ok(Err(reason)) => return Err(damaged(format!("section {section_ix}: {reason}"))),
            Err(e) => return Err(io_fault(e)),
        };
        let known = match tag {
            META => fill_once(&mut meta, parse_meta(&content)),
            KEYFRAMES => fill_once(&mut keyframes, parse_keyframes(&content)),
            SPLATS => fill_once(&mut splats, parse_splats(&content)),
            LANDMARKS => fill_once(&mut landmarks, Ok(content)),
            UPDATE_COUNTS => fill_once(&mut update_counts, parse_update_counts(&content)),
            VIEWS => fill_once(&mut views, parse_views(&content)),
            EVICTED => fill_once(&mut evicted, parse_regions(&content)),
            MAP_FRAME => fill_once(&mut map_frame, parse_map_frame(&content)),
            _ => Ok(()),
        };
        known.map_err(|reason| damaged(format!("section {}: {reason}", tag.escape_ascii())))?;
    }
    if remaining_bytes != 0 {
        return Err(damaged(format!(
            "{remaining_bytes} bytes behind the last section"
        )));
    }
    let missing = |name: &str| damaged(format!("no section {name}"));
    let meta: Meta = meta.ok_or_else(|| missing("META"))?;
    let splats = splats.ok_or_else(|| missing("SPLT"))?;
    let (splats, update_counts) = joined(
        splats,
        update_counts.unwrap_or_default(),
        evicted.unwrap_or_default(),
    )
    .map_err(&damaged)?;
    let snapshot = Snapshot {
        map_id: meta.map_id,
        epoch: meta.epoch,
        revision: meta.revision,
        stamp: meta.stamp,
        scale: meta.scale,
        poses: keyframes.ok_or_else(|| missing("KEYF"))?,
        splat_ids: Arc::new((0..splats.len() as u32).collect()),
        splats: Arc::new(splats),
    };
    Ok(Checkpoint {
        landmarks: landmarks.unwrap_or_default(),
        update_counts,
        views: views.unwrap_or_default(),
        map_frame: map_frame.flatten(),
        ..Checkpoint::of(snapshot, meta.seed, meta.steps)
    })
}

/// All splats, those that were on disk behind the others, and their update counts, or none.
fn joined(
    mut splats: Splats,
    mut update_counts: Vec<u16>,
    evicted: Vec<(Splats, Vec<u16>)>,
) -> Result<(Splats, Vec<u16>), String> {
    if !update_counts.is_empty() && update_counts.len() != splats.len() {
        return Err(format!(
            "update counts of {} splats for {}",
            update_counts.len(),
            splats.len()
        ));
    }
    if !evicted.is_empty() {
        update_counts.resize(splats.len(), 0);
    }
    for (more, more_update_counts) in evicted {
        if more.sh_degree != splats.sh_degree && !splats.is_empty() {
            return Err("splats of two SH degrees".to_owned());
        }
        splats.extend(&more);
        update_counts.extend(more_update_counts);
    }
    Ok((splats, update_counts))
}

/// The content of META.
struct Meta {
    map_id: [u8; 16],
    epoch: u32,
    revision: u32,
    stamp: Stamp,
    seed: u64,
    steps: u64,
    scale: Scale,
}

/// Checks the file header; returns the number of sections.
fn read_header(file: &mut File, path: &Path) -> Result<u32, CheckpointError> {
    let mut header = [0; FILE_HEADER_BYTES as usize];
    file.read_exact(&mut header)
        .map_err(|e| CheckpointError::Read {
            reason: e.to_string(),
            path: path.to_owned(),
        })?;
    let (magic, rest) = header
        .split_first_chunk::<8>()
        .expect("the header is longer than its magic");
    let word = |ix: usize| u32::from_le_bytes([rest[ix], rest[ix + 1], rest[ix + 2], rest[ix + 3]]);
    let (version, n_sections, crc) = (word(0), word(4), word(8));
    if *magic != MAGIC {
        return Err(CheckpointError::Magic {
            found: *magic,
            path: path.to_owned(),
        });
    }
    // The CRC comes first: a flipped bit in the version is damage, not another version.
    if crc != crc32c::crc32c(&header[..16]) || n_sections > MAX_SECTIONS {
        return Err(CheckpointError::Damaged {
            reason: "its header fails the CRC".to_owned(),
            path: path.to_owned(),
        });
    }
    if version != VERSION {
        return Err(CheckpointError::Version {
            found: version,
            path: path.to_owned(),
        });
    }
    Ok(n_sections)
}

fn fill_once<T>(slot: &mut Option<T>, parsed: Result<T, String>) -> Result<(), String> {
    match slot.replace(parsed?) {
        Some(_) => Err("it is there twice".to_owned()),
        None => Ok(()),
    }
}

fn meta_bytes(checkpoint: &Checkpoint) -> Vec<u8> {
    let snapshot = &checkpoint.snapshot;
    let mut bytes = Vec::new();
    bytes.extend_from_slice(&snapshot.map_id);
    bytes.extend_from_slice(&snapshot.epoch.to_le_bytes());
    bytes.extend_from_slice(&snapshot.revision.to_le_bytes());
    bytes.extend_from_slice(&snapshot.stamp.nanos.to_le_bytes());
    bytes.extend_from_slice(&checkpoint.seed.to_le_bytes());
    bytes.extend_from_slice(&checkpoint.steps.to_le_bytes());
    let (code, metres, std) = snapshot.scale.to_numbers();
    bytes.push(code);
    bytes.extend_from_slice(&metres.to_le_bytes());
    bytes.extend_from_slice(&std.to_le_bytes());
    bytes
}

fn parse_meta(content: &[u8]) -> Result<Meta, String> {
    let mut rest = content;
    let mut parse = || -> io::Result<(Meta, (u8, f64, f64))> {
        let mut map_id = [0; 16];
        rest.read_exact(&mut map_id)?;
        let meta = Meta {
            map_id,
            epoch: rest.read_u32::<LittleEndian>()?,
            revision: rest.read_u32::<LittleEndian>()?,
            stamp: Stamp::from_nanos(rest.read_i64::<LittleEndian>()?),
            seed: rest.read_u64::<LittleEndian>()?,
            steps: rest.read_u64::<LittleEndian>()?,
            scale: Scale::UP_TO_SCALE,
        };
        let code = rest.read_u8()?;
        // Files of before scale was measured end here; what was given then was metres.
        if rest.is_empty() {
            let metres = if code == Scale::GIVEN.source.code() {
                1.0
            } else {
                0.0
            };
            return Ok((meta, (code, metres, 0.0)));
        }
        let metres = rest.read_f64::<LittleEndian>()?;
        Ok((meta, (code, metres, rest.read_f64::<LittleEndian>()?)))
    };
    let (meta, numbers) =
        parse().map_err(|e| format!("{} bytes are too few: {e}", content.len()))?;
    let scale = Scale::of_numbers(numbers)
        .ok_or_else(|| format!("scale (source, metres, deviation) {numbers:?} is none"))?;
    Ok(Meta { scale, ..meta })
}
