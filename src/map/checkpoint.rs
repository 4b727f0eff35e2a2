//! A snapshot and where the run stood <-> a `.splatmap` file. docs/FORMATS.md has the format byte by byte.
//!
//! Every byte of the file lies under a CRC32C, and a length is believed only as far as the file reaches: a
//! truncated, flipped or made-up file is an error, never a panic and never a half map.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use byteorder::{LittleEndian, ReadBytesExt, WriteBytesExt};
use glam::{DQuat, DVec3};

use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::map::layout;
use crate::map::snapshot::{KeyframePose, Scale, Snapshot};
use crate::pose::Rigid;
use crate::splat::Splats;

const MAGIC: [u8; 8] = *b"SPLATMAP";
const VERSION: u32 = 1;
/// Magic, version, number of sections, CRC32C of these.
const FILE_HEADER_BYTES: u64 = 20;
/// Tag, length, and behind the content the CRC32C of all three.
const SECTION_FRAME_BYTES: u64 = 16;
/// Far more than the format knows; keeps a made-up count from looping.
const MAX_SECTIONS: u32 = 64;

const META: [u8; 4] = *b"META";
const KEYFRAMES: [u8; 4] = *b"KEYF";
const SPLATS: [u8; 4] = *b"SPLT";
const LANDMARKS: [u8; 4] = *b"LAND";

/// Bytes of one keyframe: id, stamp, quaternion, translation, picture size, focal lengths, principal point.
const KEYFRAME_BYTES: usize = 4 + 8 + 4 * 8 + 3 * 8 + 2 * 4 + 4 * 8;

/// All that a later run needs to show, export or continue a map.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    pub snapshot: Snapshot,
    pub seed: u64,
    /// Optimiser updates made so far.
    pub steps: u64,
    /// Landmarks by which a later run finds its place, as `track::Tracker` saves them; empty where there are none.
    pub landmarks: Vec<u8>,
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

/// Writes beside `path` and renames: a crash at any point leaves the old file or the new one.
pub fn write(checkpoint: &Checkpoint, path: &Path) -> Result<(), CheckpointError> {
    let snapshot = &checkpoint.snapshot;
    let sections = [
        (META, meta_bytes(checkpoint)),
        (KEYFRAMES, keyframe_bytes(&snapshot.poses)),
        (SPLATS, splat_bytes(&snapshot.splats)),
        (LANDMARKS, checkpoint.landmarks.clone()),
    ];
    crate::atomic::write_file(path, |file| {
        let mut header = Vec::with_capacity(FILE_HEADER_BYTES as usize);
        header.extend_from_slice(&MAGIC);
        header.extend_from_slice(&VERSION.to_le_bytes());
        header.extend_from_slice(&(sections.len() as u32).to_le_bytes());
        file.write_all(&header)?;
        file.write_u32::<LittleEndian>(crc32c::crc32c(&header))?;
        for (tag, content) in &sections {
            let length = (content.len() as u64).to_le_bytes();
            file.write_all(tag)?;
            file.write_all(&length)?;
            file.write_all(content)?;
            file.write_u32::<LittleEndian>(section_crc(*tag, length, content))?;
        }
        Ok(())
    })
    .map_err(|e| CheckpointError::Write {
        reason: e.to_string(),
        path: path.to_owned(),
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
    Ok(Checkpoint {
        snapshot: Snapshot {
            map_id: meta.map_id,
            epoch: meta.epoch,
            revision: meta.revision,
            stamp: meta.stamp,
            scale: meta.scale,
            poses: keyframes.ok_or_else(|| missing("KEYF"))?,
            splat_ids: Arc::new((0..splats.len() as u32).collect()),
            splats: Arc::new(splats),
        },
        seed: meta.seed,
        steps: meta.steps,
        landmarks: landmarks.unwrap_or_default(),
    })
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

type Section = ([u8; 4], Vec<u8>);

/// The outer result is the disk's, the inner one the format's.
fn read_section(file: &mut File, remaining_bytes: &mut u64) -> io::Result<Result<Section, String>> {
    if *remaining_bytes < SECTION_FRAME_BYTES {
        return Ok(Err(format!(
            "the file ends, {remaining_bytes} bytes are left"
        )));
    }
    let mut tag = [0; 4];
    file.read_exact(&mut tag)?;
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let n_bytes = u64::from_le_bytes(length);
    *remaining_bytes -= SECTION_FRAME_BYTES;
    if n_bytes > *remaining_bytes {
        return Ok(Err(format!(
            "{n_bytes} bytes announced, {remaining_bytes} are left"
        )));
    }
    *remaining_bytes -= n_bytes;
    let mut content = vec![0; n_bytes as usize];
    file.read_exact(&mut content)?;
    let crc = file.read_u32::<LittleEndian>()?;
    if crc != section_crc(tag, length, &content) {
        return Ok(Err(format!("the CRC of its {n_bytes} bytes does not fit")));
    }
    Ok(Ok((tag, content)))
}

fn section_crc(tag: [u8; 4], length: [u8; 8], content: &[u8]) -> u32 {
    let frame = crc32c::crc32c_append(crc32c::crc32c(&tag), &length);
    crc32c::crc32c_append(frame, content)
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

fn keyframe_bytes(poses: &[KeyframePose]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(poses.len() * KEYFRAME_BYTES);
    for pose in poses {
        let (q, t, k) = (
            pose.map_from_cam.rotation,
            pose.map_from_cam.translation,
            &pose.intrinsics,
        );
        bytes.extend_from_slice(&pose.keyframe_id.to_le_bytes());
        bytes.extend_from_slice(&pose.stamp.nanos.to_le_bytes());
        for number in [q.w, q.x, q.y, q.z, t.x, t.y, t.z] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(&k.width_px.to_le_bytes());
        bytes.extend_from_slice(&k.height_px.to_le_bytes());
        for number in [k.fx, k.fy, k.cx, k.cy] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
    }
    bytes
}

fn parse_keyframes(content: &[u8]) -> Result<Vec<KeyframePose>, String> {
    let (rows, rest) = content.as_chunks::<KEYFRAME_BYTES>();
    if !rest.is_empty() {
        return Err(format!(
            "{} bytes are no whole number of keyframes of {KEYFRAME_BYTES}",
            content.len()
        ));
    }
    let mut poses = Vec::with_capacity(rows.len());
    for row in rows {
        let pose = parse_keyframe(row).map_err(|e| e.to_string())?;
        let lengths_fit = (pose.map_from_cam.rotation.length() - 1.0).abs() < 1e-6;
        if !pose.map_from_cam.is_finite() || !lengths_fit || !pose.intrinsics.is_plausible() {
            return Err(format!(
                "keyframe {} has no usable pose or intrinsics",
                pose.keyframe_id
            ));
        }
        poses.push(pose);
    }
    Ok(poses)
}

fn parse_keyframe(mut row: &[u8]) -> io::Result<KeyframePose> {
    let keyframe_id = row.read_u32::<LittleEndian>()?;
    let stamp = Stamp::from_nanos(row.read_i64::<LittleEndian>()?);
    let mut numbers = [0.0; 7];
    row.read_f64_into::<LittleEndian>(&mut numbers)?;
    let [w, x, y, z, tx, ty, tz] = numbers;
    let (width_px, height_px) = (
        row.read_u32::<LittleEndian>()?,
        row.read_u32::<LittleEndian>()?,
    );
    let mut numbers = [0.0; 4];
    row.read_f64_into::<LittleEndian>(&mut numbers)?;
    let [fx, fy, cx, cy] = numbers;
    Ok(KeyframePose {
        keyframe_id,
        stamp,
        map_from_cam: Rigid::new(DQuat::from_xyzw(x, y, z, w), DVec3::new(tx, ty, tz)),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx,
            fy,
            cx,
            cy,
        },
    })
}

fn splat_bytes(splats: &Splats) -> Vec<u8> {
    let mut bytes =
        Vec::with_capacity(4 + splats.len() * layout::bytes_per_splat(splats.sh_degree));
    bytes.extend_from_slice(&u32::from(splats.sh_degree).to_le_bytes());
    layout::encode(splats, 0..splats.len(), &mut bytes);
    bytes
}

fn parse_splats(content: &[u8]) -> Result<Splats, String> {
    let (head, body) = content.split_first_chunk::<4>().ok_or("no SH degree")?;
    let sh_degree = u32::from_le_bytes(*head);
    let sh_degree = u8::try_from(sh_degree)
        .ok()
        .filter(|degree| *degree <= layout::MAX_SH_DEGREE);
    let mut splats = Splats {
        sh_degree: sh_degree.ok_or("its SH degree is above 3")?,
        ..Splats::default()
    };
    layout::decode(body, &mut splats)
        .ok_or_else(|| format!("{} bytes are no whole number of splats", body.len()))?;
    match layout::fault(&splats) {
        Some(reason) => Err(reason),
        None => Ok(splats),
    }
}
